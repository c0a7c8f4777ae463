"""Tables of speed records: one record, many drives, or native OpenACC files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from lcc_rl.data.delimited import stem
from lcc_rl.data.plausible import Plausible
from lcc_rl.data.profiles import Profiles, from_records
from lcc_rl.data.sources import find_files
from lcc_rl.data.speed_records import LEADER, SPEED, TIME, named, resample
from lcc_rl.data.tables import Table, read_table
from lcc_rl.data.units import factors
from lcc_rl.errors import DataError

# What a table of drives has, and how the columns are called by default.
COLUMNS = {"drive": "drive", "time": TIME, "speed": SPEED}
UNITS = {"time": "s", "speed": "m/s"}
UNEVEN = 0.1  # of the median step, by which a step may differ from it


def read_drives(
    path: str | Sequence[str],
    columns: Mapping[str, str | None],
    time_step: float,
    plausible: Plausible | None = None,
    units: Mapping[str, str] | None = None,
) -> tuple[Profiles, list[str]]:
    """Read the speed records of a table.

    Args:
        path, columns, plausible, units: see :class:`DriveLeaders`.
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
        table, lines = _read(Path(name), columns, plausible, units or {})
        parts.append(table)
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


def _read(
    file: Path,
    columns: Mapping[str, str | None],
    plausible: Plausible | None,
    units: Mapping[str, str],
) -> tuple[pd.DataFrame, list[str]]:
    """Name, drive, time and speed of the plausible samples of one file, and the report."""
    table = read_table(file, named(file, columns), "leader.columns")
    samples, said = _sound(table, columns["drive"] is None, factors(units, COLUMNS, "leader.units"))
    names, row = samples["name"], samples["row"].to_numpy()

    def place(number: int, column: str) -> str:
        own = {TIME: table.columns["time"], SPEED: table.columns["speed"]}.get(column, column)
        return f"data row {row[number] + 1} ({names.iloc[number]}), column {own!r}"

    kept, lines = (plausible or Plausible()).select(samples, str(file), place, LEADER)
    line = f"read {kept['name'].nunique():,} speed record(s), {len(kept):,} rows, {file}"
    if table.preamble:
        line += ": native OpenACC, its first car"
    return kept.assign(file=str(file)), [line, *table.notes, *said, *lines]


def _sound(
    table: Table, single: bool, scale: Mapping[str, float]
) -> tuple[pd.DataFrame, list[str]]:
    """Name, time, speed and row of every sample, record by record, and lines; or a DataError."""
    blank = bool(table.preamble) and not single  # there, blank cells divide a record
    time = table.numbers("time", scale["time"])
    speed = table.numbers("speed", scale["speed"], blank=blank)
    names = (
        table.texts("drive") if "drive" in table.columns else np.full(len(time), stem(table.file))
    )
    table.refuse(speed < 0, "speed", "is negative")
    if len(time) < 2:
        raise DataError(f"{table.file}: holds {len(time)} samples, at least 2 are needed")
    samples = pd.DataFrame(
        {"name": names.astype(str), "row": np.arange(len(time)), TIME: time, SPEED: speed}
    ).assign(drive=names)
    said: list[str] = []
    if blank and np.isnan(speed).any():
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
        at_fault = np.zeros(len(time), dtype=bool)
        at_fault[samples["row"].to_numpy()[wrong.to_numpy()]] = True
        table.refuse(at_fault, "time", words)
    return samples, said


def _without_blanks(samples: pd.DataFrame, table: Table) -> tuple[pd.DataFrame, list[str]]:
    """Leave out blank cells, which divide the record: its parts are named after their start."""
    blank = samples[SPEED].isna()
    part = blank.cumsum()[~blank]
    rows = samples[~blank]
    size = part.map(part.value_counts())
    starts = rows.groupby(part)[TIME].transform("min")
    named_parts = [f"{name}+{start:g}s" for name, start in zip(rows["name"], starts, strict=True)]
    kept = rows.assign(name=named_parts)[(size > 1).to_numpy()]
    if kept.empty:
        raise DataError(
            f"{table.file}: column {table.columns['speed']!r} has no two samples in a row"
        )
    line = (
        f"left out {len(samples) - len(kept):,} rows with a blank {table.columns['speed']} or "
        f"alone between such, which divide the record into {kept['name'].nunique()} parts"
    )
    return kept, [line]
