"""Speed records from files: drive cycles, single records, and tables of many drives."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from os.path import expanduser
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from lcc_rl.data.columns import SLOPES, Column, Names, Units
from lcc_rl.data.grid import BRIDGE_S, continuous, interpolated, places, stretches
from lcc_rl.data.plausible import Plausible, doubts
from lcc_rl.data.profiles import Profiles, from_records, resample
from lcc_rl.data.sources import SHIPPED_FILES, copies, find_files, units_of
from lcc_rl.data.tables import TableFile, same_text, tables_of
from lcc_rl.data.text import alike
from lcc_rl.data.trajectories import ReadReport
from lcc_rl.errors import DataError

log = logging.getLogger("lcc_rl")

TIME_COLUMN, SPEED_COLUMN = "time_s", "speed_mps"
# Columns of a table of drives, and their default names.
DRIVE_FIELDS = (
    Column("drive", "text", "drive", required=False),
    Column("time", "time", TIME_COLUMN, blank=True),
    Column("speed", "speed", SPEED_COLUMN, blank=True),
    Column("grade", "grade", least=-0.3, most=0.3, required=False, used=" for lcc-rl energy"),
)
DRIVE_COLUMNS = {column.key: column.name for column in DRIVE_FIELDS if column.name}


def read_speed_record(
    path: str, plausible: Plausible | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Read a speed record of any sampling rate.

    Args:
        path: name of a shipped cycle (``udds``, ``us06``, ``wltc_3b``, ``hwfet``), or a .csv or
            .parquet file with the columns ``time_s`` [s] and ``speed_mps`` [m/s], or a native
            OpenACC file, of which the first car is read.
        plausible: thresholds of every sample; None: the defaults.

    Returns:
        Time [s], increasing, and speed [m/s], both ``[samples]``, float64.

    Raises:
        DataError: naming the file and the row or column, if a value is malformed or implausible, or
            samples are missing.
    """
    cycles = {name: file for name, file in SHIPPED_FILES.items() if file.endswith(".csv")}
    file = cycles.get(path, path)
    if not Path(expanduser(file)).is_file():
        known = ", ".join(sorted(cycles))
        raise DataError(f"{path}: no such file, and none of the package ({known})")
    names = {**DRIVE_COLUMNS, "drive": None}
    samples, lines = _read(TableFile(file), names, plausible, {}, BRIDGE_S)
    for line in lines[1:]:  # the first one is on the number of rows
        log.warning(line)
    time = samples[TIME_COLUMN].to_numpy()
    if len(holes := np.flatnonzero(np.diff(samples["episode"]))):
        last = holes[0]
        hole = f"a hole of {time[last + 1] - time[last]:.3g} s after {TIME_COLUMN} {time[last]:g}"
        raise DataError(f"{path}: {hole}; expected one record without holes")
    return time, samples[SPEED_COLUMN].to_numpy()


def read_drives(
    path: str | Sequence[str],
    columns: Names,
    time_step: float,
    plausible: Plausible | None = None,
    units: Units | None = None,
    average_s: float = 0.0,
    bridge: float = BRIDGE_S,
) -> tuple[Profiles, list[str]]:
    """Read the speed records of tables.

    A table without the column ``drive`` is one drive, unless another name is configured.

    Args:
        path, columns, plausible, units, average_s, bridge: see
            :class:`lcc_rl.data.leaders.DriveLeaders`.
        time_step: step of the profiles [s]; the records are interpolated to it.

    Returns:
        A profile for each record, sorted by name, those of a single one by time, and lines on the
        data. Its recording is the drive, which has several profiles if blank cells, holes or
        implausible samples divide it.

    Raises:
        DataError: naming file, row and column, if a value is missing or no number, a time is
            repeated, or too many samples are implausible.
    """
    files = find_files(path)
    if len(files) > 1 and columns["drive"] is None:
        raise DataError(f"{path}: {len(files)} files; leader=record drives one, see leader=drives")
    records: dict[str, tuple[str, Tensor, Tensor | None, float]] = {}
    lines: list[str] = []
    for table in tables_of(files):
        samples, report = _read(table, columns, plausible, units or {}, bridge, average_s, "leader")
        loaded = dict(_records(samples, time_step))
        if twice := loaded.keys() & records.keys():
            raise DataError(f"{path}: drive {min(twice)!r} is in several files; expected one")
        records |= loaded
        lines += [*report, *interpolated(samples, time_step)]
    names = [*records] if columns["drive"] is None else sorted(records)
    drives, speeds, grades, starts = zip(*(records[name] for name in names), strict=True)
    profiles = from_records(speeds, names, drives, time_step, starts=starts)
    lines += copies(np.repeat(names, profiles.lengths), pd.DataFrame(profiles.speeds.numpy()))
    joined = torch.cat(grades) if columns.get("grade") else None
    return replace(profiles, grades=joined), alike(lines, files)


def _records(
    samples: pd.DataFrame, time_step: float
) -> Iterator[tuple[str, tuple[str, Tensor, Tensor | None, float]]]:
    """Yield name, drive, speed, grade if it was read, and first time of each record of a file."""
    starts, lengths = stretches(samples["episode"].to_numpy())
    drives = samples["recording"].iloc[starts].astype(str).tolist()
    count, time = Counter(drives), samples[TIME_COLUMN].to_numpy()
    speed, grade = samples[SPEED_COLUMN].to_numpy(), samples.get("grade")
    for drive, start, length in zip(drives, starts, lengths, strict=True):
        rows = slice(start, start + length)
        name = drive if count[drive] == 1 else f"{drive}+{time[start]:.12g}s"
        speeds, slope = resample(time[rows], speed[rows], time_step), None
        if grade is not None:
            at = time[start] + time_step * np.arange(len(speeds))
            slope = torch.tensor(np.interp(at, time[rows], grade[rows]), dtype=torch.float32)
        yield name, (drive, speeds, slope, float(time[start]))


def _read(
    table: TableFile,
    columns: Names,
    plausible: Plausible | None,
    units: Units,
    bridge: float,
    average_s: float = 0.0,
    node: str = "",
) -> tuple[pd.DataFrame, list[str]]:
    """Return recording, episode and motion of the plausible samples of a file, and the report.

    ``node``: section of the settings of columns and units; empty if they are fixed.
    """
    option = f"{node}.columns" if node else ""
    samples, report = _samples(table, columns, units, option), ReadReport([str(table.path)])
    place = partial(places, files=report.files, columns=table.names)
    samples = continuous(samples, "drive", place, report, node, bridge)
    declared = units_of(DRIVE_FIELDS, DRIVE_COLUMNS, units) if node else {}
    if average_s:
        samples = _averaged(samples, average_s, str(table.path))
    remedy = ", smooth it (leader.average_s=0.5)" if node and not average_s else ""
    rows, lines = (plausible or Plausible()).select(
        samples, str(table.path), place, "leader.plausible", remedy, declared
    )
    line = f"read {rows['episode'].nunique():,} speed record(s), {len(rows):,} rows, {table.path}"
    if table.preamble:
        line += ": native OpenACC, its first car"
    lines += doubts(rows, node)
    return rows, [line, *table.notes, *report.left_out(), *report.notes, *lines]


def _averaged(samples: pd.DataFrame, seconds: float, source: str) -> pd.DataFrame:
    """Return centred moving averages of the speeds, of the samples that have a whole window."""
    record = samples["episode"]
    steps = samples[TIME_COLUMN].diff().where(record.diff() == 0).groupby(record)
    width = (seconds / steps.transform("median")).round() // 2 * 2 + 1  # of a record [samples]
    means = [
        rows.groupby("episode")[SPEED_COLUMN].rolling(int(count), center=True).mean().droplevel(0)
        for count, rows in samples.groupby(width)
    ]
    rows = samples.assign(**{SPEED_COLUMN: pd.concat(means)}).dropna(subset=SPEED_COLUMN)
    if len(rows) < 2:
        raise DataError(f"{source}: no record is as long as leader.average_s={seconds:g}")
    return rows.reset_index(drop=True)


def _samples(table: TableFile, columns: Names, units: Units, option: str) -> pd.DataFrame:
    """Return drive (as recording), time and speed of every row with a speed."""
    single = columns["drive"] is None
    if table.preamble:
        native = {TIME_COLUMN: "Time", SPEED_COLUMN: "Speed1"}
        columns = {key: native.get(str(columns[key]), columns[key]) for key in ("time", "speed")}
    elif columns["drive"] == DRIVE_COLUMNS["drive"] and columns["drive"] not in table.header:
        columns = {**columns, "drive": None}  # each file is one drive
    read = table.read(DRIVE_FIELDS, columns, units, option, ["time", "speed"])
    rows = read["row"]
    if not len(rows):
        raise DataError(f"{table.path}: holds 0 samples, at least 2 are needed")
    # A record may end before the table; in native files, blank cells divide it.
    if rows[-1] >= len(rows) and (single or not table.preamble):
        raise table.fault(int(np.argmax(rows != np.arange(len(rows)))), "speed", "is blank or NaN")
    samples = pd.DataFrame({TIME_COLUMN: read["time"], SPEED_COLUMN: read["speed"]})
    if "grade" in read:
        slope = units.get("grade", "rad") in SLOPES
        samples["grade"] = np.arctan(read["grade"]) if slope else read["grade"]
    samples["recording"] = read.get("drive", same_text(table.label, len(rows)))
    return samples.assign(episode=samples["recording"].cat.codes.astype(int), file=0, row=rows)
