"""Training and evaluation as functions that return objects, for notebooks and programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path

import pandas as pd

from lcc_rl.commands import evaluation, training
from lcc_rl.config import load
from lcc_rl.io.files import Rows, read_parquet
from lcc_rl.results.tables import summary


@dataclass(frozen=True)
class Run:
    """What a training or an evaluation left behind.

    Args:
        folder: its files: configuration, parquet tables, and the policy of a training.
        rows: one row per episode, or vehicle of an episode, as in episodes.parquet; of many a
            dataset that is not read yet.
    """

    folder: Path
    rows: Rows

    @cached_property
    def table(self) -> pd.DataFrame:
        """A row per strategy: energies, savings with intervals, safety."""
        return summary(self.rows)

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
    return Run(target, training.run(cfg, target, quiet=True, resume=True))


def compare(
    strategies: Sequence[str | Path | Run],
    variant: str = "alcc",
    overrides: Sequence[str] = (),
    folder: str | Path | None = None,
) -> Run:
    """Evaluate policies and controllers on the same held-out windows, beside the baselines.

    Args:
        strategies: runs, run folders, policy files, ``"pretrained/alcc"`` or controllers' names.
        variant: whose scenario and data they meet.
        overrides: further settings, ``["evaluation.drivers=12"]``.
        folder: where the files go; by default a new one below ``outputs/evaluate``.

    Returns:
        The run, with the rows of all strategies.

    Raises:
        LccError: one clear error for whatever is wrong with settings, data or files.

    Examples:
        >>> found = compare([run, "pretrained/alcc_limits", "idm_acc"])  # doctest: +SKIP
    """
    target = _folder("evaluate", variant, folder)
    cfg = load("evaluate", [f"variant={variant}", *overrides])
    cfg.compare = [str(s.folder if isinstance(s, Run) else s) for s in strategies]
    return Run(target, evaluation.run(cfg, target, own=False, quiet=True))


def _folder(kind: str, variant: str, folder: str | Path | None) -> Path:
    if folder is not None:
        return Path(folder)
    return Path("outputs") / kind / f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{variant}"
