"""Vehicle trajectories in SI units, the report of their reader, and leaders of vehicles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

FOOT = 0.3048  # m
FRAME = 0.1  # s; every published NGSIM file has 10 frames a second
BATCH = 2**17  # rows of a large table that are converted or compared at a time
CAR_LENGTH = (3.0, 12.0)  # range of the median length of vehicles on any road [m]
SAMPLE_KEYS = ("recording", "vehicle", "frame", "preceding")
# Columns of trajectories besides the recording.
SAMPLE_TYPES = {
    "vehicle": np.int64,
    "frame": np.int32,
    "segment": np.int32,
    "time_s": np.float64,
    "position_m": np.float32,
    "lane": np.int16,
    "length_m": np.float32,
    "vehicle_class": np.int8,
    "speed_mps": np.float32,
    "acceleration_mps2": np.float32,
    "preceding": np.int64,
    "space_headway_m": np.float32,
}


@dataclass
class ReadReport:
    """Counts of rows read and dropped.

    Args:
        files: the files, in the order of reading.
        read_as: words on columns with configured units.
        units: these units, by the keys of ``data.units``.
        rows_read: rows in the files; equals ``rows_kept`` plus every ``dropped``.
        rows_kept: rows in the result.
        dropped: rows dropped, by reason.
        recordings: rows kept, by recording.
        vehicles: vehicles, counted per recording.
        names: names of numbered vehicles, by number, if the files name vehicles.
        segments: stretches without a missing frame.
        headways_given: space headways read from the file.
        headways_derived: space headways derived from Preceding and Local_Y.
        headways_unknown: rows without a headway and with a preceding vehicle that has no row in
            that frame.
        empty_columns: columns that are absent, blank or zero throughout.
        notes: further remarks, one a line.
    """

    files: list[str] = field(default_factory=list)
    read_as: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    rows_read: int = 0
    rows_kept: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    recordings: dict[str, int] = field(default_factory=dict)
    vehicles: int = 0
    names: dict[int, str] = field(default_factory=dict)
    segments: int = 0
    headways_given: int = 0
    headways_derived: int = 0
    headways_unknown: int = 0
    empty_columns: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return "\n".join(self.lines())

    @property
    def source(self) -> str:
        """The files and their units, the subject of messages."""
        return listed(self.files) + self.read_as

    def drop(self, reason: str, count: int) -> None:
        """Count dropped rows by reason."""
        if count:
            self.dropped[reason] = self.dropped.get(reason, 0) + count

    def left_out(self) -> list[str]:
        """Return a line for each reason to drop rows."""
        return [f"dropped {count:,} rows: {reason}" for reason, count in self.dropped.items()]

    def lines(self) -> list[str]:
        """Return the report as plain lines."""
        recordings = [f"{name} ({rows:,} rows)" for name, rows in self.recordings.items()]
        return [
            f"read {self.rows_read:,} rows from {listed(self.files)}; kept {self.rows_kept:,}",
            *self.left_out(),
            f"{len(self.recordings)} recording(s): {listed(recordings)}",
            f"{self.vehicles:,} vehicles; missing frames cut their trajectories "
            f"{self.segments - self.vehicles:,} times, into {self.segments:,} segments",
            f"space headways: {self.headways_given:,} given, {self.headways_derived:,} derived "
            f"from positions, {self.headways_unknown:,} unknown (preceding vehicle not seen)",
            *self.notes,
        ]


def listed(names: Sequence[str]) -> str:
    """Return a list of names, only the first and last ones of many.

    Examples:
        >>> listed(["a", "b", "c", "d", "e"])
        'a, b … e'
    """
    if len(names) <= 3:
        return ", ".join(names)
    return f"{names[0]}, {names[1]} … {names[-1]}"


@dataclass
class Trajectories:
    """Trajectories in one layout.

    Args:
        samples: one row per vehicle and frame, sorted by recording, vehicle and frame: recording
            (category), vehicle (int64), frame (int32), segment (int32, distinct throughout the
            table, a stretch without a missing frame), time_s (0.1·frame), position_m (front
            bumper, Local_Y), lane (int16), length_m, vehicle_class (int8; 1 motorcycle, 2 car,
            3 truck, 0 unknown), speed_mps, acceleration_mps2, preceding (int64; 0 none) and
            space_headway_m (front to front; NaN if there is none).
        report: report of the reader.
    """

    samples: pd.DataFrame
    report: ReadReport


def median_lengths(samples: pd.DataFrame) -> pd.Series:
    """Return the median length of the vehicles of each recording that have one [m]."""
    sized = samples[samples["length_m"] > 0]
    lengths = sized.groupby(["recording", "vehicle"], observed=True)["length_m"].first()
    return lengths.groupby("recording", observed=True).median()


def assembled(
    columns: dict[str, NDArray], recordings: Sequence[str], report: ReadReport
) -> Trajectories:
    """Return sorted rows as trajectories, and count them in the report.

    Args:
        columns: recording (a number), vehicle, frame, further columns of ``TYPES``, and others. The
            mapping is emptied, because a table may hold millions of rows. Missing columns are 0,
            ``segment`` and ``time_s`` follow from the frames, and space headways that are blank or
            0 from the positions in the frame.
        recordings: names of the recordings.
        report: the report, which is completed.
    """
    _fill_headways(columns, report)
    code, vehicle, frame = columns.pop("recording"), columns["vehicle"], columns["frame"]
    changes = np.append(True, (np.diff(vehicle) != 0) | (np.diff(code) != 0))
    if "segment" not in columns:
        columns["segment"] = np.cumsum(changes | (np.diff(frame, prepend=0) != 1)) - 1
    if "time_s" not in columns:  # division rounds correctly, the product 0.1·frame does not
        columns["time_s"] = frame / round(1 / FRAME)
    report.rows_kept, report.vehicles = len(code), int(changes.sum())
    report.segments = len(starts_of(columns["segment"]))
    counts = np.bincount(code, minlength=len(recordings))
    report.recordings = {name: int(count) for name, count in zip(recordings, counts, strict=True)}
    samples: dict[str, Any] = {
        "recording": pd.Categorical.from_codes(code, categories=pd.Index(recordings))
    }
    for name, kind in SAMPLE_TYPES.items():
        values = columns.pop(name) if name in columns else np.zeros(len(code))
        samples[name] = values.astype(kind, copy=False)
    return Trajectories(pd.DataFrame({**samples, **columns}, copy=False), report)


def _fill_headways(columns: dict[str, NDArray], report: ReadReport) -> None:
    """Derive blank or zero headways from the positions of a frame; NaN if there is none."""
    code, vehicle, frame, preceding = (columns[name] for name in SAMPLE_KEYS)
    headway = columns.setdefault("space_headway_m", np.zeros(len(code)))
    follows = preceding > 0
    measured = follows & (headway != 0) & ~np.isnan(headway)
    headway[~measured] = np.nan
    report.headways_given, unknown = int(measured.sum()), follows & ~measured
    if unknown.any():
        leader = find_leaders(code, vehicle, frame, np.where(unknown, preceding, 0))
        rows, position = np.flatnonzero(leader >= 0), columns["position_m"]
        headway[rows] = position[leader[rows]] - position[rows]
        report.headways_derived = len(rows)
    report.headways_unknown = int(unknown.sum()) - report.headways_derived


class RowIndex:
    """One number per (recording, vehicle, frame), ascending in that order.

    Args:
        recording, vehicle, frame: those of every row; vehicles are positive, frames from 0.
    """

    def __init__(self, recording: NDArray, vehicle: NDArray, frame: NDArray) -> None:
        self.frames = int(frame.max()) + 1
        self.ids: NDArray | None = None
        self.vehicles = int(vehicle.max()) + 1
        if (int(recording.max()) + 1) * self.vehicles * self.frames >= 2**62:
            self.ids = np.unique(vehicle)  # ids are too far apart to pack: use their ranks
            self.vehicles = len(self.ids)

    def keys(self, recording: NDArray, vehicle: NDArray, frame: NDArray) -> NDArray[np.int64]:
        """Return the keys of places; −1 for an unknown vehicle or frame."""
        rank, valid = vehicle, (vehicle > 0) & (vehicle < self.vehicles)
        if self.ids is not None:
            rank = np.minimum(np.searchsorted(self.ids, vehicle), len(self.ids) - 1)
            valid = self.ids[rank] == vehicle
        valid &= frame < self.frames
        key = (recording.astype(np.int64) * self.vehicles + rank) * self.frames + frame
        return np.where(valid, key, -1)


def find_leaders(
    recording: NDArray, vehicle: NDArray, frame: NDArray, preceding: NDArray
) -> NDArray[np.int64]:
    """Return the row of each row's preceding vehicle in the same frame.

    Args:
        recording, vehicle, frame: those of the rows, which are sorted by them.
        preceding: id of the vehicle ahead of every row; 0 for none.

    Returns:
        Row numbers; −1 if there is no vehicle ahead or it has no row in that frame.
    """
    index = RowIndex(recording, vehicle, frame)
    wanted, ascending = (index.keys(recording, x, frame) for x in (preceding, vehicle))
    row = np.minimum(np.searchsorted(ascending, wanted), len(ascending) - 1)
    return np.where(ascending[row] == wanted, row, -1)


def starts_of(values: NDArray) -> NDArray[np.intp]:
    """Return the first row of each stretch of equal values."""
    return np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1]]))
