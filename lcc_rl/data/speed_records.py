"""Speed records from files: drive cycles, single records, and tables of many drives."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from os.path import expanduser
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from lcc_rl.arrays import Floats, Integers
from lcc_rl.data.grid import continuous, interpolated, places, stretches
from lcc_rl.data.interpolation import grid_size, monotone
from lcc_rl.data.plausible import Plausible
from lcc_rl.data.profiles import Profiles, from_records
from lcc_rl.data.sources import SHIPPED_FILES, find_files, units_of
from lcc_rl.data.tables import SLOPES, Column, Names, TableFile, Units, same_text, tables_of
from lcc_rl.data.text import alike
from lcc_rl.data.trajectories import FRAME, ReadReport, starts_of
from lcc_rl.errors import DataError

TIME_COLUMN, SPEED_COLUMN = "time_s", "speed_mps"
# Columns of a table of drives, and their default names.
DRIVE_FIELDS = (
    Column("drive", "text", required=False),
    Column("time", "time", blank=True),
    Column("speed", "speed", blank=True),
    Column("grade", "grade", least=-0.3, most=0.3, required=False),  # of lcc-rl energy
)
BLOCK = 1 << 20  # samples that are interpolated together
DRIVE_COLUMNS: dict[str, str | None] = {
    "drive": "drive",
    "time": TIME_COLUMN,
    "speed": SPEED_COLUMN,
}


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
        DataError: naming the file and the row or column, if a value is malformed or implausible.
    """
    file = SHIPPED_FILES.get(path, path)
    if not Path(expanduser(file)).is_file():
        known = ", ".join(sorted(SHIPPED_FILES))
        raise DataError(f"{path}: no such file, and none of the package ({known})")
    samples, _ = _read(
        TableFile(file), {**DRIVE_COLUMNS, "drive": None}, plausible, {}, divide=False
    )
    return samples.samples[TIME_COLUMN].to_numpy(), samples.samples[SPEED_COLUMN].to_numpy()


@dataclass(frozen=True)
class Drives:
    """Samples of speed records, record after record.

    Args:
        samples: ``time_s`` [s], ``speed_mps`` [m/s] and, if it was read, ``grade`` [rad]; each
            record has two samples or more.
        lengths: number of samples of each record.
        names: the records' names.
        drives: the records' drives, which have several records if blank cells, holes or
            implausible samples divide them.
    """

    samples: pd.DataFrame
    lengths: Integers
    names: list[str]
    drives: list[str]

    def at_steps(self, time_step: float) -> Iterator[tuple[slice, Floats, Integers]]:
        """Yield blocks of records with their samples every ``time_step`` seconds.

        Yields:
            The records of the block, their speeds and, if read, grades ``[samples, columns]``, and
            the number of samples of each record.
        """
        ends = np.cumsum(self.lengths)
        time, starts = self.samples[TIME_COLUMN].to_numpy(), ends - self.lengths
        counts = grid_size(time[starts], time[ends - 1], time_step)
        values = self.samples.drop(columns=TIME_COLUMN).to_numpy(np.float64)
        block = np.cumsum(counts) // BLOCK
        for first in starts_of(block):
            some = slice(int(first), int(first + (block == block[first]).sum()))
            rows = slice(int(starts[some.start]), int(ends[some.stop - 1]))
            own, begin = time[rows], time[starts[some]]
            sizes = self.lengths[some], begin, counts[some]
            yield some, monotone(own, values[rows], *sizes, time_step)[0], counts[some]


def read_drives(
    path: str | Sequence[str],
    columns: Names,
    time_step: float,
    plausible: Plausible | None = None,
    units: Units | None = None,
) -> tuple[Profiles, list[str]]:
    """Read the speed records of tables as profiles.

    Args:
        path, columns, plausible, units: see :func:`read_samples`.
        time_step: step of the profiles [s]; the records are interpolated to it.
    """
    found, lines = read_samples(path, columns, plausible, units)
    speeds = [
        record
        for _, values, counts in found.at_steps(time_step)
        for record in torch.from_numpy(values[:, 0].clip(min=0.0)).float().split(counts.tolist())
    ]
    return from_records(speeds, found.names, found.drives, time_step), lines


def read_samples(
    path: str | Sequence[str],
    columns: Names,
    plausible: Plausible | None = None,
    units: Units | None = None,
    time_step: float = FRAME,
) -> tuple[Drives, list[str]]:
    """Read the speed records of tables.

    A table without the column ``drive`` is one drive, unless another name is configured.

    Args:
        path, columns, plausible, units: see :class:`lcc_rl.data.leaders.DriveLeaders`.
        time_step: step to which they will be interpolated, for the report [s].

    Returns:
        The records, sorted by name, those of a single one by time, and lines on the data.

    Raises:
        DataError: naming file, row and column, if a value is missing or no number, a time is
            repeated, or too many samples are implausible.
    """
    files = find_files(path)
    if len(files) > 1 and columns["drive"] is None:
        raise DataError(f"{path}: {len(files)} files; leader=record drives one, see leader=drives")
    parts, lines = [], []
    seen: dict[str, int] = {}
    for number, table in enumerate(tables_of(files)):
        part, report = _read(table, columns, plausible, units or {}, time_step)
        for name in part.names:
            if seen.setdefault(name, number) != number:
                raise DataError(f"{path}: drive {name!r} is in several files; expected one")
        parts.append(part)
        lines += report
    names = [name for part in parts for name in part.names]
    drives = [name for part in parts for name in part.drives]
    lengths = np.concatenate([part.lengths for part in parts])
    samples = pd.concat([part.samples for part in parts], ignore_index=True)
    order = np.argsort(np.array(names), kind="stable")
    if columns["drive"] is not None and (np.diff(order) != 1).any():
        starts = np.cumsum(lengths) - lengths
        rows = np.repeat(starts[order], lengths[order]) + _within(lengths[order])
        samples, lengths = samples.take(rows), lengths[order]
        names, drives = [names[i] for i in order], [drives[i] for i in order]
    return Drives(samples, lengths, names, drives), alike(lines, files)


def _within(lengths: Integers) -> Integers:
    """Return the number of each sample in its record, from 0."""
    return np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)


def _read(
    table: TableFile,
    columns: Names,
    plausible: Plausible | None,
    units: Units,
    time_step: float = FRAME,
    divide: bool = True,
) -> tuple[Drives, list[str]]:
    """Return the plausible samples of a file, and the report."""
    samples, report = _samples(table, columns, units), ReadReport([str(table.path)])
    place = partial(places, files=report.files, columns=table.names)
    samples = continuous(samples, "drive", place, report, divide)
    known = units_of(DRIVE_FIELDS, DRIVE_COLUMNS, units) if divide else {}
    kept, lines = (plausible or Plausible()).select(
        samples, str(table.path), place, "leader.plausible", units=known
    )
    lines += interpolated(kept, time_step)
    starts, lengths = stretches(kept.pop("episode").to_numpy())
    drives = kept.pop("recording").iloc[starts].astype(str).tolist()
    count, since = Counter(drives), kept[TIME_COLUMN].to_numpy()[starts]
    names = [
        name if count[name] == 1 else f"{name}+{start:g}s"
        for name, start in zip(drives, since, strict=True)
    ]
    line = f"read {len(names):,} speed record(s), {len(kept):,} rows, {table.path}"
    if table.preamble:
        line += ": native OpenACC, its first car"
    found = Drives(kept, lengths, names, drives)
    return found, [line, *table.notes, *report.left_out(), *report.notes, *lines]


def _samples(table: TableFile, columns: Names, units: Units) -> pd.DataFrame:
    """Return drive (as recording), time and speed of every row with a speed."""
    single = columns["drive"] is None
    if table.preamble:
        native = {TIME_COLUMN: "Time", SPEED_COLUMN: "Speed1"}
        columns = {key: native.get(str(columns[key]), columns[key]) for key in ("time", "speed")}
    elif columns["drive"] == DRIVE_COLUMNS["drive"] and columns["drive"] not in table.header:
        columns = {**columns, "drive": None}  # each file is one drive
    read = table.read(DRIVE_FIELDS, columns, units, "leader.columns", ["time", "speed"])
    rows = read["row"]
    if not len(rows):
        raise DataError(f"{table.path}: holds 0 samples, at least 2 are needed")
    # A record may end before the table; in native files, blank cells divide it.
    if rows[-1] >= len(rows) and (single or not table.preamble):
        raise table.fault(int(np.argmax(rows != np.arange(len(rows)))), "speed", "is blank")
    samples = pd.DataFrame({TIME_COLUMN: read["time"], SPEED_COLUMN: read["speed"]})
    if "grade" in read:
        slope = units.get("grade", "rad") in SLOPES
        samples["grade"] = np.arctan(read["grade"]) if slope else read["grade"]
    samples["recording"] = read.get("drive", same_text(table.label, len(rows)))
    return samples.assign(episode=samples["recording"].cat.codes.astype(int), file=0, row=rows)
