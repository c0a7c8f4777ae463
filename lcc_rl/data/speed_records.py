"""Speed records from files: drive cycles, single records, and tables of many drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

import lcc_rl.assets
from lcc_rl.data.plausible import Plausible
from lcc_rl.data.profiles import Profiles, from_records, resample
from lcc_rl.data.sources import find_files
from lcc_rl.data.tables import Column, TableFile, factors, stem
from lcc_rl.errors import DataError

CYCLES = Path(lcc_rl.assets.__file__).parent / "cycles"
TIME, SPEED = "time_s", "speed_mps"
LEADER = "leader.plausible"  # where a configuration has the thresholds of speed records
# What a table of drives has, and how the columns are called by default.
FIELDS = (
    Column("drive", "text", required=False),
    Column("time", "time"),
    Column("speed", "speed", least=0.0),
)
# Of the first car of a native OpenACC file, whose blank cells divide a record.
NATIVE = (Column("time", "time"), Column("speed", "speed", least=0.0, blank=True))
COLUMNS: dict[str, str | None] = {"drive": "drive", "time": TIME, "speed": SPEED}
UNEVEN = 0.1  # of the median step, by which a step may differ from it


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
    table = TableFile(file)
    samples = _samples(table, {**COLUMNS, "drive": None}, {}, FIELDS)
    late = samples[TIME].diff().le(0).to_numpy()
    table.refuse(late, "time", "does not follow the row before it in time")
    _select(samples, table, plausible)
    return samples[TIME].to_numpy(), samples[SPEED].to_numpy()


def read_drives(
    path: str | Sequence[str],
    columns: Mapping[str, str | None],
    time_step: float,
    plausible: Plausible | None = None,
    units: Mapping[str, str] | None = None,
) -> tuple[Profiles, list[str]]:
    """Read the speed records of a table.

    Args:
        path, columns, plausible, units: see :class:`lcc_rl.data.leaders.DriveLeaders`.
        time_step: step of the profiles [s]; the records are interpolated to it.

    Returns:
        A profile for each record, in the order of their names, and lines on what was read. Its
        recording is the drive; a native OpenACC file has several profiles if its first car has
        blank cells.

    Raises:
        DataError: naming file, row and column, if a value is missing, no number or negative, a
            time is there twice, the steps of a record are uneven, or too much is implausible.
    """
    files = find_files(path)
    if len(files) > 1 and columns["drive"] is None:
        raise DataError(f"{path}: {len(files)} files; leader=record drives one, see leader=drives")
    parts, report = [], []
    for name in files:
        part, lines = _read(TableFile(name), columns, plausible, factors(units or {}, FIELDS))
        parts.append(part)
        report += lines
    table = pd.concat(parts, ignore_index=True) if len(parts) > 1 else parts[0]
    own = table.groupby("name")["file"].nunique()
    if (own > 1).any():
        raise DataError(f"{path}: drive {own.idxmax()!r} is in several files; expected one")
    groups = list(table.groupby("name", sort=True))
    records = [
        resample(part[TIME].to_numpy(), part[SPEED].to_numpy(), time_step) for _, part in groups
    ]
    labels = [str(name) for name, _ in groups]
    drives = [str(part["drive"].iloc[0]) for _, part in groups]
    return from_records(records, labels, drives, time_step), report


def _samples(
    table: TableFile,
    columns: Mapping[str, str | None],
    scale: Mapping[str, float],
    fields: Sequence[Column],
) -> pd.DataFrame:
    """Name, drive, time, speed and row of every sample of a file."""
    if table.preamble:
        own = {TIME: "Time", SPEED: "Speed1"}
        columns = {key: own.get(str(columns[key]), columns[key]) for key in ("time", "speed")}
    read = table.read(fields, columns, scale, "leader.columns")
    count = len(read["time"])
    if count < 2:
        raise DataError(f"{table.path}: holds {count} samples, at least 2 are needed")
    drive = read.get("drive", np.full(count, stem(table.path)))
    motion = {TIME: read["time"], SPEED: read["speed"]}
    return pd.DataFrame({"name": drive, "row": np.arange(count), **motion, "drive": drive}).assign(
        episode=0
    )


def _select(
    samples: pd.DataFrame, table: TableFile, plausible: Plausible | None
) -> tuple[pd.DataFrame, list[str]]:
    """The plausible samples, and lines on what was left out."""
    names, row = samples["name"], samples["row"].to_numpy()

    def place(number: int, column: str) -> str:
        own = {TIME: table.names["time"], SPEED: table.names["speed"]}.get(column, column)
        return f"data row {row[number] + 1} ({names.iloc[number]}), column {own!r}"

    return (plausible or Plausible()).select(samples, str(table.path), place, LEADER)


def _read(
    table: TableFile,
    columns: Mapping[str, str | None],
    plausible: Plausible | None,
    scale: Mapping[str, float],
) -> tuple[pd.DataFrame, list[str]]:
    """Name, drive, time and speed of the plausible samples of one file, and the report."""
    divided = bool(table.preamble) and columns["drive"] is not None
    samples = _samples(table, columns, scale, NATIVE if divided else FIELDS)
    said: list[str] = []
    if samples[SPEED].isna().any():
        samples, said = _without_blanks(samples, table)
    samples = samples.sort_values("name", kind="stable", ignore_index=True)
    samples["episode"] = samples["name"].ne(samples["name"].shift()).cumsum()
    step = samples.groupby("episode")[TIME].diff()
    usual = step.groupby(samples["episode"]).transform("median")
    for wrong, words in (
        (step <= 0, "does not follow the time before it in its record"),
        (usual.isna(), "is the only sample of its record"),
        ((step - usual).abs() > UNEVEN * usual, "is not evenly spaced in its record"),
    ):
        rows = samples["row"][wrong]
        table.refuse(np.isin(np.arange(rows.max() + 1 if len(rows) else 0), rows), "time", words)
    kept, lines = _select(samples, table, plausible)
    line = f"read {kept['name'].nunique():,} speed record(s), {len(kept):,} rows, {table.path}"
    if table.preamble:
        line += ": native OpenACC, its first car"
    return kept.assign(file=str(table.path)), [line, *table.notes, *said, *lines]


def _without_blanks(samples: pd.DataFrame, table: TableFile) -> tuple[pd.DataFrame, list[str]]:
    """Leave out blank cells, which divide the record: its parts are named after their start."""
    blank = samples[SPEED].isna()
    part = blank.cumsum()[~blank]
    rows = samples[~blank]
    size = part.map(part.value_counts())
    starts = rows.groupby(part)[TIME].transform("min")
    named_parts = [f"{name}+{start:g}s" for name, start in zip(rows["name"], starts, strict=True)]
    kept = rows.assign(name=named_parts)[(size > 1).to_numpy()]
    speed = table.names["speed"]
    if kept.empty:
        raise DataError(f"{table.path}: column {speed!r} has no two samples in a row")
    line = (
        f"left out {len(samples) - len(kept):,} rows with a blank {speed} or alone between such, "
        f"which divide the record into {kept['name'].nunique()} parts"
    )
    return kept, [line]
