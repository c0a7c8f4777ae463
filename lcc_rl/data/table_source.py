"""Car-following episodes from trajectories in a table of any layout, by a map of its columns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field

from lcc_rl.data.car_following import Criteria
from lcc_rl.data.plausible import SMOOTHING, Plausible
from lcc_rl.data.sources import LoadedEpisodes, episodes_of, find_files
from lcc_rl.data.tables import LARGEST_ID, Column, TableFile, check_names, factors, stem
from lcc_rl.data.trajectories import FRAME, ReadReport, Trajectories, find_leaders, stretches
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.settings import Positive, Settings

FIELDS = (
    Column("vehicle", "text"),
    Column("time", "time"),
    Column("speed", "speed", least=0.0),
    Column("position", "length", required=False),
    Column("lane", "text", required=False),
    Column("leader", "text", blank=True, required=False),
    Column("gap", "length", least=0.0, blank=True, required=False),
    Column("length", "length", least=0.0, blank=True, required=False),
    Column("recording", "text", required=False),
)
COLUMNS: dict[str, str | None] = {"vehicle": "vehicle", "time": "time_s", "speed": "speed_mps"}
UNEVEN = 0.1  # of a step, by which a time may be off the common grid
HOLE = 1.5  # of the usual step; a longer one is a missing sample
LONGEST = 10.0  # s; samples farther apart tell of no following
LAST = 2**31 - 1  # frame
AGREE = (0.8, 1.25)  # way by positions over way by speeds
LEAST_WAY = 50.0  # m, below which that is not compared
EXACT, ALONE = "exact duplicate (vehicle, time)", "stretch without a sample on the time grid"
Floats = NDArray[np.float64]
Whole = NDArray[np.int64]


class TableSource(Settings):
    """Episodes extracted from trajectories in CSV or parquet tables; each file is a recording.

    ``columns`` are what the table calls ``vehicle``, ``time``, ``speed``, ``position`` (front
    bumper along the road), ``lane``, ``leader`` (the vehicle ahead; blank or 0 for none), ``gap``
    (bumper to bumper), ``length`` and ``recording``; null for what it does not have. The vehicle
    ahead is named by a column, or is the nearest one on the lane. The gap is that of a column, or
    the difference of positions less the leader's length. Samples are brought to 0.1 s.
    """

    path: str | Sequence[str]  # a file, several files, or a pattern
    columns: Mapping[str, str | None] = Field(default_factory=lambda: dict(COLUMNS))
    units: Mapping[str, str] = Field(default_factory=dict)  # such as {speed: km/h}; else SI
    vehicle_length: Positive | None = None  # of vehicles whose length no column gives [m]
    smoothing: Callable | None = None  # of positions, see lcc_rl.data.smoothing
    criteria: Criteria | None = None  # None for the defaults
    plausible: Plausible | None = None  # None for the defaults

    def settled(self) -> None:
        check_names(self.columns, FIELDS, "data.columns")
        factors(self.units, FIELDS, "data.units")
        given = {key for key, name in self._names().items() if name is not None}
        sized = "length" in given or self.vehicle_length is not None
        if not ("leader" in given or {"lane", "position"} <= given):
            raise ConfigError("data.columns must name leader, or lane and position")
        if not ("gap" in given or ("position" in given and sized)):
            raise ConfigError(
                "data.columns must name gap, or position and length (or say data.vehicle_length)"
            )
        if self.smoothing is not None and ("gap" in given or "position" not in given):
            raise ConfigError(
                "data.smoothing smooths positions: name data.columns.position, not gap"
            )

    def _names(self) -> dict[str, str | None]:
        return {**COLUMNS, **self.columns}

    def load(self) -> LoadedEpisodes:
        """Read, smooth where asked, and extract.

        Raises:
            DataError: naming the file, row and column, if a file is missing, damaged or holds what
                it must not, no episode is left, or more are implausible than ``plausible`` allows.
        """
        files = find_files(self.path)
        report = ReadReport(files=files)
        rows, names = self._rows(files, report)
        trajectories = to_trajectories(rows, names, report)
        if self.smoothing is not None:
            trajectories = self.smoothing(trajectories)
        smooth = f", smooth it ({SMOOTHING})" if rows.position is not None else ""
        remedy = f", name its units (data.units){smooth}"
        return episodes_of(trajectories, self.criteria, self.plausible, remedy)

    def _rows(self, files: Sequence[str], report: ReadReport) -> tuple[Rows, list[str]]:
        """Rows of all files in SI, and the names of the recordings."""
        scale = factors(self.units, FIELDS)
        parts = []
        for name, label in zip(files, labels(files), strict=True):
            table = TableFile(name)
            part = table.read(FIELDS, self._names(), scale, "data.columns")
            rows = np.arange(len(part["time"]))
            parts.append({"recording": np.full(len(rows), label), **part, "row": rows})
            report.notes += table.notes
        columns = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
        report.rows_read = len(columns["time"])
        if not report.rows_read:
            raise DataError(f"{', '.join(files)}: has a header but no rows")
        columns |= _vehicles(columns["vehicle"], columns.get("leader"), report)
        if self.vehicle_length is not None:
            length = columns.get("length", np.zeros(report.rows_read))
            columns["length"] = np.where(length > 0, length, self.vehicle_length)
        if "lane" in columns:
            columns["lane"] = np.unique(columns["lane"], return_inverse=True)[1]
        names, columns["recording"] = np.unique(columns["recording"], return_inverse=True)
        return Rows(**columns), names.tolist()


def labels(files: Sequence[str]) -> list[str]:
    """Return the names of files' recordings: without their folders, if that is enough."""
    stems = [stem(name) for name in files]
    return [x if stems.count(x) == 1 else name for x, name in zip(stems, files, strict=True)]


def _vehicles(
    vehicle: NDArray, leader: NDArray | None, report: ReadReport
) -> dict[str, NDArray[np.int64]]:
    """Vehicles and leaders as positive whole numbers; 0 for no leader."""
    numbers = _whole(vehicle)
    ahead = None if leader is None else _whole(np.where(leader == "", "0", leader))
    if numbers is not None and numbers.min() > 0 and (leader is None or ahead is not None):
        if ahead is None:
            return {"vehicle": numbers}
        return {"vehicle": numbers, "leader": np.where((ahead < 0) | (ahead == numbers), 0, ahead)}
    names, codes = np.unique(vehicle, return_inverse=True)
    report.notes.append(f"vehicles are numbered from 1 in the order of {len(names):,} names")
    numbers = codes.astype(np.int64) + 1
    if leader is None:
        return {"vehicle": numbers}
    known = pd.Index(names).get_indexer(leader) + 1
    none = (leader == "") | (np.isin(leader, ("0", "-1", "0.0", "-1.0")) & (known == 0))
    # A leader without a row is a number that no vehicle has.
    ahead = np.where(none, 0, np.where(known == 0, len(names) + 1, known))
    return {"vehicle": numbers, "leader": np.where(ahead == numbers, 0, ahead).astype(np.int64)}


def _whole(texts: NDArray) -> NDArray[np.int64] | None:
    """The numbers that texts are, if all are whole numbers."""
    try:
        values = texts.astype(np.float64)
    except ValueError:
        return None
    if not (np.abs(values) < LARGEST_ID).all() or (values != np.rint(values)).any():
        return None
    return values.astype(np.int64)


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
    counts = np.bincount(rows.recording, minlength=len(names))
    report.recordings = dict(zip(names, map(int, counts), strict=True))
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
    report.drop(EXACT, int(again.sum()))
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

    starts, lengths = stretches(segment)
    parts, before, values = [], [], []
    for start, end in zip(starts, starts + lengths, strict=True):
        grid = np.arange(np.ceil(place[start] - 1e-6), np.floor(place[end - 1] + 1e-6) + 1)
        if end - start < 2 or not len(grid):
            report.drop(ALONE, int(end - start))
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
