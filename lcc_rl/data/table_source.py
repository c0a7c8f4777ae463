"""Car-following episodes from tables of trajectories, by a map of their columns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field

from lcc_rl.arrays import Integers
from lcc_rl.data.agreement import AGREE, LEAST_WAY
from lcc_rl.data.columns import Column, check_map
from lcc_rl.data.episodes import NO_LEADER
from lcc_rl.data.grid import (
    BRIDGE_S,
    LongestHole,
    Places,
    bridges,
    continuous,
    cut_by_files,
    on_grid,
    places,
    stretches,
)
from lcc_rl.data.plausible import SMOOTHING
from lcc_rl.data.sources import LoadedEpisodes, TrajectorySource, find_files, read_as, units_of
from lcc_rl.data.tables import TableFile, joined_columns, same_text, tables_of, whole_numbers
from lcc_rl.data.trajectories import (
    CAR_LENGTH,
    FRAME,
    ReadReport,
    Trajectories,
    assembled,
    find_leaders,
    listed,
    median_lengths,
)
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.settings import Positive

TABLE_FIELDS = (
    Column("vehicle", "text", "vehicle", blank=True),
    Column("time", "time", "time_s", blank=True),
    Column("speed", "speed", "speed_mps", blank=True),
    Column("position", "length", blank=True, required=False),
    Column("lane", "text", blank=True, required=False),
    Column("leader", "text", blank=True, required=False),
    Column("gap", "length", blank=True, required=False),
    Column("length", "length", least=0.0, blank=True, required=False),
    Column("recording", "text", blank=True, required=False),
)
TABLE_COLUMNS = {column.key: column.name for column in TABLE_FIELDS if column.name}
TABLE_MEASURED = ("time", "speed", "position")  # rows with a blank cell are left out
IDENTIFYING = ("vehicle", "lane", "recording")  # must not be blank in the other rows
REMOTE = 1e5  # positions beyond this are counted from the least: they are in single precision [m]
JUMP = 10.0  # jump of positions between samples beyond the driven distance [m]


class TableSource(TrajectorySource):
    """Episodes extracted from trajectories in CSV or parquet tables; each file is a recording.

    The vehicle ahead is that of the column ``leader``, or the nearest one on the lane. The gap is
    that of a column, or the difference of positions minus the leader's length. Samples are
    interpolated to 0.1 s.
    """

    path: str | Sequence[str]  # a file, several files, or a pattern
    # Names in the table of ``vehicle``, ``time``, ``speed``, ``position`` (front bumper along the
    # road), ``lane``, ``leader`` (blank or 0 for none), ``gap`` (bumper to bumper), ``length`` and
    # ``recording``; null for missing ones.
    columns: Mapping[str, str | None] = Field(default_factory=lambda: dict(TABLE_COLUMNS))
    units: Mapping[str, str] = Field(default_factory=dict)  # such as {speed: km/h}; else SI
    vehicle_length: Positive | None = None  # length of vehicles without one in a column [m]
    smoothing: Callable | None = None  # smoothing of positions, see lcc_rl.data.smoothing
    bridge_s: LongestHole = BRIDGE_S  # longer holes divide records [s]

    def validate(self) -> None:
        self.columns = {**TABLE_COLUMNS, **self.columns}
        check_map(TABLE_FIELDS, self.columns, self.units, "data")
        keys = {key for key, name in self.columns.items() if name is not None}
        sized = "length" in keys or self.vehicle_length is not None
        if not ("leader" in keys or {"lane", "position"} <= keys):
            text = "data.columns must name leader, or lane and position"
            raise ConfigError(f"{text}, of a table with a row per vehicle and time")
        if not ("gap" in keys or ("position" in keys and sized)):
            raise ConfigError(
                "data.columns must name gap, or position and length (or set data.vehicle_length)"
            )
        if self.smoothing is not None and ("gap" in keys or "position" not in keys):
            raise ConfigError(
                "data.smoothing smooths positions: name data.columns.position, not gap"
            )

    def load(self) -> LoadedEpisodes:
        """Read, smooth if configured, and extract.

        Raises:
            DataError: naming the file, row and column, if a file is missing, damaged or not valid,
                no episode is left, or more are implausible than ``plausible`` allows.
        """
        layout = TABLE_FIELDS, self.columns, self.units
        report = ReadReport(find_files(self.path), read_as(*layout), units_of(*layout))
        rows = self._rows(report)
        names = {**self.columns}
        for key, own in (("preceding", "leader"), ("gap", "gap")):  # else known by positions
            names[key] = names.get(own) or names.get("position")
        place = partial(places, files=report.files, columns=names, vehicles=report.names)
        if self.columns.get("recording") is None:
            report.notes += cut_by_files(rows, "vehicle", report.files)
        trajectories = to_trajectories(rows, place, report, self.bridge_s)
        sound = self.columns.get("length") is None or "length" in self.units
        for name, length in median_lengths(trajectories.samples).items():
            if not (sound or CAR_LENGTH[0] <= length <= CAR_LENGTH[1]):
                raise DataError(
                    f"{report.source}: recording {name}: the median length of vehicles is "
                    f"{length:.3g} m; is it in ft or half? Set data.units.length=ft, or m if right"
                )
        if self.smoothing is not None:
            trajectories = self.smoothing(trajectories)
        remedy = f", smooth it ({SMOOTHING})" if self.columns.get("position") else ""
        return self.extracted(trajectories, remedy, place)

    def _rows(self, report: ReadReport) -> pd.DataFrame:
        """Return the rows of all files in SI."""
        blocks = []
        for number, table in enumerate(tables_of(report.files)):
            block = table.read(
                TABLE_FIELDS, self.columns, self.units, "data.columns", TABLE_MEASURED
            )
            report.rows_read += table.count
            for key in (key for key in IDENTIFYING if key in block):
                if (blank := block[key] == "").any():
                    raise table.fault(int(block["row"][np.argmax(blank)]), key, "is blank or NaN")
            unsized = "gap" not in block and self.vehicle_length is None
            if unsized and (blank := ~(block["length"] > 0)).any():
                remedy = "is blank or 0; data.vehicle_length sets such lengths [m]"
                raise table.fault(int(block["row"][np.argmax(blank)]), "length", remedy)
            _report_blank_gaps(table, block)
            own = {"recording": same_text(table.label, len(block["row"]))}
            blocks.append({**own, **block, "file": np.full(len(block["row"]), number)})
            report.notes += table.notes
        columns = joined_columns(blocks)
        count = len(columns["time"])
        report.drop("blank time, speed or position", report.rows_read - count)
        if not report.rows_read:
            raise DataError(f"{', '.join(report.files)}: has a header but no rows")
        columns |= _vehicles(columns["vehicle"], columns.get("leader"), report)
        if self.vehicle_length is not None:
            length = columns.get("length", np.zeros(count))
            columns["length"] = np.where(length > 0, length, self.vehicle_length)
        if "lane" in columns:
            columns["lane"] = columns["lane"].codes
        return pd.DataFrame({"time_s": columns.pop("time"), **columns}, copy=False)


def _report_blank_gaps(table: TableFile, read: Mapping[str, Any]) -> None:
    """Count samples that name a leader but have a blank gap, in the notes of the file."""
    if "gap" not in read or "leader" not in read:
        return
    blank = np.isnan(read["gap"]) & ~read["leader"].isin(NO_LEADER)
    if blank.any():
        first = table.fault(int(read["row"][np.argmax(blank)]), "gap", "is blank or NaN")
        table.notes.append(
            f"{int(blank.sum()):,} samples have a leader but a blank gap, the first: {first}"
        )


def _vehicles(
    vehicle: pd.Categorical, leader: pd.Categorical | None, report: ReadReport
) -> dict[str, NDArray[np.int64]]:
    """Return vehicles and leaders as positive whole numbers; 0 for no leader."""
    ahead = same_text("", len(vehicle)) if leader is None else leader
    own, fronts = (np.asarray(x.categories, dtype=object) for x in (vehicle, ahead))
    numbers, leaders = whole_numbers(own), whole_numbers(np.where(fronts == "", "0", fronts))
    if numbers is None or numbers.min() <= 0 or leaders is None:
        if numbers is not None and leaders is not None:  # columns with blanks have "0.0" for "0"
            own, fronts = numbers.astype(str), np.where(fronts == "", "", leaders.astype(str))
        names, codes = np.unique(own, return_inverse=True)
        report.names = dict(enumerate(names.tolist(), 1))
        shown = listed(names.tolist())
        report.notes.append(f"{len(names):,} vehicles are numbered from 1 by name: {shown}")
        numbers, indices = codes.astype(np.int64) + 1, pd.Index(names).get_indexer(fronts) + 1
        none = np.isin(fronts.astype(str), NO_LEADER) & (indices == 0)
        # A leader without a row gets a number that no vehicle has.
        leaders = np.where(none, 0, np.where(indices == 0, len(names) + 1, indices))
    ids = numbers[vehicle.codes]
    if leader is None:
        return {"vehicle": ids}
    front = leaders[ahead.codes].astype(np.int64)
    if count := int((front == ids).sum()):
        report.notes.append(f"{count:,} samples name the vehicle itself as its leader: no leader")
    return {"vehicle": ids, "leader": np.where((front < 0) | (front == ids), 0, front)}


def to_trajectories(
    rows: pd.DataFrame, place: Places, report: ReadReport, bridge: float
) -> Trajectories:
    """Convert rows to trajectories.

    Args:
        rows: one per vehicle and time, in any order and in SI: recording (its name), vehicle
            (positive), time_s, speed, file and row (numbers from 0) and, if known, leader (0
            for none, −1 for one that is not to be bridged), position (front bumper, along the
            road), lane (a number), gap (bumper to bumper; NaN for none), length (NaN or 0 for
            unknown).
        place: returns for a table the function that describes its rows.
        report: the report, which is completed.
        bridge: longest hole or dropout of the leader that is interpolated [s].

    Raises:
        DataError: if rows contradict each other, times are uneven, or speeds and positions do not
            agree; it names file, row and column.
    """
    rows["recording"] = pd.Categorical(rows["recording"])
    rows["episode"] = rows.groupby(["recording", "vehicle"], observed=True).ngroup()
    rows = continuous(rows, "vehicle", place, report, "data", bridge)
    if "leader" in rows:
        _bridge_dropouts(rows, bridge, report)
    _check_way(rows, place, report)
    if "position" in rows and rows["position"].abs().max() > REMOTE:
        least = float(rows["position"].min())
        rows["position"] -= least
        report.notes.append(f"positions are counted from the least, {least:,.10g} m")
    origin = rows.groupby("recording", observed=True)["time_s"].transform("min").to_numpy()
    motion = [name for name in ("speed", "position") if name in rows]
    rows, frame = on_grid(rows, origin, motion, place, report)
    return _samples(rows, frame, report)


def _bridge_dropouts(rows: pd.DataFrame, bridge: float, report: ReadReport) -> None:
    """Interpolate short dropouts of the same leader; ``rows`` of records, changed in place."""
    episode, time, leader = (rows[name].to_numpy() for name in ("episode", "time_s", "leader"))
    gap = rows["gap"].to_numpy() if "gap" in rows else np.zeros(len(rows))
    lost = (leader <= 0) | np.isnan(gap)
    starts, lengths = stretches(episode + 1j * lost)
    before, after = np.maximum(starts - 1, 0), np.minimum(starts + lengths, len(rows) - 1)
    short = ~(lost[before] | lost[after]) & (episode[before] == episode[after])
    short &= (leader[before] == leader[after]) & bridges(time[after] - time[before], bridge)
    other = (leader != 0) & (leader != np.repeat(leader[before], lengths))
    filled = lost & np.repeat(short & ~np.logical_or.reduceat(other, starts), lengths)
    if not filled.any():
        return
    first, last = np.repeat(before, lengths)[filled], np.repeat(after, lengths)[filled]
    rows.loc[filled, "leader"] = leader[first]
    if "gap" in rows:
        weight = (time[filled] - time[first]) / (time[last] - time[first])
        rows.loc[filled, "gap"] = (1 - weight) * gap[first] + weight * gap[last]
    report.notes.append(
        f"{int(filled.sum()):,} samples without a leader, within data.bridge_s={bridge:g} between "
        "two behind the same one, are interpolated"
    )


def _check_way(rows: pd.DataFrame, place: Places, report: ReadReport) -> None:
    """Check that positions and speeds agree in direction and units.

    If some vehicles agree, the worst one is named first, else the sum over all.
    """
    if "position" not in rows:
        return
    first = rows.episode.diff() != 0
    vehicle = (rows.vehicle.diff() != 0) | (rows.recording.cat.codes.diff() != 0)
    driven = (rows.speed + rows.speed.shift()) / 2 * rows.time_s.diff()
    moves = pd.DataFrame({"way": rows.position.diff(), "driven": driven}).mask(first, 0.0)
    jumps = (moves.way - moves.driven).abs() > JUMP
    totals = moves.groupby(vehicle.cumsum()).sum()
    far = totals.abs().max(axis=1) >= LEAST_WAY
    off = np.abs(np.log(totals.way.clip(1.0) / totals.driven.clip(1.0)))
    worst = int(np.argmax(np.where(far, np.where(totals.max(axis=1) < 0, np.inf, off), 0.0)))
    where = place(rows)(int(np.flatnonzero(vehicle)[worst]), "")
    cases = [
        (f"the vehicle from {where}, on drives", "its", totals.iloc[worst]),
        ("the vehicles drive", "their", totals.sum()),
    ]
    for subject, owner, (moved, driven) in (
        cases if (far & (off < np.log(AGREE[1]))).any() else cases[::-1]
    ):
        agree = AGREE[0] * driven <= moved <= AGREE[1] * driven  # false if both fall
        if not agree and max(abs(moved), abs(driven)) >= LEAST_WAY:
            hint = "check data.units and data.columns of time, speed and position"
            smooth = moves[~jumps].sum()
            low, high = (share * smooth.driven for share in AGREE)
            most = jumps.any() and smooth.driven > moves.driven.sum() / 2
            if most and low <= smooth.way <= high:
                at = place(rows)(int(np.argmax(jumps)), "")
                hint = (
                    f"positions jump {int(jumps.sum()):,} times, the first at {at}: do they begin "
                    "anew by lane or link? Give positions along the road, or leader and gap instead"
                )
            elif moved < 0:
                hint = f"positions must grow in the direction of travel; {hint}"
            raise DataError(
                f"{report.source}: by {owner} positions {subject} {moved:.4g} m, by {owner} speeds "
                f"{driven:.4g} m; {hint}"
            )


def _samples(rows: pd.DataFrame, frame: Integers, report: ReadReport) -> Trajectories:
    """Return the rows as trajectories, with leaders and headways."""
    recording = rows["recording"].cat
    rows = rows.assign(recording=recording.codes)
    columns, zero = {str(name): rows[name].to_numpy() for name in rows}, np.zeros(len(rows))
    leader = columns["leader"] if "leader" in columns else _next_ahead(rows, frame)
    gapped, gap = "gap" in columns, columns.get("gap", zero)
    if gapped:  # a vehicle without a gap follows no vehicle
        leader = np.where(np.isnan(gap), 0, leader)
    length = np.nan_to_num(columns.get("length", zero))
    headway = {}
    if gapped:
        ahead = find_leaders(columns["recording"], columns["vehicle"], frame, leader)
        headway["space_headway_m"] = np.where(ahead >= 0, gap + length[ahead], np.nan)
    speed, segment = columns["speed"], rows["episode"].to_numpy()
    last = np.append(np.diff(segment) != 0, True)
    rate = np.where(last, 0.0, np.diff(speed, append=speed[-1]) / FRAME)
    copied = ("recording", "vehicle", "time_s", "file", "row")
    return assembled(
        {
            **{name: columns[name] for name in copied},
            "frame": frame,
            "segment": segment,
            "position_m": columns.get("position", zero),
            "lane": columns.get("lane", zero),
            "length_m": length,
            "speed_mps": speed,
            "acceleration_mps2": rate,
            "preceding": leader,
            **headway,
        },
        [*recording.categories],
        report,
    )


def _next_ahead(rows: pd.DataFrame, frame: Integers) -> Integers:
    """Return the nearest vehicle ahead on the same lane in the same frame; 0 for none."""
    table = rows[["recording", "lane", "position", "vehicle"]].assign(frame=frame)
    ordered = table.sort_values(["recording", "frame", "lane", "position"], kind="stable")
    leader = ordered.groupby(["recording", "frame", "lane"]).vehicle.shift(-1, fill_value=0)
    return leader.sort_index().to_numpy()
