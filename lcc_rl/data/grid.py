"""Resampling of tables: rows by record and time, divided at holes, every 0.1 s.

A record holds the rows of a vehicle, a pair or a drive; its number is in the column ``episode``.
Rows have the number of their file (``file``) and of their row in it (``row``), from which
:func:`places` describes a sample of any table.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field

from lcc_rl.arrays import Floats, Integers, Mask
from lcc_rl.data.trajectories import FRAME, ReadReport, starts_of
from lcc_rl.errors import Concern, DataError

# Holes are steps longer than HOLE usual ones, plus SPREAD times what the longest tenth of the steps
# exceeds the usual one by: irregular sampling has few.
HOLE, SPREAD, LATE_SHARE = 1.75, 6.0, 0.1
BRIDGE_S = FRAME  # default of ``bridge_s``: such holes lie between two samples of the result
LongestHole = Annotated[float, Field(ge=0.0, le=10.0)]  # longest hole that is interpolated [s]
MANY, SHORT_HOLE = 3, 1.0  # parts of a record, and length of holes that may be interpolated [s]
UNEVEN = 0.1  # deviation from the usual step from which a step is irregular, as a share of it
REGULAR = 0.01  # tolerance of the grid as a share of 0.1 s; float32 times are off by 10 µs
SHORTEST_STEP, LONGEST_STEP = 0.002, 10.0  # steps beyond these are not in seconds [s]
MOST_TWICE = 0.1  # largest share of rows that repeat a time with other values
LAST_FRAME = 2**31 - 1  # largest number of a frame
ORIGIN = ["file", "row", "leader_row", "label"]  # columns that describe the origin of a row
Place = Callable[[int, str], str]  # returns a description of a row's sample and a column
Places = Callable[[pd.DataFrame], Place]


def places(
    table: pd.DataFrame,
    files: Sequence[str] = (),
    columns: Mapping[str, str | None] | None = None,
    vehicles: Mapping[int, str] | None = None,
) -> Place:
    """Return a function that describes a sample: file, recording, episode, row, vehicle, column.

    Unknown parts are left out. Without a row number, the time is given. A single file is left out,
    because the messages begin with it.

    Args:
        table: table of vehicles, pairs or drives.
        files: the files, indexed by the column ``file``.
        columns: the files' names of columns, by key.
        vehicles: names of numbered vehicles.

    Examples:
        >>> table = pd.DataFrame({"recording": ["i-80"], "vehicle": [7], "time_s": [0.3]})
        >>> places(table)(0, "gap_m")
        "recording i-80, vehicle 7 (follower), 0.3 s, column 'gap_m'"
    """
    named = dict(columns or {})
    if relative := named.get("relative_speed"):  # the leader's speed is the sum of two columns
        named["leader_speed"] = (
            f"{named.get('follower_speed', 'follower_speed_mps')}' + '{relative}"
        )

    def place(row: int, column: str = "") -> str:
        sample = table.iloc[row].to_dict()
        role = "leader" if column.startswith("leader") else "follower"
        at = sample.get("row" if role == "follower" else "leader_row", sample.get("row"))
        vehicle = sample.get(f"{role}_id", sample.get("vehicle"))
        key = re.sub("_(m|s|mps)$", "", column)
        header = named.get(key) or named.get(re.sub("^(leader|follower)_", "", key)) or column
        details = [f"recording {sample['recording']}" if "recording" in sample else ""]
        details.append(f"episode {sample['label']}" if sample.get("label") else "")
        details.append("" if at is None else f"data row {at + 1}")
        if vehicle is not None and "label" not in sample:
            name = (vehicles or {}).get(vehicle, vehicle)
            details.append(f"vehicle {name}" + f" ({role})" * (at is None))
        details.append(f"{sample['time_s']:g} s" if at is None else "")
        details.append(f"column '{header}'" if column else "")
        file = f"{files[sample['file']]}: " if len(files) > 1 and "file" in sample else ""
        return file + ", ".join(filter(None, details))

    return place


# -- records ---------------------------------------------------------------------------------------


def continuous(
    samples: pd.DataFrame, what: str, place: Places, report: ReadReport, node: str, bridge: float
) -> pd.DataFrame:
    """Sort records by time, keep the first row of each time, and divide records at holes.

    Args:
        samples: rows in any order: ``episode`` (number of the record, from 0), ``time_s``, ``row``
            and further columns. A record is also divided where ``turn`` changes, if it is present.
        what: key of the column that identifies records: vehicle, episode or drive.
        place: returns for a table the function that describes its rows.
        report: counts the rows left out and the holes.
        node: section of the settings that messages recommend; empty without settings.
        bridge: longest hole that does not divide a record [s].

    Returns:
        The sorted rows; the parts of a divided record have different numbers.

    Raises:
        DataError: if too many rows of one time differ, or no record has two samples.
    """
    samples = _first_of_moments(_sorted(samples, report), what, place, report)
    same = np.append(False, np.diff(samples["episode"]) == 0)
    if not same.any():
        raise DataError(f"{report.source}: no {what} has two samples: {place(samples)(0, what)}")
    usual, longest = _usual_steps(samples, same, what, report.source, node)
    steps = np.diff(samples["time_s"], prepend=0.0)
    hole = same & (steps > longest)
    bridged = hole & bridges(steps, bridge)
    hole &= ~bridged
    setting, other = f"{node}.bridge_s={bridge:g}", ""
    if "turn" in samples:
        other = " or with another target"
        turns = same & (np.diff(samples["turn"], prepend=0) != 0)
        hole, bridged = hole | turns, bridged & ~turns
    if bridged.any():
        report.notes.append(f"{int(bridged.sum()):,} holes up to {setting} are interpolated")
    connected = same & ~hole  # with the row before
    alone = ~connected & np.append(~connected[1:], True)
    if not (hole.any() or alone.any()):
        return samples
    _check_clock(samples, hole, usual, place(samples), report.source)
    count = samples["episode"].nunique()
    records = divided(samples, alone, hole, 0.0)
    report.drop("alone between holes", int(alone.sum()))
    if records.empty:
        raise DataError(f"{report.source}: no {what} has two samples in a row")
    parts, late = records["episode"].nunique(), steps[hole & (steps > longest)]
    line = f"{int(hole.sum()):,} holes longer than {setting}{other} divide {count:,} {what}s into"
    line = f"{line} {parts:,}"
    usually = float(np.quantile(late, 0.9)) if len(late) else np.inf
    if node and parts > MANY * count and usually <= SHORT_HOLE:
        enough = np.ceil(usually / FRAME - REGULAR) * FRAME
        line = Concern(f"{line}; {node}.bridge_s={enough:.1f} interpolates 90 % of them")
    report.notes += [line] * bool(hole.any())
    return records


def bridges(steps: Floats, bridge: float) -> Mask:
    """Return which holes [s] are interpolated."""
    return steps <= bridge + REGULAR * FRAME


def _sorted(samples: pd.DataFrame, report: ReadReport) -> pd.DataFrame:
    """Return the rows sorted by record and time."""
    record, later = samples["episode"].diff(), samples["time_s"].diff() >= 0
    if ((record > 0) | ((record == 0) & later)).iloc[1:].all():
        return samples
    order = np.lexsort((samples["time_s"], samples["episode"]))  # stable
    if not np.array_equal(order, np.argsort(samples["episode"], kind="stable")):
        report.notes.append("rows of a record are not in order of time: sorted")
    return samples.iloc[order].reset_index(drop=True)


def _first_of_moments(
    samples: pd.DataFrame, what: str, place: Places, report: ReadReport
) -> pd.DataFrame:
    """Return the first row of each time of sorted records."""
    again = np.append(False, np.diff(samples["time_s"]) == 0)
    again[1:] &= np.diff(samples["episode"]) == 0
    if not again.any():
        return samples
    columns = samples.columns.drop(["file", "row"], errors="ignore")
    differing = again & ~samples.duplicated(columns).to_numpy()
    rows = np.flatnonzero(differing if differing.any() else again)
    where = place(samples)(int(rows[samples["row"].to_numpy()[rows].argmin()]), "time_s")
    if differing.sum() > MOST_TWICE * len(samples):
        raise DataError(
            f"{report.source}: {where} repeats a time of its {what} with other values, as do "
            f"{100 * differing.mean():.0f} % of the rows; does a column name the {what}?"
        )
    reason = f"rows that repeat a time of their {what}, {int(differing.sum()):,} of them with"
    report.drop(f"{reason} other values, the first: {where}", int(again.sum()))
    return samples[~again].reset_index(drop=True)


def _usual_steps(
    samples: pd.DataFrame, same: Mask, what: str, source: str, node: str
) -> tuple[Floats, Floats]:
    """Return the usual step of each row's record, and the longest that is no hole [s].

    ``same``: whether the row before is of the same record; ``node``: see :func:`continuous`.
    """
    steps = samples["time_s"].diff().where(same)
    step = float(steps.median())
    if not SHORTEST_STEP <= step < LONGEST_STEP:
        unit = "ms" if step < 1e3 * LONGEST_STEP else "us" if step < 1e6 * LONGEST_STEP else "ns"
        unit = "s" if step < SHORTEST_STEP else unit
        fix = f"{node}.units.time={unit}" if node else "convert it"
        span = "from {:.15g} to {:.15g}".format(*samples["time_s"].agg(["min", "max"]))
        raise DataError(
            f"{source}: samples of each {what} are {step:g} s apart; expected {SHORTEST_STEP:g} to "
            f"{LONGEST_STEP:g} s; is the time, {span}, in {unit} ({fix})"
            f"{', or are rows missing' * (unit != 's')}?"
        )
    if not ((steps - step).abs() > UNEVEN * step).any():
        usual = np.broadcast_to(step, len(samples))
        return usual, HOLE * usual
    medians = steps.groupby(samples["episode"]).transform("median")
    many = samples.groupby("episode")["time_s"].transform("size") > round(1 / LATE_SHARE)
    usual = medians.where(many, step).to_numpy()
    late = np.quantile((steps.to_numpy() / usual)[same], 1 - LATE_SHARE)
    return usual, (HOLE + SPREAD * (late - 1)) * usual


def _check_clock(rows: pd.DataFrame, hole: Mask, usual: Floats, place: Place, source: str) -> None:
    """Check that holes are not those of times as numbers of the form hhmmss, at each minute."""
    time, near = rows["time_s"].to_numpy(np.float64), HOLE * usual
    ends = hole & (time % 100 < near) & (np.abs(np.roll(time, 1) % 100 - 60 + near / 2) <= near / 2)
    if ends.sum() > 1 and ends.sum() == hole.sum():
        row = int(np.argmax(ends))
        raise DataError(
            f"{source}: {place(row, 'time_s')}: {time[row - 1]:.15g} s, then {time[row]:.15g} s, "
            "as at each minute; is the time of the form hhmmss? Write hh:mm:ss"
        )


def divided(table: pd.DataFrame, wrong: Mask, begins: Mask, shortest: float) -> pd.DataFrame:
    """Remove rows from records and divide the records there.

    Args:
        table: consecutive rows of each record (whole numbers in the column ``episode``), sorted by
            ``time_s``.
        wrong: the rows to remove.
        begins: further rows before which a record is divided.
        shortest: shorter parts of a divided record are removed, too [s].

    Returns:
        The other rows. The first part of a record keeps its number.
    """
    episode, time = table["episode"].to_numpy(), table["time_s"].to_numpy(np.float64)
    first = np.zeros(len(table), dtype=bool)
    first[starts_of(episode)] = True
    touched = np.isin(episode, episode[wrong | (begins & ~first)])
    if not touched.any():
        return table
    rows = np.flatnonzero(~wrong)
    if not len(rows):
        return table.iloc[:0]
    starts, lengths = stretches(np.cumsum(first | begins | wrong)[rows])
    duration = time[rows[starts + lengths - 1]] - time[rows[starts]]
    keep = ~touched[rows[starts]] | (duration > shortest - 1e-6)
    numbers = episode[rows[starts]][keep].astype(np.int64)
    repeated = pd.Series(numbers).duplicated().to_numpy()
    numbers[repeated] = episode.max() + 1 + np.arange(repeated.sum())
    rest = table.iloc[rows[np.repeat(keep, lengths)]].reset_index(drop=True)
    rest["episode"] = np.repeat(numbers, lengths[keep]).astype(episode.dtype)
    return rest


def stretches(values: NDArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return first row and number of rows of each stretch of equal values."""
    starts = starts_of(values)
    return starts, np.diff(np.append(starts, len(values)))


def cut_by_files(samples: pd.DataFrame, key: str, files: Sequence[str]) -> list[Concern]:
    """Return a warning on records, named in the column ``key``, that continue in another file."""
    if len(files) < 2:
        return []
    times = (
        samples.groupby([key, "file"], observed=True)["time_s"]
        .agg(["min", "max", "size"])
        .reset_index()
    )
    times = times.sort_values([key, "min"], ignore_index=True)
    usual = (times["max"] - times["min"]) / (times["size"] - 1)
    step = (times["min"] - times["max"].shift()).where(times[key] == times[key].shift())
    rows = np.flatnonzero((step > 0) & (step < HOLE * usual))
    if not len(rows):
        return []
    before, after = (files[times["file"][row]] for row in (rows[0] - 1, rows[0]))
    text = f"{len(rows):,} records continue in another file and are read as two, the first from"
    return [Concern(f"{text} {before} in {after}; join the files")]


# -- every 0.1 s -----------------------------------------------------------------------------------


def on_grid(
    samples: pd.DataFrame, origin: Floats, smooth: Sequence[str], place: Places, report: ReadReport
) -> tuple[pd.DataFrame, Integers]:
    """Resample continuous records to samples 0.1 s apart.

    Columns of motion are those of :func:`steps_at`, a ``gap`` is interpolated linearly between two
    samples that have one; a ``leader`` must be that of both. Other columns are those of the sample
    before.

    Args:
        samples: see :func:`continuous`.
        origin: time of frame 0 for each row [s].
        smooth: the columns of motion.
        place: returns for a table the function that describes its rows.
        report: counts the rows left out.

    Returns:
        The samples, with the frames' ``time_s``, and the frame of each.

    Raises:
        DataError: if a record is implausibly long.
    """
    at = ((samples["time_s"] - origin) / FRAME).to_numpy()
    if at.max() > LAST_FRAME:
        row = int(np.argmax(at > LAST_FRAME))
        raise DataError(
            f"{report.source}: {place(samples)(row, '')} is {FRAME * at[row]:g} s after the first; "
            "is the time in another unit?"
        )
    frame = np.rint(at).astype(np.int32)
    skipped = np.abs(at - frame).max() > REGULAR
    del at  # a table may hold millions of rows
    skipped |= (np.diff(frame)[np.diff(samples["episode"]) == 0] > 1).any()
    line = interpolated(samples, FRAME, skipped)
    samples = samples.assign(origin=origin)
    if line:
        report.notes += line
        samples, frame = _interpolated(samples, [*smooth], report)
    samples["time_s"] = samples.pop("origin") + frame / round(1 / FRAME)
    return samples, frame


def interpolated(samples: pd.DataFrame, step: float, skipped: bool = False) -> list[str]:
    """Return a line on samples that are not ``step`` seconds apart, or with ``skipped`` frames."""
    steps = steps_of(samples)
    usual = float(np.median(steps, overwrite_input=True))
    steps -= usual
    odd = int((np.abs(steps, out=steps) > UNEVEN * usual).sum())
    irregular = f", {odd:,} of them irregular," * bool(odd)
    how = "averaged over" if is_dense(usual, step, FRAME) else "interpolated to"
    line = f"samples {usual:g} s apart{irregular} were {how} {step:g} s"
    return [line] * bool(skipped or odd or abs(usual - step) > UNEVEN * step)


def is_dense(usual: Any, step: float, frame: float) -> Any:
    """Whether samples are closer than a step and 0.1 s (``frame``), so that they are averaged."""
    return usual < (1 - UNEVEN) * min(step, frame)


def steps_at(at: Floats, step: float, time: Floats, values: Floats, frame: float = FRAME) -> Floats:
    """Return values at the times ``at``, ``step`` apart: of a monotone interpolant (PCHIP).

    It does not overshoot the samples. Where samples are dense (:func:`is_dense`), the values
    are means over a step, at the ends of the record over the shorter part with the same centre.

    Args:
        at, step: new times and their distance, in the unit of ``time``.
        time: increasing times of the samples.
        values: samples, ``[samples, …]``.
        frame: 0.1 s in the unit of ``time``.
    """
    from scipy.interpolate import PchipInterpolator  # here: it loads for a second

    curve, at = PchipInterpolator(time, values), at.clip(time[0], time[-1])
    found = curve(at)
    if not is_dense(np.median(np.diff(time)), step, frame):
        return found
    half = np.minimum(step / 2, np.minimum(at - time[0], time[-1] - at))
    inner = half > UNEVEN * step
    begin, end, area = (at - half)[inner], (at + half)[inner], curve.antiderivative()
    found[inner] = ((area(end) - area(begin)).T / (end - begin)).T
    return found


def steps_of(samples: pd.DataFrame) -> Floats:
    """Return the times between consecutive samples of a record [s]."""
    return np.diff(samples["time_s"])[np.diff(samples["episode"]) == 0]


def _interpolated(
    samples: pd.DataFrame, smooth: list[str], report: ReadReport
) -> tuple[pd.DataFrame, NDArray]:
    """Return samples at the whole frames of each record."""
    at = ((samples["time_s"] - samples["origin"]) / FRAME).to_numpy()
    table, episode = samples[smooth].to_numpy(np.float64), samples["episode"].to_numpy()
    frames, before, values = [], [], []
    for start, length in zip(*stretches(episode), strict=True):
        sampled = at[start : start + length]
        grid = np.arange(np.ceil(sampled[0] - 1e-6), np.floor(sampled[-1] + 1e-6) + 1)
        if len(grid) < 2:
            report.drop("stretch without two samples on the time grid", int(length))
            continue
        values.append(steps_at(grid, 1.0, sampled, table[start : start + length], 1.0))
        before.append(start + np.searchsorted(sampled, grid + 1e-6, side="right") - 1)
        frames.append(grid.astype(np.int32))
    if not frames:
        raise DataError(
            f"{report.source}: no record lasts {FRAME:g} s; is the time in another unit?"
        )
    frame, first = np.concatenate(frames), np.maximum(np.concatenate(before), 0)
    after = np.minimum(first + 1, len(samples) - 1)
    inside = (episode[after] == episode[first]) & (after > first)
    span = np.where(inside, at[after] - at[first], 1.0)
    weight = np.where(inside, ((frame - at[first]) / span).clip(0.0, 1.0), 0.0)
    weight[weight < 1e-5] = 0.0
    found, following = (samples.iloc[index].reset_index(drop=True) for index in (first, after))
    found[smooth] = np.concatenate(values)
    if "leader" in samples:
        found["leader"] = found.leader.where((weight == 0) | (following.leader == found.leader), 0)
    if "gap" in samples:
        mixed = (1 - weight) * found.gap + weight * following.gap
        found["gap"] = found.gap.where(weight == 0, mixed)
    return found, frame
