"""NGSIM room: files in any published layout become one SI table of trajectories.

Three layouts are read, plain or gzipped, told apart by their first line: the native headerless
18 columns separated by white space, the 18-column CSV with header (19 with Location), and the
25-column export of the public portal. Files are streamed in blocks and only the needed columns
are kept, in compact types, so that the whole portal export fits in a few gigabytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lcc_rl.data.ngsim_layouts import Block, read_blocks
from lcc_rl.data.ngsim_recordings import Group, name_recordings
from lcc_rl.data.ngsim_writer import write_ngsim
from lcc_rl.data.places import Places, find
from lcc_rl.data.units import FOOT, FRAME
from lcc_rl.errors import DataError

__all__ = ["ReadReport", "Trajectories", "read_ngsim", "write_ngsim"]

LARGEST_ID = 2**53  # beyond this, whole numbers no longer fit a float
INT32, INT16, INT8 = 2**31 - 1, 2**15 - 1, 2**7 - 1
OTHER_LOCATION = "other location"
EXACT = "exact duplicate (vehicle, frame)"
CONFLICTING = "conflicting duplicate (vehicle, frame)"


@dataclass
class ReadReport:
    """What was read, what was dropped and why; nothing is dropped that is not counted here.

    Args:
        files: the files, in the order they were read.
        rows_read: rows in the files; equals ``rows_kept`` plus every ``dropped``.
        rows_kept: rows in the result.
        dropped: rows dropped, by reason.
        recordings: rows kept, by recording.
        vehicles: vehicles, counted per recording.
        segments: stretches without a missing frame.
        headways_given: space headways taken from the file.
        headways_derived: space headways derived from Preceding and Local_Y.
        headways_unknown: rows that name a preceding vehicle which has no row in that frame,
            and give no headway.
        empty_columns: columns that are absent, blank or zero throughout.
        notes: anything else worth a line.
    """

    files: list[str] = field(default_factory=list)
    rows_read: int = 0
    rows_kept: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    recordings: dict[str, int] = field(default_factory=dict)
    vehicles: int = 0
    segments: int = 0
    headways_given: int = 0
    headways_derived: int = 0
    headways_unknown: int = 0
    empty_columns: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def lines(self) -> list[str]:
        """The report as plain lines."""
        recordings = ", ".join(f"{name} ({rows:,} rows)" for name, rows in self.recordings.items())
        return [
            f"read {self.rows_read:,} rows from {', '.join(self.files)}; kept {self.rows_kept:,}",
            *(f"dropped {count:,} rows: {reason}" for reason, count in self.dropped.items()),
            f"{len(self.recordings)} recording(s): {recordings}",
            f"{self.vehicles:,} vehicles; missing frames cut their trajectories "
            f"{self.segments - self.vehicles:,} times, into {self.segments:,} segments",
            f"space headways: {self.headways_given:,} given, {self.headways_derived:,} derived "
            f"from positions, {self.headways_unknown:,} unknown (preceding vehicle not seen)",
            *self.notes,
        ]


@dataclass
class Trajectories:
    """Trajectories of any layout, in one shape.

    Args:
        samples: one row per vehicle and frame, sorted by recording, vehicle and frame: recording
            (category), vehicle (int64), frame (int32), segment (int32, distinct throughout the
            table, a stretch without a missing frame), time_s (0.1·frame), position_m (front
            bumper, Local_Y), lane (int16), length_m, vehicle_class (int8; 1 motorcycle, 2 car,
            3 truck, 0 unknown), speed_mps, acceleration_mps2, preceding (int64; 0 none) and
            space_headway_m (front to front; NaN where there is none).
        report: what was read and what was dropped.
    """

    samples: pd.DataFrame
    report: ReadReport


Columns = dict[str, NDArray]


@dataclass
class _Store:
    """What has been read so far: compact columns and the group each row belongs to."""

    report: ReadReport
    chunks: list[Columns] = field(default_factory=list)
    groups: dict[Group, int] = field(default_factory=dict)
    rows_of: list[int] = field(default_factory=list)
    locations: dict[str, int] = field(default_factory=dict)
    filled: dict[str, bool] = field(default_factory=dict)
    blank_classes: int = 0

    def group(self, group: Group, rows: int) -> int:
        code = self.groups.setdefault(group, len(self.groups))
        if code == len(self.rows_of):
            self.rows_of.append(0)
        self.rows_of[code] += rows
        return code

    def saw(self, name: str, anything: bool) -> None:
        self.filled[name] = self.filled.get(name, False) or anything


def read_ngsim(
    path: str | Path | Sequence[str | Path],
    location: str | None = None,
) -> Trajectories:
    """Read one or several NGSIM files, of any published layout, into SI.

    Header names match whatever their letter case, spaces and underscores. Needed are Vehicle_ID,
    Frame_ID, Local_Y, v_Length, v_Class, v_Vel, v_Acc, Lane_ID and Preceding; Global_Time,
    Space_Headway and Location are used where present. Cells may be blank in every other column
    and in Preceding, Space_Headway, Global_Time, v_Class and Location.

    Vehicle ids repeat between recordings. A recording is told by its location and the time of its
    frame 0 (see :mod:`lcc_rl.data.ngsim_recordings`); several files may hold parts of one. Exact
    duplicate rows are dropped, and of rows that disagree on one vehicle and frame the first stays.
    A Preceding that is blank, negative or the vehicle itself counts as none. A space headway that
    is blank or zero is derived from the positions in the same frame.

    Args:
        path: file or files, plain or gzipped.
        location: keep only rows of this Location (such as ``i-80``), whatever its letter case.

    Raises:
        DataError: if a file is missing, damaged, of no known layout, or a needed cell is blank or
            no such number; it names the file, the line and the column.
    """
    paths = [path] if isinstance(path, (str, Path)) else list(path)
    if not paths:
        raise DataError("no NGSIM file was named; expected at least one path")
    store = _Store(ReadReport(files=[str(name) for name in paths]))
    wanted = None if location is None else location.strip().lower()
    for name in paths:
        for block in read_blocks(name):
            store.report.rows_read += block.rows_read
            _take(store, block, wanted)
    if not store.chunks:
        raise DataError(_none_left_message(store, location))
    return Trajectories(_table(store), store.report)


def _none_left_message(store: _Store, location: str | None) -> str:
    files = ", ".join(store.report.files)
    found = ", ".join(
        f"{name or 'blank'} ({rows:,} rows)" for name, rows in store.locations.items()
    )
    return f"{files}: no row has Location {location!r}; the locations found are {found}"


def _take(store: _Store, block: Block, wanted: str | None) -> None:
    """Add a block's rows of the wanted location to the store."""
    names, places = [""], np.zeros(len(block), dtype=np.int64)
    if block.has("Location"):
        names, places = block.locations()
        for place, rows in enumerate(np.bincount(places, minlength=len(names))):
            if rows:
                store.locations[names[place]] = store.locations.get(names[place], 0) + int(rows)
    if wanted is not None:
        places = _filter(store, block, wanted, names, places)
    if len(block):
        store.chunks.append(_columns(store, block, names, places))


def _filter(
    store: _Store, block: Block, wanted: str, names: list[str], places: NDArray[np.int64]
) -> NDArray[np.int64]:
    if not block.has("Location"):
        raise DataError(
            f"{block.path}: has no column 'Location' to look for {wanted!r} in; leave the "
            "location unset"
        )
    mask = np.array([name == wanted for name in names])[places]
    dropped = len(mask) - int(mask.sum())
    if dropped:
        reasons = store.report.dropped
        reasons[OTHER_LOCATION] = reasons.get(OTHER_LOCATION, 0) + dropped
        block.keep(mask)
    return places[mask]


def _columns(store: _Store, block: Block, names: list[str], places: NDArray[np.int64]) -> Columns:
    """The needed columns of a block, in SI and compact types."""
    frame = block.integers("Frame_ID", 0, INT32)
    vehicle = block.integers("Vehicle_ID", 1, LARGEST_ID)
    preceding = block.integers("Preceding", -LARGEST_ID, LARGEST_ID, blank=0)
    preceding[(preceding < 0) | (preceding == vehicle)] = 0
    kinds = block.integers("v_Class", -1, INT8, blank=-1)
    store.blank_classes += int((kinds < 0).sum())
    headway = np.zeros(len(block), dtype=np.float32)
    if block.has("Space_Headway"):
        headway = _metres(block, "Space_Headway", "feet", blank=0.0)
    columns: Columns = {
        "group": _groups(store, block, frame, names, places),
        "vehicle": vehicle,
        "frame": frame.astype(np.int32),
        "position_m": _metres(block, "Local_Y", "feet"),
        "lane": block.integers("Lane_ID", -INT16, INT16).astype(np.int16),
        "length_m": _metres(block, "v_Length", "feet"),
        "vehicle_class": np.maximum(kinds, 0).astype(np.int8),
        "speed_mps": _metres(block, "v_Vel", "ft/s"),
        "acceleration_mps2": _metres(block, "v_Acc", "ft/s²"),
        "preceding": preceding,
        "space_headway_m": headway,
    }
    for official, own in COLUMN_OF.items():
        store.saw(official, bool(columns[own].any()))
    return columns


COLUMN_OF = {
    "v_Length": "length_m",
    "v_Class": "vehicle_class",
    "v_Vel": "speed_mps",
    "v_Acc": "acceleration_mps2",
    "Lane_ID": "lane",
    "Preceding": "preceding",
    "Space_Headway": "space_headway_m",
}


def _metres(block: Block, name: str, unit: str, blank: float | None = None) -> NDArray[np.float32]:
    """A column in SI; numbers too large to be real would overflow to infinity."""
    values = block.numbers(name, unit, blank)
    large = np.abs(values) > 1e9
    if large.any():
        block.fail(int(np.argmax(large)), name, f"{unit}, at most 1e9 in size")
    return (values * FOOT).astype(np.float32)


def _groups(
    store: _Store,
    block: Block,
    frame: NDArray[np.int64],
    names: list[str],
    places: NDArray[np.int64],
) -> NDArray[np.int32]:
    """Code of each row's (file, location, time of frame 0)."""
    clock = np.zeros(len(block))
    if block.has("Global_Time"):
        clock = block.numbers("Global_Time", "milliseconds", blank=0.0)
    store.saw("Global_Time", bool(clock.any()))
    starts = _frame_zero(clock, frame)
    distinct, which = np.unique(starts, return_inverse=True)
    pairs, inverse = np.unique(which * len(names) + places, return_inverse=True)
    rows = np.bincount(inverse)
    codes = [
        store.group(
            Group(block.path, names[pair % len(names)], int(distinct[pair // len(names)])),
            int(count),
        )
        for pair, count in zip(pairs, rows, strict=True)
    ]
    return np.array(codes, dtype=np.int32)[inverse]


def _frame_zero(clock: NDArray[np.float64], frame: NDArray[np.int64]) -> NDArray[np.int64]:
    """Time of frame 0 by each row's clock [ms]; 0 where the clock cannot be an epoch."""
    plausible = (clock >= 1e8) & (clock < 1e14)
    starts = np.rint(np.where(plausible, clock, 0.0)).astype(np.int64) - 100 * frame
    return np.where(plausible & (starts > 0), starts, 0)


def _table(store: _Store) -> pd.DataFrame:
    """The samples, sorted, without duplicates, with segments and headways."""
    columns = _joined(store.chunks)
    recording, names = _recordings(store, columns.pop("group"))
    places = Places(recording, columns["vehicle"], columns["frame"])
    key = places.keys(recording, columns["vehicle"], columns["frame"])
    order, key = _kept_order(store, columns, key)
    recording = recording[order]
    for name in list(columns):  # one column at a time, to hold only one extra copy
        columns[name] = columns[name][order]
    segment = _segments(key, recording, columns)
    _fill_headways(store.report, columns, recording, places, key)
    _count(store, recording, names, segment, columns["vehicle"])
    return _frame(columns, recording, names, segment)


def _joined(chunks: list[Columns]) -> Columns:
    """Columns of all blocks; a block's part is freed as soon as it is copied."""
    return {name: np.concatenate([chunk.pop(name) for chunk in chunks]) for name in list(chunks[0])}


def _recordings(store: _Store, group: NDArray[np.int32]) -> tuple[NDArray[np.int16], list[str]]:
    """Recording code of every row and the sorted names of the recordings."""
    named, notes = name_recordings(dict(zip(store.groups, store.rows_of, strict=True)))
    store.report.notes += notes
    names = sorted(set(named.values()))
    if len(names) > INT16:
        raise DataError(
            f"{', '.join(store.report.files)}: {len(names):,} recordings; expected a handful. "
            "Global_Time does not run 100 ms a frame"
        )
    place = {name: code for code, name in enumerate(names)}
    codes = np.array([place[named[key]] for key in store.groups], dtype=np.int16)
    return codes[group], names


def _kept_order(
    store: _Store, columns: Columns, key: NDArray[np.int64]
) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Rows to keep in sorted order, and their keys; duplicates are counted by kind."""
    order = np.argsort(key, kind="stable")  # stable: the first in the files stays
    key = key[order]
    repeated = np.zeros(len(key), dtype=bool)
    repeated[1:] = key[1:] == key[:-1]
    if not repeated.any():
        return order, key
    first = np.maximum.accumulate(np.where(repeated, 0, np.arange(len(key))))
    again, kept = order[repeated], order[first[repeated]]
    same = np.ones(len(again), dtype=bool)
    for values in columns.values():
        same &= values[again] == values[kept]
    for reason, count in ((EXACT, int(same.sum())), (CONFLICTING, int((~same).sum()))):
        if count:
            store.report.dropped[reason] = count
    if not same.all():
        store.report.notes.append(
            "rows that disagree on the same vehicle and frame: the first in the files was kept; "
            "the files may mix recordings that Global_Time cannot tell apart"
        )
    return order[~repeated], key[~repeated]


def _segments(
    key: NDArray[np.int64], recording: NDArray[np.int16], columns: Columns
) -> NDArray[np.int32]:
    """Number of the stretch without a missing frame that each sorted row belongs to."""
    vehicle = columns["vehicle"]
    breaks = np.zeros(len(key), dtype=np.int32)
    # Keys of one vehicle's consecutive frames differ by one, but so may two vehicles' keys.
    breaks[1:] = (
        (np.diff(key) != 1) | (vehicle[1:] != vehicle[:-1]) | (recording[1:] != recording[:-1])
    )
    return np.cumsum(breaks, dtype=np.int32)


def _fill_headways(
    report: ReadReport,
    columns: Columns,
    recording: NDArray[np.int16],
    places: Places,
    key: NDArray[np.int64],
) -> None:
    """Derive blank or zero headways from the positions of a frame; NaN where there is none."""
    headway, preceding = columns["space_headway_m"], columns["preceding"]
    follows = preceding > 0
    given = follows & (headway != 0)
    headway[~given] = np.nan
    rows = np.flatnonzero(follows & ~given)
    leader = find(places.keys(recording[rows], preceding[rows], columns["frame"][rows]), key)
    rows, leader = rows[leader >= 0], leader[leader >= 0]
    position = columns["position_m"]
    headway[rows] = position[leader] - position[rows]
    report.headways_given = int(given.sum())
    report.headways_derived = len(rows)
    report.headways_unknown = int(follows.sum()) - report.headways_given - len(rows)


def _count(
    store: _Store,
    recording: NDArray[np.int16],
    names: list[str],
    segment: NDArray[np.int32],
    vehicle: NDArray[np.int64],
) -> None:
    report = store.report
    changes = (vehicle[1:] != vehicle[:-1]) | (recording[1:] != recording[:-1])
    report.vehicles = 1 + int(changes.sum())
    report.rows_kept = len(recording)
    rows = np.bincount(recording, minlength=len(names))
    report.recordings = {name: int(count) for name, count in zip(names, rows, strict=True)}
    report.segments = int(segment[-1]) + 1
    report.empty_columns = [name for name, filled in store.filled.items() if not filled]
    report.notes += [_empty_note(name) for name in report.empty_columns]
    if store.blank_classes and store.filled["v_Class"]:
        report.notes.append(f"v_Class is blank in {store.blank_classes:,} rows: class unknown")


def _empty_note(name: str) -> str:
    meaning = {
        "v_Class": "nothing to filter vehicle classes on",
        "v_Length": "gaps are front to front, not bumper to bumper",
        "Space_Headway": "space headways are derived from positions",
        "Global_Time": "recordings are told apart by file",
        "Preceding": "no vehicle follows another",
    }
    return f"{name} is all zero or blank: {meaning.get(name, 'nothing to learn from it')}"


def _frame(
    columns: Columns, recording: NDArray[np.int16], names: list[str], segment: NDArray[np.int32]
) -> pd.DataFrame:
    """The table, in its documented column order and without copying the columns."""
    series: dict[str, Any] = {
        "recording": pd.Categorical.from_codes(recording, categories=pd.Index(names)),
        "vehicle": columns["vehicle"],
        "frame": columns["frame"],
        "segment": segment,
        # Division rounds correctly where the product 0.1·frame does not.
        "time_s": columns["frame"] / round(1 / FRAME),
        **{name: values for name, values in columns.items() if name not in ("vehicle", "frame")},
    }
    return pd.DataFrame(series, copy=False)
