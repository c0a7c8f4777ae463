"""Sorting of collected NGSIM rows: duplicates, recordings, segments and space headways."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lcc_rl.data.ngsim_columns import INT16, CollectedRows, Columns
from lcc_rl.data.ngsim_recordings import name_recordings
from lcc_rl.data.places import Places, find
from lcc_rl.data.units import FRAME
from lcc_rl.errors import DataError

EXACT = "exact duplicate (vehicle, frame)"
CONFLICTING = "conflicting duplicate (vehicle, frame)"
CONSEQUENCES = {
    "v_Class": "nothing to filter vehicle classes on",
    "v_Length": "gaps are front to front, not bumper to bumper",
    "Space_Headway": "space headways are derived from positions",
    "Global_Time": "recordings are told apart by file",
    "Preceding": "no vehicle follows another",
}


def sorted_table(read: CollectedRows) -> pd.DataFrame:
    """Samples of all collected rows, sorted, without duplicates, with segments and headways."""
    columns = _joined(read.chunks)
    columns["recording"], names = _recordings(read, columns.pop("group"))
    places = Places(columns["recording"], columns["vehicle"], columns["frame"])
    key = places.keys(columns["recording"], columns["vehicle"], columns["frame"])
    order, key = _kept_order(read, columns, key)
    for name in list(columns):  # one column at a time, to hold only one extra copy
        columns[name] = columns[name][order]
    read.report.rows_kept = len(order)
    segment = _segments(read, columns, names, key)
    _fill_headways(read, columns, places, key)
    _note_empty_columns(read)
    recording = pd.Categorical.from_codes(columns.pop("recording"), categories=pd.Index(names))
    vehicle, frame = columns.pop("vehicle"), columns.pop("frame")
    # Division rounds correctly where the product 0.1·frame does not.
    time = {"time_s": frame / round(1 / FRAME)}
    identity = {"recording": recording, "vehicle": vehicle, "frame": frame, "segment": segment}
    return pd.DataFrame(identity | time | columns, copy=False)


def _joined(chunks: list[Columns]) -> Columns:
    """Columns of all blocks; a block's part is freed as soon as it is copied."""
    return {name: np.concatenate([chunk.pop(name) for chunk in chunks]) for name in list(chunks[0])}


def _recordings(
    read: CollectedRows, group: NDArray[np.int32]
) -> tuple[NDArray[np.int16], list[str]]:
    """Recording code of every row and the sorted names of the recordings."""
    named, notes = name_recordings(dict(zip(read.groups, read.rows_of, strict=True)))
    read.report.notes += notes
    names = sorted(set(named.values()))
    if len(names) > INT16:
        raise DataError(
            f"{', '.join(read.report.files)}: {len(names):,} recordings; expected a handful. "
            "Global_Time does not run 100 ms a frame"
        )
    place = {name: code for code, name in enumerate(names)}
    return np.array([place[named[key]] for key in read.groups], dtype=np.int16)[group], names


def _kept_order(
    read: CollectedRows, columns: Columns, key: NDArray[np.int64]
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
            read.report.dropped[reason] = count
    if not same.all():
        read.report.notes.append(
            "rows that disagree on the same vehicle and frame: the first in the files was kept; "
            "the files may mix recordings that Global_Time cannot tell apart"
        )
    return order[~repeated], key[~repeated]


def _segments(
    read: CollectedRows, columns: Columns, names: list[str], key: NDArray[np.int64]
) -> NDArray[np.int32]:
    """Segment of each sorted row; counts recordings, vehicles and segments."""
    recording, vehicle = columns["recording"], columns["vehicle"]
    changes = (vehicle[1:] != vehicle[:-1]) | (recording[1:] != recording[:-1])
    # Keys of one vehicle's consecutive frames differ by one, but so may two vehicles' keys.
    breaks = np.append(False, changes | (np.diff(key) != 1))
    segment = np.cumsum(breaks, dtype=np.int32)
    rows = np.bincount(recording, minlength=len(names))
    read.report.recordings = {name: int(count) for name, count in zip(names, rows, strict=True)}
    read.report.vehicles = 1 + int(changes.sum())
    read.report.segments = int(segment[-1]) + 1
    return segment


def _fill_headways(
    read: CollectedRows, columns: Columns, places: Places, key: NDArray[np.int64]
) -> None:
    """Derive blank or zero headways from the positions of a frame; NaN where there is none."""
    headway, preceding = columns["space_headway_m"], columns["preceding"]
    follows = preceding > 0
    given = follows & (headway != 0)
    headway[~given] = np.nan
    rows = np.flatnonzero(follows & ~given)
    wanted = places.keys(columns["recording"][rows], preceding[rows], columns["frame"][rows])
    leader = find(wanted, key)
    rows, leader = rows[leader >= 0], leader[leader >= 0]
    position = columns["position_m"]
    headway[rows] = position[leader] - position[rows]
    report = read.report
    report.headways_given, report.headways_derived = int(given.sum()), len(rows)
    report.headways_unknown = int(follows.sum()) - report.headways_given - len(rows)


def _note_empty_columns(read: CollectedRows) -> None:
    report = read.report
    report.empty_columns = [name for name, filled in read.filled.items() if not filled]
    for name in report.empty_columns:
        consequence = CONSEQUENCES.get(name, "nothing to learn from it")
        report.notes.append(f"{name} is all zero or blank: {consequence}")
    if read.blank_classes and read.filled["v_Class"]:
        report.notes.append(f"v_Class is blank in {read.blank_classes:,} rows: class unknown")
