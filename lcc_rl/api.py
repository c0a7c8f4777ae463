"""Training and evaluation as functions that return objects, for notebooks and programs."""

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
from lcc_rl.config import load
from lcc_rl.config.schemas import StudyConfig
from lcc_rl.evaluation.foreign import as_given
from lcc_rl.evaluation.named import setting_of
from lcc_rl.io.files import Rows, read_parquet
from lcc_rl.results import render
from lcc_rl.results.report import Report, together


@dataclass(frozen=True)
class Run:
    """The results of a training or an evaluation.

    Args:
        folder: its files: configuration, parquet tables, and the policy of a training.
        rows: one row per episode, or vehicle of an episode, as in episodes.parquet; of many a
            dataset that is not read yet.
        cfg: its configuration.

    ``print(run)`` shows the tables that commands print; where a path is expected, a run is that of
    its folder.
    """

    folder: Path
    rows: Rows
    cfg: StudyConfig

    def __fspath__(self) -> str:
        return str(self.folder)

    def __str__(self) -> str:
        return self.printed()

    def printed(self, full: bool = False, against: str | None = None) -> str:
        """Return the tables that commands print, with ``full`` of every measure."""
        console = Console(width=render.WIDTH)
        with console.capture() as text:
            for one in self.reports(against):
                console.print(render.terminal(one, one.of, full))
        return text.get().rstrip()

    def reports(self, against: str | None = None) -> list[Report]:
        """Return the report of each source of leaders, or case of a platoon.

        Args:
            against: the strategy that savings are against; by default as in tables.
        """
        return list(evaluation.reports(self.rows, self.cfg, against))

    @cached_property
    def table(self) -> pd.DataFrame:
        """Every measure: a row per strategy with energies, savings with intervals and safety.

        Of a task its scores and limits come first. Several sources or cases as below.
        """
        return together(self.reports()).table

    @cached_property
    def headline(self) -> pd.DataFrame:
        """The table that commands print: energy or a task's score, distance and safety.

        Of several sources of leaders, or cases of a platoon, the rows of each, named in ``of``.
        """
        return together(self.reports()).short

    @cached_property
    def training(self) -> pd.DataFrame:
        """A row per iteration; a ResultsError where nothing was learned."""
        return read_parquet(self.folder / training.RECORD)

    @cached_property
    def steps(self) -> pd.DataFrame:
        """Sample episodes as time series."""
        return read_parquet(self.folder / evaluation.STEPS)


def learn(
    variant: str = "alcc", overrides: Sequence[str] = (), folder: str | Path | None = None
) -> Run:
    """Train a variant and evaluate it, as ``lcc-rl train`` does.

    Args:
        variant: ``"alcc"``, ``"reference"`` … (``conf/variant``).
        overrides: further settings, ``["experiment=limits", "seed=3"]``.
        folder: where the files go; a training that it holds is resumed. By default a new one
            below ``outputs/train``.

    Returns:
        The run, whose ``rows`` are of the held-out windows.

    Raises:
        LccError: one clear error for whatever is wrong with settings, data or files.

    Examples:
        >>> run = learn("alcc", ["experiment=smoke"], "outputs/mine")  # doctest: +SKIP
        >>> run.table[["strategy", "total_path_energy_kj"]]  # doctest: +SKIP
    """
    target = _folder("train", variant, folder)
    cfg = load("train", [f"variant={variant}", *overrides])
    return Run(target, training.run(cfg, target, quiet=True, resume=True), cfg)


def compare(
    strategies: Any,
    variant: str = "alcc",
    overrides: Sequence[str] = (),
    folder: str | Path | None = None,
) -> Run:
    """Evaluate policies and controllers on the same held-out windows, beside the baselines.

    Args:
        strategies: one or several: runs, run folders, policy files, ``"pretrained/alcc"``;
            controllers as names, objects, classes, plain functions of named entries
            (:class:`lcc_rl.pieces.Law`) or yaml files; policies of other libraries, see
            :mod:`lcc_rl.evaluation.foreign`, which read the variant's observation; or these by the
            names of their rows. A name that ends in ``_filtered`` means behind the safety filter.
        variant: whose scenario and data they meet.
        overrides: further settings, ``["evaluation.drivers=12"]``.
        folder: where the files go, figures among them; by default a new one below
            ``outputs/evaluate``, without figures, which take seconds.

    Returns:
        The run, with the rows of all strategies.

    Raises:
        LccError: one clear error for whatever is wrong with settings, data or files.

    Examples:
        >>> found = compare([run, "pretrained/alcc_limits", "idm_acc"])  # doctest: +SKIP
        >>> found = compare({"slow": PID(gain=0.1), "fast": PID(gain=0.4)})  # doctest: +SKIP
    """
    target = _folder("evaluate", variant, folder)
    cfg = load("evaluate", [f"variant={variant}", *overrides])
    if isinstance(strategies, (str, PathLike)) or not isinstance(strategies, Iterable):
        strategies = [strategies]
    named = isinstance(strategies, Mapping)
    items = strategies.items() if named else [(type(one).__name__, one) for one in strategies]
    given = [(name, one, as_given(one, name)) for name, one in items]
    policies = {name: policy for name, _, policy in given if policy is not None}
    others = [(name, one) for name, one, policy in given if policy is None]
    if named:
        cfg.compare = {name: setting_of(one, f"compare.{name}") for name, one in others}
    else:
        cfg.compare = [setting_of(one) for _, one in others]
    rows = evaluation.run(cfg, target, own=False, quiet=True, policies=policies)
    if folder is not None:
        evaluation.draw(rows, cfg, target)
    return Run(target, rows, cfg)


def _folder(kind: str, variant: str, folder: str | Path | None) -> Path:
    if folder is not None:
        return Path(folder)
    return Path("outputs") / kind / f"{datetime.now():%Y-%m-%d_%H-%M-%S-%f}_{variant}"
