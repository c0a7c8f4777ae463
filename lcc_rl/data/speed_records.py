"""Speed records and drive cycles: reading from files and resampling."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

import lcc_rl.assets
from lcc_rl.data.delimited import is_openacc
from lcc_rl.data.plausible import Plausible
from lcc_rl.data.tables import Table, read_table
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
            .parquet file with the columns ``time_s`` [s] and ``speed_mps`` [m/s], or a native
            OpenACC file, of which the first car is taken.
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
    table = read_table(file, named(file, {"time": TIME, "speed": SPEED}), "leader.columns")
    time, speed = _checked(table)
    record = pd.DataFrame({"episode": 0, TIME: time, SPEED: speed})
    limits = plausible or Plausible()
    limits.select(record, str(file), lambda row, name: f"data row {row + 1}, {name}", LEADER)
    return time, speed


def named(file: Path, columns: Mapping[str, str | None]) -> dict[str, str | None]:
    """Return the names of a record's columns; of a native OpenACC file those of its first car."""
    native = is_openacc(file)
    return {
        key: {TIME: "Time", SPEED: "Speed1"}.get(str(name), name) if native else name
        for key, name in columns.items()
        if not (native and key == "drive")
    }


def _checked(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """Time and speed of a table, or a DataError."""
    time, speed = table.numbers("time"), table.numbers("speed")
    if len(time) < 2:
        raise DataError(f"{table.file}: holds {len(time)} samples, at least 2 are needed")
    table.refuse(speed < 0, "speed", "has a negative speed")
    late = np.diff(time, prepend=-np.inf) <= 0
    table.refuse(late, "time", "does not follow the row before it in time")
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
