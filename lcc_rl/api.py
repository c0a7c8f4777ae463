"""Training and evaluation as functions, for notebooks and programs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console

from lcc_rl.commands import evaluation, training
from lcc_rl.config import load, with_variant
from lcc_rl.config.schemas import StudyConfig
from lcc_rl.errors import require
from lcc_rl.evaluation.foreign import as_given
from lcc_rl.evaluation.named import setting_of
from lcc_rl.io.files import Rows, read_parquet
from lcc_rl.results import render
from lcc_rl.results.report import Report, together
from lcc_rl.results.runs import STEPS
from lcc_rl.runs.output import repeated_warnings_left_out


@dataclass(frozen=True)
class Run:
    """The results of a training or an evaluation.

    Args:
        folder: folder of the configuration, the parquet tables, and the policy of a training.
        rows: one row per episode, or vehicle of an episode, as in episodes.parquet; many rows as a
            dataset, which is read on demand.
        cfg: its configuration.
        unit: energy per distance of its tables, ``"kWh/100km"``; by default that of the task, or
            kJ/km, and g/km for one fuel.

    ``print(run)`` shows the tables that commands print. A run stands for the path of its folder.
    """

    folder: Path
    rows: Rows
    cfg: StudyConfig
    unit: str | None = None

    def __fspath__(self) -> str:
        return str(self.folder)

    def __str__(self) -> str:
        return self.printed()

    def printed(self, full: bool = False, against: str | None = None) -> str:
        """Return the tables that commands print; ``full``: with all measures."""
        console = Console(width=render.WIDTH)
        with console.capture() as text:
            for report in self.reports(against):
                console.print(render.terminal(report, report.of, full))
        return text.get().rstrip()

    def reports(self, against: str | None = None) -> list[Report]:
        """Return the report of each source of leaders or case of a platoon.

        Args:
            against: the baseline of savings; by default that of tables.
        """
        return list(evaluation.reports(self.rows, self.cfg, against, self.unit))

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
        return read_parquet(self.folder / training.RECORD)

    @cached_property
    def steps(self) -> pd.DataFrame:
        """Sample episodes as time series."""
        return read_parquet(self.folder / STEPS)


def learn(
    variant: str = "alcc", overrides: Sequence[str] = (), folder: str | Path | None = None
) -> Run:
    """Train a variant and evaluate it, as ``lcc-rl train`` does.

    Args:
        variant: ``"alcc"``, ``"reference"`` … (``conf/variant``).
        overrides: further settings, ``["experiment=limits", "seed=3"]``.
        folder: folder of the results; a training in it is resumed. By default a new one below
            ``outputs/train``.

    Returns:
        The run, with the rows of the held-out windows.

    Raises:
        LccError: for any error in settings, data or files, in one line.

    Examples:
        >>> run = learn("alcc", ["experiment=smoke"], "outputs/mine")  # doctest: +SKIP
        >>> run.table[["strategy", "total_path_energy_kj"]]  # doctest: +SKIP
    """
    target = _folder("train", variant, folder)
    cfg = load("train", with_variant(variant, overrides))
    return Run(target, training.run(cfg, target, quiet=True, resume=True), cfg)


def compare(
    strategies: Any,
    variant: str = "alcc",
    overrides: Sequence[str] = (),
    folder: str | Path | None = None,
) -> Run:
    """Evaluate policies, controllers and baselines on the same held-out windows.

    Args:
        strategies: one or several strategies, or a mapping of them by name: runs, run folders,
            policy files, ``"pretrained/alcc"``; controllers as names, objects, classes, plain
            functions of named entries (:class:`lcc_rl.pieces.Law`) or yaml files; policies of
            other libraries, see :mod:`lcc_rl.evaluation.foreign`, with the variant's observation.
            Append ``_filtered`` to a name to put the controller behind the safety filter.
        variant: variant of the scenario and the data.
        overrides: further settings, ``["evaluation.drivers=12"]``.
        folder: folder of the results and figures; by default a new one below
            ``outputs/evaluate``, without figures, which take seconds.

    Returns:
        The run, with the rows of all strategies. Further calls do not repeat a warning.

    Raises:
        LccError: for any error in settings, data or files, in one line.

    Examples:
        >>> found = compare([run, "pretrained/alcc_limits", "idm_acc"])  # doctest: +SKIP
        >>> found = compare({"slow": PID(gain=0.1), "fast": PID(gain=0.4)})  # doctest: +SKIP
    """
    target, typed = _folder("evaluate", variant, folder), with_variant(variant, overrides)
    cfg = load("evaluate", typed)
    if isinstance(strategies, (str, PathLike)) or not isinstance(strategies, Iterable):
        strategies = [strategies]
    named = isinstance(strategies, Mapping)
    pairs = strategies.items() if named else [(type(x).__name__, x) for x in strategies]
    valid = pairs and all(isinstance(name, str) for name, _ in pairs)
    require(valid, f"compare: expected strategies, or a mapping of them by name: {strategies!r}")
    resolved = [(name, x, as_given(x, name)) for name, x in pairs]
    policies = {name: policy for name, _, policy in resolved if policy is not None}
    rules = [(name, x) for name, x, policy in resolved if policy is None]
    if named:
        spec: Any = {name: setting_of(x, f"compare.{name}") for name, x in rules}
    else:
        spec = [setting_of(x) for _, x in rules]
    cfg = cfg.with_(compare=spec)
    with repeated_warnings_left_out():
        rows = evaluation.run(cfg, target, own=False, quiet=True, policies=policies, typed=typed)
    if folder is not None:
        evaluation.draw(rows, cfg, target)
    return Run(target, rows, cfg)


def _folder(kind: str, variant: str, folder: str | Path | None) -> Path:
    if folder is not None:
        return Path(folder)
    return Path("outputs") / kind / f"{datetime.now():%Y-%m-%d_%H-%M-%S-%f}_{variant}"
