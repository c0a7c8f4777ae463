"""From rows of a table to trajectories: order, duplicates, stretches and a common step of time."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lcc_rl.data.places import find_leaders
from lcc_rl.data.trajectories import ReadReport, Trajectories
from lcc_rl.data.units import FRAME
from lcc_rl.errors import DataError

UNEVEN = 0.1  # of a step, by which a time may be off the common grid
HOLE = 1.5  # of the usual step; a longer one is a missing sample
LONGEST = 10.0  # s; samples farther apart tell of no following
LAST = 2**31 - 1  # frame
AGREE = (0.8, 1.25)  # way by positions over way by speeds
LEAST_WAY = 50.0  # m, below which that is not compared
EXACT, ALONE = "exact duplicate (vehicle, time)", "stretch without a sample on the time grid"
Floats = NDArray[np.float64]
Whole = NDArray[np.int64]


@dataclass(frozen=True)
class Rows:
    """Rows of one or several files in SI, one entry per vehicle and moment.

    Args:
        recording: number of the recording.
        vehicle: positive.
        time: [s].
        speed: [m/s].
        row: number in the file, from 0.
        leader: the vehicle ahead; 0 for none; None where there is no such column.
        position: front bumper, along the road [m].
        lane: lane as a number.
        gap: bumper to bumper [m]; NaN for none.
        length: of the vehicle [m]; NaN or 0 for not given.
    """

    recording: Whole
    vehicle: Whole
    time: Floats
    speed: Floats
    row: Whole
    leader: Whole | None = None
    position: Floats | None = None
    lane: Whole | None = None
    gap: Floats | None = None
    length: Floats | None = None

    def __len__(self) -> int:
        return len(self.time)

    def take(self, index: NDArray) -> Rows:
        """Return some of the rows."""
        return replace(self, **{name: values[index] for name, values in self.columns()})

    def columns(self) -> list[tuple[str, NDArray]]:
        """Return the columns that there are."""
        pairs = [(entry.name, getattr(self, entry.name)) for entry in fields(self)]
        return [(name, values) for name, values in pairs if values is not None]

    def together(self) -> NDArray[np.bool_]:
        """Whether each row but the first is of the same vehicle as the one before it."""
        same = (np.diff(self.vehicle) == 0) & (np.diff(self.recording) == 0)
        return np.asarray(same, dtype=bool)


def to_trajectories(rows: Rows, names: list[str], report: ReadReport) -> Trajectories:
    """Bring rows into the shape that episodes are extracted from.

    Args:
        rows: in any order.
        names: of the recordings.
        report: completed here.

    Raises:
        DataError: if rows contradict each other, times are uneven, or speeds and positions do not
            agree; it names file, row and column.
    """
    rows = _ordered(rows, names, report)
    step, cut = _stretches(rows, names, report)
    _check_way(rows, cut, ", ".join(report.files))
    report.vehicles = len(rows) - int(rows.together().sum())
    report.segments = 1 + int(cut.sum())
    origin = np.array([rows.time[rows.recording == code].min() for code in range(len(names))])
    segment = np.append(0, np.cumsum(cut))
    place = (rows.time - origin[rows.recording]) / FRAME
    late = place > LAST
    if late.any():
        row = int(np.argmax(late))
        raise DataError(
            f"{_place(rows, row, names, report)} is {FRAME * place[row]:g} s after the first; "
            "is the time in another unit?"
        )
    frame = np.rint(place).astype(np.int64)
    if abs(step - FRAME) > UNEVEN * FRAME or np.abs(place - frame).max() > UNEVEN:
        rows, frame, segment = _interpolated(rows, place, segment, report)
        report.notes.append(f"samples {step:g} s apart were interpolated to {FRAME:g} s")
    report.rows_kept = len(rows)
    report.recordings = {
        name: int(count)
        for name, count in zip(
            names, np.bincount(rows.recording, minlength=len(names)), strict=True
        )
    }
    time = origin[rows.recording] + frame / round(1 / FRAME)
    return Trajectories(_samples(rows, names, time, frame, segment, report), report)


def _ordered(rows: Rows, names: list[str], report: ReadReport) -> Rows:
    """Sort by recording, vehicle and time; exact duplicates are dropped and counted."""
    order = np.lexsort((rows.row, rows.time, rows.vehicle, rows.recording))
    by_vehicle = np.lexsort((rows.row, rows.vehicle, rows.recording))
    if not np.array_equal(order, by_vehicle):
        report.notes.append("rows of a vehicle are not in order of time: sorted")
    rows = rows.take(order)
    again = np.append(False, rows.together() & (np.diff(rows.time) == 0))
    if not again.any():
        return rows
    at = np.flatnonzero(again)
    same = np.ones(len(at), dtype=bool)
    for name, values in rows.columns():
        if name != "row":
            same &= (values[at] == values[at - 1]) | (
                np.isnan(values[at].astype(float)) & np.isnan(values[at - 1].astype(float))
            )
    if not same.all():
        worst = int(at[np.argmin(same)])
        raise DataError(
            f"{_place(rows, worst, names, report)} and data row {rows.row[worst - 1] + 1} differ, "
            f"but are of one vehicle ({rows.vehicle[worst]}) at one time ({rows.time[worst]:g} s); "
            "expected one row"
        )
    report.dropped[EXACT] = int(again.sum())
    return rows.take(~again)


def _place(rows: Rows, row: int, names: list[str], report: ReadReport) -> str:
    """Where a row is, for messages."""
    recording = names[rows.recording[row]]
    return f"{', '.join(report.files)}: recording {recording}, data row {rows.row[row] + 1}"


def _stretches(rows: Rows, names: list[str], report: ReadReport) -> tuple[float, NDArray[np.bool_]]:
    """The usual step [s], and where a stretch without a missing sample ends."""
    inner, steps = rows.together(), np.diff(rows.time)
    if not inner.any():
        raise DataError(
            f"{', '.join(report.files)}: no vehicle has two samples; expected trajectories"
        )
    step = float(np.median(steps[inner]))
    if step > LONGEST:
        raise DataError(
            f"{', '.join(report.files)}: samples of a vehicle are {step:g} s apart; expected at "
            f"most {LONGEST:g} s; is the time in another unit?"
        )
    short = inner & (steps < step / 2)
    if short.any():
        row = int(np.argmax(short)) + 1
        raise DataError(
            f"{_place(rows, row, names, report)} is {steps[row - 1]:g} s after the sample before "
            f"it of vehicle {rows.vehicle[row]}; expected steps of about {step:g} s"
        )
    return step, ~inner | (steps > HOLE * step)


def _check_way(rows: Rows, cut: NDArray[np.bool_], files: str) -> None:
    """Check that positions and speeds tell of the same way: direction and units."""
    if rows.position is None:
        return
    inner = ~cut
    way = float(np.diff(rows.position)[inner].sum())
    mean = (rows.speed[1:] + rows.speed[:-1]) / 2
    driven = float((mean * np.diff(rows.time))[inner].sum())
    if driven < LEAST_WAY or AGREE[0] <= way / driven <= AGREE[1]:
        return
    backward = "; positions must grow in the direction of travel" if way < 0 else ""
    raise DataError(
        f"{files}: by their positions the vehicles drive {way:.4g} m, by their speeds "
        f"{driven:.4g} m{backward}; check data.units and data.columns of time, speed and position"
    )


def _interpolated(
    rows: Rows, place: Floats, segment: Whole, report: ReadReport
) -> tuple[Rows, Whole, Whole]:
    """Rows on the common grid of frames; a leader is that of both samples beside it."""
    from scipy.interpolate import PchipInterpolator  # here: it loads for a second

    starts = np.flatnonzero(np.diff(segment, prepend=-1))
    ends = np.append(starts[1:], len(rows))
    parts, before, values = [], [], []
    for start, end in zip(starts, ends, strict=True):
        grid = np.arange(np.ceil(place[start] - 1e-6), np.floor(place[end - 1] + 1e-6) + 1)
        if end - start < 2 or not len(grid):
            report.dropped[ALONE] = report.dropped.get(ALONE, 0) + int(end - start)
            continue
        at = place[start:end]
        known = [rows.speed] if rows.position is None else [rows.speed, rows.position]
        table = np.stack([column[start:end] for column in known], axis=1)
        values.append(PchipInterpolator(at, table)(grid.clip(at[0], at[-1])))
        before.append(start + np.searchsorted(at, grid + 1e-6, side="right") - 1)
        parts.append(grid.astype(np.int64))
    if not parts:
        raise DataError(f"{', '.join(report.files)}: no vehicle has two samples in a row")
    frame, first, table = np.concatenate(parts), np.concatenate(before), np.concatenate(values)
    first = np.maximum(first, 0)
    after = np.minimum(first + 1, len(rows) - 1)
    weight = np.zeros(len(first))
    inside = (segment[after] == segment[first]) & (after > first)
    span = np.where(inside, place[after] - place[first], 1.0)
    weight[inside] = ((frame - place[first]) / span)[inside].clip(0.0, 1.0)
    weight[weight < 1e-5] = 0.0
    found = replace(
        rows.take(first),
        speed=table[:, 0].clip(min=0.0),
        position=None if rows.position is None else table[:, 1],
    )
    if rows.leader is not None:
        alike = (weight == 0) | (rows.leader[after] == rows.leader[first])
        found = replace(found, leader=np.where(alike, rows.leader[first], 0))
    if rows.gap is not None:
        mixed = (1 - weight) * rows.gap[first] + weight * rows.gap[after]
        found = replace(found, gap=np.where(weight == 0, rows.gap[first], mixed))
    return found, frame, segment[first]


def _samples(
    rows: Rows, names: list[str], time: Floats, frame: Whole, segment: Whole, report: ReadReport
) -> pd.DataFrame:
    """The table of :class:`lcc_rl.data.trajectories.Trajectories`, with leaders and headways."""
    leader = _next_ahead(rows, frame) if rows.leader is None else rows.leader
    if rows.gap is not None:  # a vehicle without a gap follows nobody
        leader = np.where(np.isnan(rows.gap), 0, leader)
    ahead = find_leaders(rows.recording, rows.vehicle, frame, leader)
    seen = ahead >= 0
    length = np.zeros(len(rows)) if rows.length is None else np.nan_to_num(rows.length)
    headway = np.full(len(rows), np.nan)
    if rows.gap is not None:
        headway[seen] = rows.gap[seen] + length[ahead[seen]]
        report.headways_given = int(seen.sum())
    elif rows.position is not None:
        headway[seen] = rows.position[ahead[seen]] - rows.position[seen]
        report.headways_derived = int(seen.sum())
    report.headways_unknown = int(((leader > 0) & ~seen).sum())
    rate = np.diff(rows.speed, append=rows.speed[-1]) / FRAME
    last = np.append(np.diff(segment) != 0, True)
    single = np.float32
    return pd.DataFrame(
        {
            "recording": pd.Categorical.from_codes(rows.recording, categories=pd.Index(names)),
            "vehicle": rows.vehicle,
            "frame": frame.astype(np.int32),
            "segment": segment.astype(np.int32),
            "time_s": time,
            "position_m": (np.zeros(len(rows)) if rows.position is None else rows.position).astype(
                single
            ),
            "lane": np.zeros(len(rows), np.int16) if rows.lane is None else rows.lane.astype("i2"),
            "length_m": length.astype(single),
            "vehicle_class": np.zeros(len(rows), dtype=np.int8),
            "speed_mps": rows.speed.astype(single),
            "acceleration_mps2": np.where(last, 0.0, rate).astype(single),
            "preceding": leader,
            "space_headway_m": headway.astype(single),
        }
    )


def _next_ahead(rows: Rows, frame: Whole) -> Whole:
    """The nearest vehicle ahead on the same lane in the same frame; 0 for none."""
    assert rows.position is not None
    assert rows.lane is not None
    order = np.lexsort((rows.position, rows.lane, frame, rows.recording))
    keys = (rows.recording, frame, rows.lane)
    beside = np.logical_and.reduce([np.diff(key[order]) == 0 for key in keys])
    leader = np.zeros(len(rows), dtype=np.int64)
    leader[order[:-1][beside]] = rows.vehicle[order[1:][beside]]
    return leader
