"""Repeat a run from its folder and compare the rows.

lcc-rl repeat outputs/train/<run>               # into outputs/repeat/<run>
lcc-rl repeat outputs/train/<run> --out again

The settings, with those of own classes and configuration files, are in the run's config.yaml, and
so are the hashes of the data and modules that it read; other ones are refused. Rows are equal on
the same machine, with the same versions. The exit code is 1 if they are not.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lcc_rl.commands import calibration, evaluation, pipeline, training
from lcc_rl.config.schemas import CalibrateConfig, EvaluateConfig, PipelineConfig
from lcc_rl.errors import require
from lcc_rl.io.files import read_parquet
from lcc_rl.results.runs import PARTS, resumed_config
from lcc_rl.runs.arguments import Arguments
from lcc_rl.runs.states import CONFIG

NOT_COMPARED = {"timing.parquet"}  # seconds


def repeat(folder: Path, target: Path, trust: Sequence[str] = ()) -> None:
    """Repeat a run with its settings.

    Args:
        folder: the run's folder.
        target: a new folder.
        trust: modules outside this package that the settings may name.

    Raises:
        LccError: if the folder holds no run, a file that it read has changed, or the target exists.
    """
    cfg = resumed_config(folder, trust)
    require(any(folder.rglob("*.parquet")), f"{folder}: no rows to compare; resume the run")
    message = f"{target} exists already, or lies in the run; choose another with --out"
    require(not target.exists() and folder.resolve() not in target.resolve().parents, message)
    target.mkdir(parents=True)
    for name in (CONFIG, pipeline.COMMAND_FILE):
        if (folder / name).is_file():
            shutil.copy(folder / name, target)
    if isinstance(cfg, CalibrateConfig):
        calibration.run(cfg, target)
        return
    cfg = cfg.with_(resume=str(target))
    if isinstance(cfg, PipelineConfig):
        shutil.copytree(folder / PARTS, target / PARTS)
        pipeline.run(cfg, target, [])
    else:
        (evaluation if isinstance(cfg, EvaluateConfig) else training).run(cfg, target)


def compared(folder: Path, target: Path) -> Iterator[tuple[str, bool]]:
    """Yield for each table of a run a sentence, and whether that of the other run equals it."""
    for path in sorted(folder.rglob("*.parquet")):
        name = path.relative_to(folder)
        if path.name in NOT_COMPARED or any(part.startswith(".") for part in name.parts):
            continue
        if not (target / name).is_file():
            yield f"{name}: not written", False
            continue
        one, other = read_parquet(path), read_parquet(target / name)
        if one.equals(other):
            yield f"{name}: {len(one):,} rows, equal", True
        elif len(one) != len(other) or list(one) != list(other):
            yield f"{name}: {one.shape} against {other.shape} rows and columns", False
        else:
            named = [str(key) for key in one if not one[key].equals(other[key])]
            sizes = (_largest(one[key], other[key]) for key in named)
            size = max(sizes, key=lambda x: -1.0 if np.isnan(x) else x)
            columns = ", ".join(named[:3]) + ", …" * (len(named) > 3)
            text = f"{len(named)} of {one.shape[1]} columns differ ({columns}), by up to {size:.2g}"
            yield f"{name}: {len(one):,} rows, {text}", False


def _largest(one: pd.Series, other: pd.Series) -> float:
    """Return the largest difference as a share; inf if a number is missing, nan for text."""
    if not all(map(pd.api.types.is_numeric_dtype, (one, other))):
        return float("nan")
    if (one.isna() != other.isna()).any():
        return float("inf")
    first, second = one.to_numpy(float), other.to_numpy(float)
    scale = np.maximum(np.maximum(np.abs(first), np.abs(second)), 1e-12)
    return float(np.nanmax(np.abs(first - second) / scale, initial=0.0))


def main(arguments: Sequence[str] | None = None) -> Any:
    """Repeat the run of the command line."""
    parser = Arguments(prog="lcc-rl repeat", description=__doc__)
    parser.add_argument("run", type=Path, help="folder of a training, evaluation, job, calibration")
    parser.add_argument("--out", type=Path, help="new folder; by default outputs/repeat/<run>")
    parser.add_trust()
    options = parser.parse_args(arguments)
    target = options.out or Path("outputs", "repeat", options.run.resolve().name)
    repeat(options.run, target, options.trust)
    tables = [*compared(options.run, target)]
    print("\n".join(sentence for sentence, _ in tables))
    equal = bool(tables) and all(alike for _, alike in tables)
    print(f"{target}: {'all rows are equal' if equal else 'rows differ'}")
    return int(not equal)
