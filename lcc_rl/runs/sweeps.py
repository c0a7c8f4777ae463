"""Sweeps: names of folders (also of single runs), plan, runs and final report."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import re
import shlex
import sys
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from shutil import which
from typing import Any, ClassVar, NoReturn

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import configure_log
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, read_write
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from rich.live import Live

from lcc_rl.config.compose import NOT_IDENTITY, composed, identity, parsed
from lcc_rl.config.words import key_of
from lcc_rl.errors import ConfigError, Interrupted, LccError
from lcc_rl.io.atomic import atomic_path, remove_leftovers
from lcc_rl.runs.interrupts import BAD_INPUT, end_with_parent, was_interrupted
from lcc_rl.runs.overview import live
from lcc_rl.runs.plans import MOST_RUNS, PLAN, RUN_HASH, SweepPlan, read_plan
from lcc_rl.runs.states import (
    CONFIG,
    Busy,
    busy,
    described_error,
    is_claimed,
    no_run,
    record,
    survey,
)

log = logging.getLogger("lcc_rl")

LONGEST_NAME = 100  # characters of a folder's name before the hash
SILENT = logging.CRITICAL + 1
ROUNDED = re.compile(r"\d*\.\d{15,}(?:e-?\d+)?")  # 0.8999999999999999 of Hydra's range(0,0.9,0.3)


def sweep_name(given: str | None, typed: Sequence[str]) -> str:
    """Return the given name of a sweep's folder, or a hash of its overrides in any order."""
    if given:
        return str(given)
    kept = sorted(result_overrides(typed))
    return f"sweep_{hashlib.sha256(json.dumps(kept).encode()).hexdigest()[:8]}"


def chosen_folder(resumed: str | None, fresh: str) -> str:
    """Return the folder of a run: that of a resumed run, which must exist, or a new one."""
    if resumed and not (Path(resumed) / CONFIG).is_file():
        raise ConfigError(f"resume={no_run(Path(resumed))}")
    return str(resumed or fresh)


def hydra_folder(folder: str | None) -> str | None:
    """Return the folder of Hydra's settings; None in a folder that already holds a run."""
    return None if folder and (Path(folder) / CONFIG).is_file() else ".hydra"


def run_name(*, _root_: DictConfig) -> str:
    """Return the name of a run's folder: varied overrides and hash of the configuration.

    An existing folder with the same hash is reused.
    """
    settings = OmegaConf.masked_copy(_root_, [str(key) for key in _root_ if key != "hydra"])
    mark, _ = _hashed(settings, _root_.hydra.job.config_name, words_of(_root_))
    sweep = Path(_root_.hydra.sweep.dir)
    for folder in sorted(sweep.glob(f"*{mark}")):
        return folder.name
    typed, varied = result_overrides(words_of(_root_)), read_plan(sweep).varied
    # A comma would separate two values in a setting that names the folder.
    shown = "+".join(item.lstrip("+") for item in typed if key_of(item) in varied)
    text = re.sub(r"[^\w.=+~-]+", "-", shown).strip("-")[:LONGEST_NAME]
    return f"{text}_{mark}".lstrip("_")


def _hashed(settings: DictConfig, entry: str, typed: list[str]) -> tuple[str, LccError | None]:
    """Return a short hash of a run's settings, of its words if invalid, and why they are."""
    try:
        return identity(parsed(settings, entry, typed, sweep=True), "inputs")[:8], None
    except LccError as error:
        return hashlib.sha256(json.dumps(typed).encode()).hexdigest()[:8], error


def words_of(config: DictConfig) -> list[str]:
    """Return the command line with references such as ``${seed}`` as plain text."""
    typed: Any = OmegaConf.to_container(config.hydra.overrides.task, resolve=False)
    return [str(item) for item in typed]


def result_overrides(typed: Sequence[str]) -> list[str]:
    """Return the overrides that change a result."""
    return [item.removeprefix("++") for item in typed if key_of(item) not in NOT_IDENTITY]


def parallel_jobs(threads: int) -> int:
    """Return the number of parallel jobs of ``threads`` threads for this machine's cores."""
    usable = getattr(os, "sched_getaffinity", None)
    cores = len(usable(0)) if usable else os.cpu_count() or 1
    return max(1, cores // max(1, int(threads)))


OmegaConf.register_new_resolver("lcc.folder", chosen_folder, replace=True)
OmegaConf.register_new_resolver("lcc.hydra", hydra_folder, replace=True)
# Cached, so that every job gets the folder of the whole command.
OmegaConf.register_new_resolver("lcc.sweep", sweep_name, use_cache=True, replace=True)
OmegaConf.register_new_resolver("lcc.run", run_name, replace=True)
OmegaConf.register_new_resolver("lcc.jobs", parallel_jobs, replace=True)


class SweepCallback(Callback):
    """Writes the plan of a sweep at its start and draws its runs on a terminal.

    A single run is refused in a folder that another process uses.
    """

    folder: Path | None = None  # folder of this process's sweep; Hydra does not store it
    plan: ClassVar[SweepPlan] = SweepPlan()  # of that sweep
    target: ClassVar[Path | None] = None  # the folder that Hydra writes to
    made: ClassVar[list[Path]] = []  # it and its parents, if this command creates them
    table: Live | None = None
    lines: ClassVar[Any] = None  # logging configuration without a table

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Exit with one line before Hydra writes into the folder of another process's run."""
        type(self).target, type(self).made = None, []
        try:
            type(self).target = folder = Path(config.hydra.run.dir)
            type(self).made = [x for x in (folder, *folder.parents) if not os.path.lexists(x)]
        except OmegaConfBaseException:  # resume=nowhere: Hydra raises the error later
            return
        if is_claimed(folder):
            refuse(busy(folder))

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Write the plan and log the folder; exit with one line if the sweep cannot run."""
        launcher = str(config.hydra.launcher.get("_target_"))
        if launcher.endswith(".SlurmLauncher") and which("srun") is None:
            refuse("there is no SLURM here (no srun); use hydra/launcher=lcc_submitit_local")
        limit_batches(config)
        folder = Path(config.hydra.sweep.dir)
        plan = make_plan(config)
        if not plan.runs:
            refuse("nothing is swept: a list of values is empty")
        if plan.runs > MOST_RUNS:
            refuse(f"a sweep has at most {MOST_RUNS} runs")
        warn_of_rounding(plan)
        if str(config.hydra.sweeper.get("_target_")).endswith(BasicSweeper.__name__):
            marks = check_cells(config, plan.varied)
            plan = replace(plan, runs=len({*marks}) or plan.runs, marks=marks)
        type(self).folder = type(self).target = folder
        type(self).plan = plan
        with atomic_path(folder / PLAN) as temporary:
            whole = asdict(plan.after(read_plan(folder)))
            temporary.write_text(json.dumps(whole), encoding="utf-8")
        words = "sweep of %d runs in %s; watch it with: lcc-rl status %s"
        log.info(words, plan.runs, folder, shlex.quote(str(folder)))
        if not any(state.state == "running" for state in survey(folder)):
            remove_leftovers(folder)
        if sys.stdout.isatty():
            self._draw(config, plan.runs)

    @classmethod
    def _draw(cls, config: DictConfig, planned: int) -> None:
        """Show a table in place of log lines, which Hydra configures again for every run."""
        hydra = config.hydra
        cls.lines = hydra.hydra_logging.copy()
        with read_write(config):
            OmegaConf.update(hydra.hydra_logging, "root.handlers", [], force_add=True)
        mute()
        cls.table = live(Path(hydra.sweep.dir), lambda: planned, Console(highlight=False))
        cls.table.start(refresh=True)

    @classmethod
    def end(cls) -> Path | None:
        """Stop the table; return the folder of the sweep or None."""
        if cls.table is not None:
            cls.table.stop()
            configure_log(cls.lines)
        folder, cls.folder, cls.table = cls.folder, None, None
        return folder


def refuse(reason: object) -> NoReturn:
    """Exit with one line; other exceptions of a callback become warnings in Hydra."""
    print(f"lcc_rl: error: {reason}", file=sys.stderr)
    sys.exit(BAD_INPUT)


def mute() -> None:
    """Disable log lines on the terminal, not in log files."""
    for handler in logging.getLogger().handlers:
        if type(handler) is logging.StreamHandler:
            handler.setLevel(SILENT)


def limit_batches(config: DictConfig) -> None:
    """Limit submitit on one machine to the number of parallel jobs of its cores."""
    hydra = config.hydra
    if not str(hydra.launcher.get("_target_")).endswith(".LocalLauncher"):
        return
    if "max_batch_size" in hydra.sweeper and hydra.sweeper.max_batch_size is None:
        with read_write(config):
            hydra.sweeper.max_batch_size = parallel_jobs(config.threads)


def words_of_sweep(config: DictConfig) -> list[str]:
    """Return the command line of a sweep and the parameters of its sweeper."""
    params = config.hydra.sweeper.get("params") or {}
    return [*words_of(config), *(f"{key}={value}" for key, value in params.items())]


def make_plan(config: DictConfig) -> SweepPlan:
    """Return the plan of a sweep's configuration."""
    read = OverridesParser.create().parse_overrides(result_overrides(words_of_sweep(config)))
    swept = {item.get_key_element(): item for item in read if item.is_sweep_override()}
    varied = [key_of(key) for key in swept]
    listed = (islice(item.sweep_string_iterator(), MOST_RUNS + 1) for item in swept.values())
    values = [[*dict.fromkeys(some)] for some in listed]  # a value may be typed twice
    return SweepPlan(math.prod(map(len, values)), varied, values)


def warn_of_rounding(plan: SweepPlan) -> None:
    """Log settings whose values have the rounding errors of Hydra's range() with decimals."""
    for key, values in zip(plan.varied, plan.values, strict=True):
        if rounded := [value for value in values if ROUNDED.search(value)]:
            listed = ",".join(ROUNDED.sub(lambda x: f"{float(x[0]):.9g}", x) for x in values)
            words = "%s=%s: range() rounds decimals in this way; list the values: %s=%s"
            log.warning(words, key, rounded[-1], key, listed)


def check_cells(config: DictConfig, varied: Collection[str]) -> list[str]:
    """Log which cells of a sweep will fail, and why, and which are one run; return their hashes.

    The hashes have the order of the cells of the plan, whose keys are ``varied``. There are none if
    a setting such as ``${hydra:…}`` has its value in a run only.

    Raises:
        SystemExit: for a choice that no file has, with which Hydra does not start a sweep.
    """
    read = OverridesParser.create().parse_overrides(words_of_sweep(config))
    entry = config.hydra.job.config_name
    marks: dict[tuple[str, ...], str] = {}  # by the values of a cell
    first: dict[str, list[str]] = {}
    same: dict[str, None] = {}
    known = True  # whether all hashes are those of the runs
    for words in BasicSweeper.split_arguments(read, None)[0]:
        try:
            mark, error = _hashed(composed(entry, words), entry, words)
        except ConfigError as refused:
            refuse(refused)
        own = [item.lstrip("+") for item in words if key_of(item) in varied]
        if "HydraConfig was not set" in str(error):  # ${hydra:…} has its value in a run only
            known = False
        elif error:
            log.error("will fail: %s%s", f"{' '.join(own)}: " * bool(own), error)
        pairs = zip(own, first.setdefault(mark, own), strict=True)
        if others := [pair for pair in pairs if pair[0] != pair[1]]:
            one, other = map(" ".join, zip(*others, strict=True))
            same[f"{one} is the same run as {other}"] = None
        marks[tuple(item.partition("=")[2] for item in own)] = mark
    for line in same:
        log.warning(line)
    return [*marks.values()] if known else []


def run_job(function: Callable[[DictConfig], Any], cfg: DictConfig, folder: Path) -> Any:
    """Execute one run of a sweep; an error is recorded in its folder and does not stop the sweep.

    Returns:
        The function's result; None if it failed.
    """
    end_with_parent()  # as a process of joblib
    if sys.stdout.isatty():
        mute()
    try:
        return function(cfg)
    except Interrupted as error:
        log.info("%s", error)
        # Another exception would stop this run only.
        raise KeyboardInterrupt from error
    except Busy as error:
        log.info("%s: skipped", error)
        return None
    except Exception as error:
        if was_interrupted(error):  # a library converted the interrupt to this error
            raise KeyboardInterrupt from error
        record(folder, error)
        log.error("%s failed: %s", folder.name, described_error(error))
        return None


def conclude(folder: Path, plan: SweepPlan) -> None:
    """Log the result of a sweep; raise if runs of its plan failed, or were refused."""
    every, cells = survey(folder), {*plan.marks}
    own = [x for x in every if not cells or {*RUN_HASH.findall(x.name)} <= cells]
    finished = [state for state in own if state.state == "finished"]
    failed = [state for state in own if state.state == "failed"]
    refused = [state for state in finished if state.error]
    log.info("%d of %d runs finished, in %s", len(finished), len(own), folder)
    if len(finished) > 1 and next(folder.glob("*/episodes.parquet"), None):
        log.info("side by side: lcc-rl table %s --figure sweep.png", shlex.quote(str(folder)))
    if others := sum(state.state == "failed" for state in every) - len(failed):
        log.warning("%d failed runs in the folder are of other commands", others)
    for state in failed:
        log.error("failed: %s: %s", state.name, state.error)
    for state in refused:
        log.error("%s: %s", state.name, state.error)  # "not repeated: …"
    if failed or refused:
        begun = any((folder / x.name / CONFIG).is_file() for x in failed)
        again = "; the same command repeats those that had begun" * begun
        named = ((failed, f"failed{again}"), (refused, "keep earlier rows"))
        what = " and ".join(f"{len(x)} of {len(own)} runs {how}" for x, how in named if x)
        raise LccError(f"{what} (reasons: error.txt in the folder of each run, {folder})")
