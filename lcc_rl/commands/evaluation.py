"""Evaluation of strategies in the scenario of a configuration."""

from __future__ import annotations

import dataclasses
import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

import pandas as pd
from rich.console import Console

from lcc_rl.commands.checks import check_measured
from lcc_rl.config.compose import identity, with_inputs
from lcc_rl.config.schemas import EvaluateConfig, StudyConfig
from lcc_rl.envs import Inputs, load_inputs
from lcc_rl.envs.inputs import build_energy, second_energy
from lcc_rl.evaluation.comparison import Comparison
from lcc_rl.evaluation.entrants import Entrants
from lcc_rl.evaluation.episodes import plan_of
from lcc_rl.evaluation.fit import check_table_unit, classes, other_drivers, task_of
from lcc_rl.evaluation.foreign import GivenPolicy
from lcc_rl.evaluation.named import is_shipped
from lcc_rl.io.files import FEW, IDENTITY, Rows, as_rows, parquet_metadata, read_parquet
from lcc_rl.results.names import size_of
from lcc_rl.results.platoons import case_report
from lcc_rl.results.remarks import few_windows, leader_too_fast, remarks
from lcc_rl.results.render import WIDTH, print_table, terminal
from lcc_rl.results.report import Report, report, together, windows_for
from lcc_rl.results.runs import EPISODES, RECORD, STEPS, check_folder, resumed_config, save_config
from lcc_rl.results.windows import by_source
from lcc_rl.runs.output import log_report
from lcc_rl.runs.precision import prepare_torch
from lcc_rl.runs.states import UNDRAWN, claim, forget

log = logging.getLogger("lcc_rl")


def run(
    cfg: EvaluateConfig,
    folder: str | Path,
    own: bool = True,
    quiet: bool = False,
    replace: bool = False,
    policies: Mapping[str, GivenPolicy] | None = None,
    typed: Sequence[str] = (),
) -> Rows:
    """Evaluate a policy or rule, compared strategies and baselines.

    All have the same profiles, drivers and noise. Writes config.yaml, steps.parquet,
    episodes.parquet and figures.

    Args:
        cfg: configuration of the entry point ``evaluate``; with ``resume`` the run in that folder
            is resumed with its settings.
        folder: folder of the results.
        own: evaluate the configuration's variant, too, not only compared strategies.
        quiet: write the rows only, without tables and figures.
        replace: overwrite an evaluation of other settings.
        policies: further policies by their names in tables.
        typed: overrides, to refuse those without effect.

    Returns:
        The rows of episodes.parquet; many rows as a dataset, which is read on demand.

    Raises:
        LccError: for any error in settings, data or files, in one line.
    """
    folder = Path(folder)
    if cfg.resume is not None:
        folder, cfg = Path(cfg.resume), resumed_config(cfg.resume, cfg.trust)
    else:
        cfg = with_inputs(cfg)
    given = policies or {}
    with claim(folder):
        if not replace:
            check_folder(cfg, folder)
        prepare_torch(cfg)
        check_measured(cfg)
        entrants = Entrants(cfg, own, given, typed)
        inputs = load_inputs(cfg)
        log_report(filter(None, [*inputs.report, other_drivers(cfg), classes(cfg)]))
        comparison = Comparison(cfg, inputs, entrants.strategies(inputs))
        if replace:  # rows of other settings must not be in a folder with this configuration
            (folder / EPISODES).unlink(missing_ok=True)
        save_config(cfg, folder)
        if not quiet:
            (folder / UNDRAWN).touch()
        rows = evaluate_and_write(comparison, inputs, folder, quiet)
        for message in filter(None, (policy.clipped() for policy in given.values())):
            log.warning(message)
        if not quiet:
            draw(rows, cfg, folder)
        return rows


def made_by(table: Path) -> str | None:
    """Return the hash of the configuration of a table; None without a table."""
    return parquet_metadata(table).get(IDENTITY) if table.exists() else None


def complete(cfg: EvaluateConfig, folder: Path, typed: Sequence[str] = ()) -> None:
    """Complete a run of a sweep: skip a finished one, resume a stopped one."""
    table = folder / EPISODES
    if made_by(table) == identity(cfg):
        log.info("%s: finished before", folder.name)
        forget(folder)
        if (folder / UNDRAWN).exists():
            with claim(folder):
                draw(as_rows(table), cfg, folder)
        return
    check_folder(cfg, folder, "inputs")  # with other files it is repeated
    run(cfg, folder, quiet=cfg.evaluation.shards > 1, replace=True, typed=typed)
    forget(folder)


def draw(rows: Rows, cfg: EvaluateConfig, folder: Path) -> None:
    """Draw the figures of an evaluation into its folder, unless it has too many rows."""
    if isinstance(rows, pd.DataFrame):
        # Here, because a training draws nothing and need not load matplotlib.
        from lcc_rl.figures.evaluation import write_figures

        names = [name for name in rows["strategy"].unique() if not is_shipped(name)]
        write_figures(folder, cfg.evaluation.rows, list(reports(rows, cfg)), names)
    else:
        log.info("no figures: there are more than %d rows", FEW)
    (folder / UNDRAWN).unlink(missing_ok=True)


def evaluate_and_write(comparison: Comparison, inputs: Inputs, folder: Path, quiet: bool) -> Rows:
    """Play a comparison, write its rows and print the tables.

    Returns:
        The rows; many rows as a dataset, which is read on demand.
    """
    cfg, rows = comparison.cfg, comparison.play(folder)
    if cfg.evaluation.rows == "episodes":
        windows = windows_for(rows)
        for line in [*leader_too_fast(windows, cfg.task is not None), *remarks(windows)]:
            log.warning(line)
    if not quiet:
        show_tables(rows, cfg, inputs)
    return rows


def reports(rows: Rows, cfg: StudyConfig, against: str | None = None) -> Iterator[Report]:
    """Yield the report of each source of leaders or case of a platoon."""
    check_table_unit(cfg)
    if isinstance(rows, pd.DataFrame) and cfg.evaluation.rows == "vehicles":
        for source, group in by_source(rows):
            of = f"{source}: " if source else ""
            for case in dict.fromkeys(group["case"]):
                yield case_report(group, case, f"{of}{case}")
        return
    notes = list(filter(None, [other_drivers(cfg), classes(cfg)]))
    task, energy, second = task_of(cfg), build_energy(cfg), second_energy(cfg)
    of_sweep = rows.attrs.get("remarks", ()) if isinstance(rows, pd.DataFrame) else ()
    for source, group in by_source(windows_for(rows)):
        result = report(group, task, energy, source, against=against, second=second, unit=cfg.unit)
        windows, drivers = group["profile_id"].nunique(), int(group["drivers"].max())
        size = size_in_words(cfg, windows, drivers)
        yield dataclasses.replace(result, remarks=[*result.remarks, *notes, *of_sweep], size=size)


def size_in_words(cfg: StudyConfig, windows: int, drivers: int, which: str = "") -> str:
    """Return the numbers of windows, drivers, repeats and counted steps in words."""
    settings, size = cfg.evaluation, size_of(windows, drivers, which)
    size += f" × {settings.repeats} repeats" if settings.repeats > 1 else ""
    size += f", shard {settings.shard} of {settings.shards}" if settings.shards > 1 else ""
    size += f", {cfg.scenario.horizon} steps"
    return size + (f", after {settings.warm_up:g} s" if settings.warm_up else "")


def show_tables(rows: Rows, cfg: StudyConfig, inputs: Inputs) -> None:
    """Print the tables of an evaluation, short or, with ``table=all``, full."""
    plan = plan_of(cfg, inputs)
    counts = Counter(inputs.evaluation.sources or [""] * plan.profiles)
    for result in reports(rows, cfg):
        title = result.of
        if result.of in counts:
            of = [x for x in (cfg.task and str(cfg.task["name"]), result.of) if x]
            which = "held-out " * bool(len(inputs.training))
            size = size_in_words(cfg, counts[result.of], len(plan.chosen), which)
            title = ": ".join([*of, size])
        print_table(terminal(result, title, cfg.table == "all"))
    seconds = cfg.scenario.horizon * cfg.scenario.time_step
    if warning := few_windows(plan.profiles, seconds):
        log.info(warning)


@dataclasses.dataclass(frozen=True)
class Run:
    """The results of a training or an evaluation.

    Args:
        folder: folder of the configuration, the parquet tables, and the policy of a training.
        rows: one row per episode, or vehicle of an episode, as in episodes.parquet; many rows as a
            dataset, which is read on demand.

    ``print(run)`` shows the tables that commands print. A run stands for the path of its folder.
    """

    folder: Path
    rows: Rows
    cfg: StudyConfig

    def __fspath__(self) -> str:
        return str(self.folder)

    def __str__(self) -> str:
        return self.printed()

    def printed(self, full: bool = False, against: str | None = None) -> str:
        """Return the tables that commands print; ``full``: with all measures."""
        console = Console(width=WIDTH)
        with console.capture() as text:
            for report in self.reports(against):
                console.print(terminal(report, report.of, full))
        return text.get().rstrip()

    def reports(self, against: str | None = None) -> list[Report]:
        """Return the report of each source of leaders or case of a platoon.

        Args:
            against: the baseline of savings; by default that of tables.
        """
        return list(reports(self.rows, self.cfg, against))

    @cached_property
    def table(self) -> pd.DataFrame:
        """All measures: a row per strategy with energies, savings with intervals and safety.

        For a task, scores and limits come first. Several sources or cases are named in ``of``.
        """
        return together(self.reports()).table

    @cached_property
    def headline(self) -> pd.DataFrame:
        """The table that commands print: energy or a task's score, distance and safety.

        Several sources of leaders, or cases of a platoon, are named in ``of``.
        """
        return together(self.reports()).short

    @cached_property
    def training(self) -> pd.DataFrame:
        """A row per iteration; a ResultsError without a training."""
        return read_parquet(self.folder / RECORD)

    @cached_property
    def steps(self) -> pd.DataFrame:
        """Sample episodes as time series."""
        return read_parquet(self.folder / STEPS)
