"""Reader of NGSIM files in any published layout.

Three layouts are read, plain or gzipped, and distinguished by their first line: the native 18
columns without header, separated by white space; the 18-column CSV with header (19 with Location);
and the 25-column export of the public portal. Files are read in blocks, and only the needed columns
are kept in compact types, so the whole portal export fits in a few gigabytes.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lcc_rl.data.columns import Column
from lcc_rl.data.tables import LARGEST_ID, Block, TableFile
from lcc_rl.data.text import lacking, stem
from lcc_rl.data.trajectories import (
    CAR_LENGTH,
    FOOT,
    SAMPLE_TYPES,
    ReadReport,
    RowIndex,
    Trajectories,
    assembled,
    median_lengths,
)
from lcc_rl.errors import Concern, DataError

HEADER = (
    "Vehicle_ID,Frame_ID,Total_Frames,Global_Time,Local_X,Local_Y,Global_X,Global_Y,v_Length,"
    "v_Width,v_Class,v_Vel,v_Acc,Lane_ID,Preceding,Following,Space_Headway,Time_Headway"
)
OFFICIAL = HEADER.split(",")
# Other spellings in the documents of the four sites, in lower case without separators.
HEADER_ALIASES = {
    "spacehdwy": "Space_Headway",
    "spacing": "Space_Headway",
    "preceeding": "Preceding",
    "precedingvehicle": "Preceding",
    "vehiclelength": "v_Length",
    "vehicleclass": "v_Class",
    "vehiclevelocity": "v_Vel",
    "vehicleacceleration": "v_Acc",
    "laneidentification": "Lane_ID",
}
INT16 = 2**15 - 1


def _column(name: str, least: float = -1e9, most: float = 1e9, **options: Any) -> Column:
    return Column(name, least=least, most=most, **options)


# Columns of the files by their keys in the samples.
NGSIM_FIELDS = {
    "vehicle": _column("Vehicle_ID", 1, LARGEST_ID, whole=True),
    "frame": _column("Frame_ID", 0, 2**31 - 1, whole=True),
    "position_m": _column("Local_Y"),
    "lane": _column("Lane_ID", -INT16, INT16, whole=True),
    "length_m": _column("v_Length"),
    "vehicle_class": _column("v_Class", -1, 127, whole=True, blank=True),
    "speed_mps": _column("v_Vel"),
    "acceleration_mps2": _column("v_Acc"),
    "preceding": _column("Preceding", -LARGEST_ID, LARGEST_ID, whole=True, blank=True),
    "space_headway_m": _column("Space_Headway", blank=True, required=False),
    "clock": _column("Global_Time", -1e300, 1e300, blank=True, required=False),
}
NGSIM_NAMES = {own: column.key for own, column in NGSIM_FIELDS.items()}
KNOWN = [*NGSIM_NAMES.values(), "Location"]
SPELLED = {name.replace("_", "").lower(): name for name in KNOWN} | HEADER_ALIASES
# Consequence of a column that is all zero or blank.
CONSEQUENCES = {
    "Global_Time": "recordings are identified by file",
    "v_Length": "gaps are front to front, not bumper to bumper",
    "v_Class": "nothing to filter vehicle classes on",
    "v_Vel": "it contains no data",
    "v_Acc": "it contains no data",
    "Lane_ID": "it contains no data",
    "Preceding": "no vehicle follows another",
    "Space_Headway": "space headways are derived from positions",
}
METRES = {"feet": FOOT, "metres": 1.0}
JAM = 3.0  # least distance of cars in a queue, front to front [m]
CLOSE, MOVING = 0.4, 1.0  # least median time gap of traffic [s], above a speed [m/s]
EXACT_DUPLICATE = "exact duplicate (vehicle, frame)"
CONFLICTING_DUPLICATE = "conflicting duplicate (vehicle, frame)"
NgsimColumns = dict[str, NDArray]


def read_ngsim(
    path: str | Path | Sequence[str | Path], location: str | None = None, units: str = "feet"
) -> Trajectories:
    """Read one or several NGSIM files of any published layout and convert them to SI.

    Case, spaces and underscores of header names are ignored. Required columns are Vehicle_ID,
    Frame_ID, Local_Y, v_Length, v_Class, v_Vel, v_Acc, Lane_ID and Preceding. Global_Time,
    Space_Headway and Location are used if present. Cells may be blank in Preceding, Space_Headway,
    Global_Time, v_Class, Location and all columns that are not read.

    Vehicle ids repeat between recordings. A recording is identified by its location and the time
    of its frame 0 (see :func:`name_recordings`); several files may hold parts of one.
    Exact duplicate rows are dropped; of different rows of one vehicle and frame the first is kept.
    A Preceding that is blank, negative or the vehicle itself counts as none. A space headway that
    is blank or zero is derived from the positions in the same frame.

    Args:
        path: file or files, plain or gzipped.
        location: keep only rows of this Location (such as ``i-80``), in any case.
        units: unit of the files: ``feet``, as published, or ``metres``.

    Raises:
        DataError: naming file, row and column, or if the vehicles are too short or long for these
            units.
    """
    paths = [path] if isinstance(path, (str, Path)) else path
    rows = _Rows(ReadReport(files=[str(name) for name in paths]), METRES[units])
    chosen = None if location is None else location.strip().lower()
    for name in rows.report.files:
        file = TableFile(name, _official, OFFICIAL)
        missing = [x.key for x in NGSIM_FIELDS.values() if x.required and x.key not in file.header]
        if missing:
            raise lacking(name, missing, file.header, "")
        before = rows.report.rows_read
        for block in file.blocks([key for key in KNOWN if key in file.header]):
            rows.add(name, block, chosen)
        if rows.report.rows_read == before:
            raise DataError(f"{name}: is empty or has no rows; expected NGSIM trajectories")
        rows.report.notes += file.notes
    if not rows.chunks:
        present = ", ".join(f"{name or 'blank'} ({n:,} rows)" for name, n in rows.locations.items())
        raise DataError(
            f"{', '.join(rows.report.files)}: no row has Location {location!r}; "
            f"the locations found are {present or 'none'}"
        )
    trajectories = _sorted(rows)
    _check_units(trajectories.samples, units, rows.report.files)
    return trajectories


# -- compact columns -------------------------------------------------------------------------------


def _official(name: str) -> str:
    """Return the official spelling of a column's name."""
    folded = re.sub(r"[\s_]+", "", name).lower()
    return SPELLED.get(folded, name.strip())


@dataclass
class _Rows:
    """Rows read so far.

    Args:
        report: counts, updated with every block.
        metres: size of the unit of lengths, speeds and accelerations.
        chunks: the columns of each block; ``group`` is an index into ``groups``.
        groups: index of every (file, location, time of frame 0).
        rows_of: rows of each group.
        locations: rows of each location.
        filled: columns with values other than blanks and zeros.
        blank_classes: rows without a vehicle class.
    """

    report: ReadReport
    metres: float
    chunks: list[NgsimColumns] = field(default_factory=list)
    groups: dict[Group, int] = field(default_factory=dict)
    rows_of: Counter[Group] = field(default_factory=Counter)
    locations: Counter[str] = field(default_factory=Counter)
    filled: set[str] = field(default_factory=set)
    blank_classes: int = 0

    def add(self, file: str, block: Block, location: str | None) -> None:
        """Add the rows of a block; with ``location``, those of that location only."""
        self.report.rows_read += len(block)
        names, places = [""], np.zeros(len(block), dtype=np.int64)
        if "Location" in block.cells.column_names:
            places, texts = pd.factorize(block.cells["Location"].fill_null("").to_numpy())
            names = [str(name).strip().lower() for name in texts]
        for name, rows in zip(names, np.bincount(places, minlength=len(names)), strict=True):
            self.locations[name] += int(rows)
        if location is not None:
            mask = np.array([name == location for name in names])[places]
            self.report.drop("other location", int((~mask).sum()))
            block.keep(mask)
            places = places[mask]
        if not len(block):
            return
        columns: NgsimColumns = {}
        for key, column in NGSIM_FIELDS.items():
            kind = SAMPLE_TYPES.get(key, np.float64)
            present = column.key in block.cells.column_names
            values = block.values(column, column.key) if present else np.full(len(block), np.nan)
            if key == "vehicle_class":
                self.blank_classes += int((~(values >= 0)).sum())
                values = values.clip(min=0.0)
            if column.blank:
                values = np.nan_to_num(values, nan=0.0)
            columns[key] = (values * self.metres if kind is np.float32 else values).astype(kind)
        preceding = columns["preceding"]
        preceding[(preceding < 0) | (preceding == columns["vehicle"])] = 0
        self.filled |= {NGSIM_NAMES[key] for key, values in columns.items() if values.any()}
        start = _frame_zero(columns.pop("clock"), columns["frame"])
        codes, pairs = pd.factorize(start * len(names) + places)
        groups = []
        for pair, count in zip(pairs.tolist(), np.bincount(codes).tolist(), strict=True):
            group = Group(file, names[pair % len(names)], pair // len(names))
            self.rows_of[group] += count
            groups.append(self.groups.setdefault(group, len(self.groups)))
        self.chunks.append({"group": np.array(groups, dtype=np.int32)[codes]} | columns)


def _frame_zero(clock: NDArray[np.float64], frame: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the time of frame 0 by each row's clock [ms]; 0 if the clock is no epoch."""
    plausible = (clock >= 1e8) & (clock < 1e14)
    starts = np.rint(np.where(plausible, clock, 0.0)).astype(np.int64) - 100 * frame.astype("i8")
    return np.where(plausible & (starts > 0), starts, 0)


# -- sorted samples --------------------------------------------------------------------------------


def _sorted(read: _Rows) -> Trajectories:
    """Return all rows, sorted, without duplicates."""
    # A part of a block is freed as soon as it is copied.
    columns = {
        name: np.concatenate([chunk.pop(name) for chunk in read.chunks])
        for name in list(read.chunks[0])
    }
    columns["recording"], names = _recordings(read, columns.pop("group"))
    index = RowIndex(columns["recording"], columns["vehicle"], columns["frame"])
    key = index.keys(columns["recording"], columns["vehicle"], columns["frame"])
    order = _kept_order(read.report, columns, key)
    for name in list(columns):  # one column at a time, to hold only one extra copy
        columns[name] = columns[name][order]
    report = read.report
    report.empty_columns = [name for name in CONSEQUENCES if name not in read.filled]
    for name in report.empty_columns:
        line = f"{name} is all zero or blank: {CONSEQUENCES[name]}"
        report.notes.append(Concern(line) if name == "v_Length" else line)
    if read.blank_classes and "v_Class" in read.filled:
        report.notes.append(f"v_Class is blank in {read.blank_classes:,} rows: class unknown")
    return assembled(columns, names, report)


def _recordings(read: _Rows, group: NDArray[np.int32]) -> tuple[NDArray[np.int16], list[str]]:
    """Return the recording code of every row and the sorted names of the recordings."""
    named, notes = name_recordings(read.rows_of)
    read.report.notes += notes
    names = sorted(set(named.values()))
    if len(names) > INT16:
        raise DataError(
            f"{', '.join(read.report.files)}: {len(names):,} recordings; expected a handful. "
            "Global_Time does not advance by 100 ms a frame"
        )
    codes = {name: code for code, name in enumerate(names)}
    return np.array([codes[named[key]] for key in read.groups], dtype=np.int16)[group], names


def _kept_order(
    report: ReadReport, columns: NgsimColumns, key: NDArray[np.int64]
) -> NDArray[np.intp]:
    """Return the rows to keep in sorted order; count duplicates by kind."""
    order = np.argsort(key, kind="stable")  # stable: the first in the files is kept
    key = key[order]
    repeated = np.append(False, key[1:] == key[:-1])
    if not repeated.any():
        return order
    first = np.maximum.accumulate(np.where(repeated, 0, np.arange(len(key))))
    again, firsts = order[repeated], order[first[repeated]]
    equal = np.logical_and.reduce([values[again] == values[firsts] for values in columns.values()])
    report.drop(EXACT_DUPLICATE, int(equal.sum()))
    report.drop(CONFLICTING_DUPLICATE, int((~equal).sum()))
    if not equal.all():
        report.notes.append(
            "different rows of the same vehicle and frame: the first in the files was kept; "
            "the files may mix recordings that Global_Time does not distinguish"
        )
    return order[~repeated]


def _check_units(samples: pd.DataFrame, units: str, files: Sequence[str]) -> None:
    """Check that the vehicles of every recording have plausible lengths and time gaps.

    Without lengths, the shortest headways (1 % quantile) are checked.
    """
    medians, other = median_lengths(samples), "feet" if units == "metres" else "metres"
    for name, rows in samples.groupby("recording", observed=True):
        headways = rows.loc[rows["space_headway_m"] > 0, "space_headway_m"]
        hint, near = f"is the file in {other}? Use data.units={other}", False
        if name in medians:
            quantity, size = "the median length of vehicles", float(medians[name])
            low, high = CAR_LENGTH
            speeds = rows.loc[rows["speed_mps"] > MOVING, "speed_mps"]
            gap, mixed = (((headways - x) / speeds).median() for x in (size, FOOT * size))
            near = gap < CLOSE and mixed > 2 * CLOSE
        elif len(headways):
            quantity, size = "the least headway (1 % quantile)", float(headways.quantile(0.01))
            low, high = JAM, float("inf")
        else:
            continue
        if near:
            hint = f"with a time gap of {gap:.2g} s; are lengths alone in feet? Convert them"
        if near or not low <= size <= high:
            raise DataError(
                f"{', '.join(files)}: recording {name}: {quantity} is {size / METRES[units]:.3g} "
                f"{units}; expected {low:g} to {high:g} m; {hint}"
            )


# -- recordings ------------------------------------------------------------------------------------

JITTER = 5_000  # ms; recordings of one site start at least 11,700 clock units apart
CLUSTER_SPREAD = 300_000  # ms; periods last 15 min, and a float32 clock is off by up to 66 s
SECONDS_BELOW = 10**11  # a smaller epoch is in seconds; in ms it would be in 1973


class Group(NamedTuple):
    """Rows of one file and location with the same time of frame 0.

    Args:
        file: path of the file.
        location: Location in lower case, '' if there is none.
        start: Global_Time − 100·Frame_ID as published; 0 if the clock is unusable.
    """

    file: str
    location: str
    start: int


def name_recordings(rows: Counter[Group]) -> tuple[dict[Group, str], list[str]]:
    """Name the recording of every group, because vehicle ids are reused.

    Within a recording the clock advances by 100 ms a frame, so Global_Time − 100·Frame_ID, the time
    of frame 0, is constant. It differs between recordings by minutes. Published clocks have errors;
    those of one file and location are processed in three steps:

    1. A clock that is blank, zero or not a plausible epoch is unusable. The site Peachtree
       publishes its epoch in seconds (and 100 a frame), which is usable.
    2. Times of frame 0 within ``JITTER`` of the next one form a cluster, so that jitter, truncation
       and rounding do not split a recording.
    3. Clusters that spread over more than ``CLUSTER_SPREAD``, such as a constant clock, are
       unusable.

    Rows with a usable clock are identified by location and time, over all files. Rows without one
    belong to the recording of their file and location if there is exactly one; otherwise they form
    a recording per file and location.

    Args:
        rows: number of rows of each group.

    Returns:
        The name of each group, such as ``i-80@2005-04-13T22:58:55Z`` (UTC, the most frequent time
        of frame 0) or, without a usable clock, ``<file stem>#1``; and notes for the report.
    """
    by_place: dict[tuple[str, str], list[Group]] = defaultdict(list)
    by_location: dict[str, list[Group]] = defaultdict(list)
    for group in rows:
        if group.start > 0:
            by_place[group[:2]].append(group)
    for (_, location), groups in by_place.items():
        for cluster in _clusters(groups):
            if cluster[-1].start - cluster[0].start <= CLUSTER_SPREAD:
                by_location[location] += cluster
    named: dict[Group, str] = {}
    for location, groups in by_location.items():
        for cluster in _clusters(groups):
            counts: Counter[int] = Counter()
            for group in cluster:
                counts[group.start] += rows[group]
            start = min(counts, key=lambda start: (-counts[start], start))
            seconds = start if start < SECONDS_BELOW else start // 1000
            time = f"{datetime.fromtimestamp(seconds, tz=UTC):%Y-%m-%dT%H:%M:%SZ}"
            named.update(dict.fromkeys(cluster, f"{location}@{time}" if location else time))
    return named, _name_by_file(named, rows)


def _clusters(groups: Iterable[Group]) -> list[list[Group]]:
    """Return groups sorted by start, divided where the next one is more than JITTER away."""
    clusters: list[list[Group]] = []
    for group in sorted(groups, key=lambda group: group.start):
        if clusters and group.start - clusters[-1][-1].start <= JITTER:
            clusters[-1].append(group)
        else:
            clusters.append([group])
    return clusters


def _name_by_file(named: dict[Group, str], rows: Counter[Group]) -> list[str]:
    """Name the groups with an unusable clock, in place; return notes."""
    recordings: dict[tuple[str, str], set[str]] = defaultdict(set)
    for group, name in named.items():
        recordings[group[:2]].add(name)
    unclocked: Counter[tuple[str, str]] = Counter()
    assigned: dict[tuple[str, str], str] = {}
    for group in sorted(rows.keys() - named.keys()):
        source = group[:2]
        unclocked[source] += rows[group]
        if source not in assigned:
            alone = len(recordings[source]) == 1
            assigned[source] = min(recordings[source]) if alone else _file_name(source[0], assigned)
        named[group] = assigned[source]
    return [
        f"Global_Time does not identify the recording of {count:,} rows of {file}"
        f"{f' at {location}' if location else ''}: read as {assigned[file, location]}"
        for (file, location), count in unclocked.items()
    ]


def _file_name(file: str, assigned: dict[tuple[str, str], str]) -> str:
    """Return ``<stem>#k`` with the smallest free k."""
    number = 1
    while (name := f"{stem(file)}#{number}") in assigned.values():
        number += 1
    return name
