"""Speed records and drive cycles: reading from files and resampling."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

import lcc_rl.assets
from lcc_rl.data.plausible import Plausible
from lcc_rl.errors import DataError

CYCLES = Path(lcc_rl.assets.__file__).parent / "cycles"
TIME, SPEED = "time_s", "speed_mps"
LEADER = "leader.plausible"  # where a configuration has the thresholds of speed records


def shipped_cycles() -> list[str]:
    """Return the names of the drive cycles in the package."""
    return sorted(path.stem for path in CYCLES.glob("*.csv"))


def read_speed_record(
    path: str, plausible: Plausible | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Read a speed record of any sampling rate.

    Args:
        path: name of a shipped cycle (``udds``, ``us06``, ``wltc_3b``, ``hwfet``), or a .csv or
            .parquet file with the columns ``time_s`` [s] and ``speed_mps`` [m/s].
        plausible: thresholds that every sample must keep; None for the defaults.

    Returns:
        Time [s], increasing, and speed [m/s], both ``[samples]``, float64.

    Raises:
        DataError: naming the file and the row or column at fault, also where a number is not
            malformed but implausible.
    """
    file = Path(path).expanduser()
    if not file.suffix and path in shipped_cycles():
        file = CYCLES / f"{path}.csv"
    if not file.is_file():
        raise DataError(
            f"{path}: no such file, and no shipped cycle ({', '.join(shipped_cycles())})"
        )
    try:
        frame = pd.read_parquet(file) if file.suffix == ".parquet" else pd.read_csv(file)
    except (ValueError, OSError) as error:
        raise DataError(f"{file}: not a readable table: {error}") from error
    time, speed = _checked(frame, str(file))
    record = pd.DataFrame({"episode": 0, TIME: time, SPEED: speed})
    limits = plausible or Plausible()
    limits.select(record, str(file), lambda row, name: f"data row {row + 1}, {name}", LEADER)
    return time, speed


def _checked(frame: pd.DataFrame, file: str) -> tuple[np.ndarray, np.ndarray]:
    """Time and speed of a table, or a DataError."""
    missing = {TIME, SPEED} - set(frame.columns)
    if missing:
        raise DataError(f"{file}: lacks the column {', '.join(sorted(missing))}")
    try:
        time, speed = (frame[name].to_numpy(float) for name in (TIME, SPEED))
    except (ValueError, TypeError) as error:
        raise DataError(f"{file}: {TIME} and {SPEED} must be numbers: {error}") from error
    if len(time) < 2:
        raise DataError(f"{file}: holds {len(time)} samples, at least 2 are needed")
    for wrong, words in (
        (~np.isfinite(time) | ~np.isfinite(speed), "is not a number"),
        (speed < 0, "has a negative speed"),
        (np.diff(time, prepend=-np.inf) <= 0, "does not follow the row before it in time"),
    ):
        if wrong.any():
            raise DataError(f"{file}: data row {int(wrong.argmax()) + 1} {words}")
    return time, speed


def resample(
    time: np.ndarray,
    speed: np.ndarray,
    time_step: float,
    begin: float | None = None,
    end: float | None = None,
) -> Tensor:
    """Interpolate a record to another step, monotonically between samples (PCHIP).

    The interpolant never overshoots its samples, so no speed becomes negative and no peak grows.

    Args:
        time: increasing [s].
        speed: [m/s].
        time_step: step wanted [s].
        begin, end: part of the record wanted [s]; None for all of it.

    Returns:
        Speeds, ``[steps]``, float32 [m/s].
    """
    from scipy.interpolate import PchipInterpolator  # here: it loads for a second

    begin, end = time[0] if begin is None else begin, time[-1] if end is None else end
    steps = int(np.floor((end - begin) / time_step + 1e-6)) + 1
    grid = np.minimum(begin + time_step * np.arange(steps), time[-1])
    return torch.tensor(PchipInterpolator(time, speed)(grid).clip(min=0.0), dtype=torch.float32)
