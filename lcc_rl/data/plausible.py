"""Plausibility of recorded motion: one check, by the same thresholds, for every reader."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from math import log
from typing import Annotated

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field

from lcc_rl.data.tables import SI, SPEEDS, UNITS, TableFile
from lcc_rl.data.trajectories import divided, starts_of
from lcc_rl.errors import LARGEST, Concern, DataError
from lcc_rl.settings import NonNegative, Number, Positive, Settings

SMOOTHING = "'data.smoothing={_target_:lcc_rl.data.smoothing.SavitzkyGolay,window_s:1.5}'"
SHORTEST = 10.0  # parts of a record that was cut are at least so long [s]
WINDOW = 5.0  # over which changes are compared: noise of single samples averages out [s]
HARD, LEAST_SAMPLES = 4.0, 300  # change of speed in a second [m/s]; fewer samples say nothing
# Fewer windows, of all records or of one, or smaller changes [m], say nothing.
LEAST_WINDOWS, LEAST_OF_ONE, LEAST_CHANGE = 20, 10, 0.5
NEAR = 1.15  # factor by which gap_rate may be off 1 in the right units: noise of speeds lowers it
STANDING = 0.5  # both cars stand below it [m/s]
LEAST_WAY = 50.0  # a shorter way says nothing of the unit of a speed [m]
ROLES = ("follower", "leader")
OF_PAIRS = {"episode", "time_s", "gap_m", "follower_speed_mps", "leader_speed_mps"}
Mask = NDArray[np.bool_]
Place = Callable[[int, str], str]  # describes the sample of a row, and a column, to the user
# Column, words with a place for the number found, these numbers, the threshold's name and which
# samples are outside of it; both are ``[rows]``.
Fault = tuple[str, str, NDArray[np.float64], str, Mask]


class Plausible(Settings):
    """Thresholds of recorded motion; records are cut where a sample is outside of one.

    The data are refused where more than ``max_share`` of the samples would be left out, where gaps
    change by a factor of more than ``max_mismatch``, either way, of what the speeds say
    (:func:`gap_rate`), or where a car drives by that factor farther than its leader.
    """

    max_speed: Positive = 70.0  # beyond it, a column is rather in km/h or ft/s [m/s]
    # Slower ones are left out; between this and 0 a speed counts as 0 [m/s].
    min_speed: Annotated[float, Field(le=0.0)] = -0.5
    max_acceleration: Positive = 10.0  # change of speed between samples, either sign [m/s²]
    min_length: NonNegative = 2.0  # length of a vehicle [m]; 0 counts as not given
    max_length: Positive = 30.0
    min_gap: Number = 0.0  # between bumpers [m]
    max_gap: Positive = 500.0
    max_step: Positive = 10.0  # time between consecutive samples [s]
    max_share: Annotated[float, Field(ge=0.0, le=1.0)] = 0.1  # of the samples
    max_mismatch: Annotated[float, Field(ge=1.0, le=LARGEST)] = 1.5
    # Share of the time with a change of speed above 4 m/s in a second; of recorded traffic it is
    # 0.0001 or less, of the same speeds in km/h about 0.06.
    max_hard: Annotated[float, Field(ge=0.0, le=1.0)] = 0.005
    # Median gap of a follower that stands behind a leader that stands [m]; of recorded traffic it
    # is 3 to 8, of the same in feet without data.units 10 to 26.
    max_standing_gap: Positive = 15.0

    def select(
        self,
        table: pd.DataFrame,
        source: str,
        place: Place,
        setting: str = "data.plausible",
        remedy: str = "",
        units: Mapping[str, str] | None = None,
    ) -> tuple[pd.DataFrame, list[str]]:
        """Cut records where a sample is implausible; parts of less than 10 s go as well.

        Args:
            table: rows of a record (column ``episode``) lie together, in order of time: time_s
                and, where present, gap_m and columns that end in ``speed_mps`` and ``length_m``.
            source: the file or files, for messages.
            place: describes a row to the user, by its number and the column at fault.
            setting: where the configuration has these thresholds.
            remedy: what else a user may do about accelerations.
            units: see :func:`fitting`.

        Returns:
            What is left, numbered by :func:`lcc_rl.data.trajectories.divided`, its speeds at least
            0, and a line for each kind of fault.

        Raises:
            DataError: if more than ``max_share`` of the samples, or all, would be left out, or
                gaps and speeds contradict each other.
        """
        starts = starts_of(table["episode"].to_numpy())
        wrong, lines, advice = self._outside(table, starts, place, setting, remedy)
        numbered = table.assign(row=np.arange(len(table)))  # for messages, by the place of a row
        kept = divided(numbered, wrong, np.zeros_like(wrong), SHORTEST)
        lost = 1 - len(kept) / len(table)
        if lost > self.max_share or kept.empty:
            raise DataError(
                f"{source}: {100 * lost:.3g} % of the samples are implausible or lie within less "
                f"than {SHORTEST:g} s between such (at most {setting}.max_share="
                f"{self.max_share:g} of them may), the first: {advice}"
            )
        if lines:
            records = int(np.logical_or.reduceat(wrong, starts).sum())
            count = len(table) - len(kept)
            line = (
                f"{records:,} of {len(starts):,} records were cut there: {count:,} samples, "
                f"{count * usual_step(table):,.0f} s, are left out, with parts shorter than "
                f"{SHORTEST:g} s"
            )
            lines.append(Concern(line))
        kept, more_lines = _not_negative(kept)

        def first_of(episode: int, column: str) -> str:
            return place(int(kept["row"][kept["episode"] == episode].iloc[0]), column)

        self._check_each(kept, source, first_of, setting, units or {})
        more_lines += self._check_units(kept, source, setting, units or {})
        return kept.drop(columns="row"), [*lines, *more_lines]

    def _outside(
        self,
        table: pd.DataFrame,
        starts: NDArray[np.intp],
        place: Place,
        setting: str,
        remedy: str,
    ) -> tuple[Mask, list[str], str]:
        """Samples outside of a threshold, a line for each kind, and what to do about the first."""
        first = np.isin(np.arange(len(table)), starts)
        wrong, lines, advice = np.zeros(len(table), dtype=bool), [], ""
        for column, words, values, name, found in self._faults(table, first):
            new = found & ~wrong
            if name == "max_acceleration":  # not of the change from a sample that is left out
                new[1:] &= ~wrong[:-1]
            if not new.any():
                continue
            row = int(np.argmax(new))
            limit = f"{setting}.{name}={getattr(self, name):g}"
            said = f"{place(row, column)} {words.format(values[row])}, {limit}"
            more = remedy if name == "max_acceleration" else ""
            line = f"left out {int(new.sum()):,} implausible sample(s), the first: {said}"
            lines.append(f"{line}{more and '; to keep it'}{more}")
            advice = advice or f"{said}; mend the file or its units{more}, or raise that threshold"
            wrong |= new
        return wrong, lines, advice

    def _check_each(
        self,
        kept: pd.DataFrame,
        source: str,
        place: Place,
        setting: str,
        units: Mapping[str, str],
    ) -> None:
        """Check that no car is in other units than the others: it hides in means over all.

        ``place`` describes the first sample of an episode, by the episode's number.
        """
        if not set(kept.columns) >= OF_PAIRS:
            return
        limit = f"{setting}.max_mismatch={self.max_mismatch:g}"
        declared = next((units[key] for key in units if key.endswith("speed")), SI["speed"])
        ways = farther(kept)
        if (ways["factor"] > self.max_mismatch).any():
            worst = int(np.argmax(ways["factor"]))
            own, ahead, factor = ways.iloc[worst]
            follower, leader = (place(ways.index[worst], f"{role}_speed_mps") for role in ROLES)
            raise DataError(
                f"{source}: {follower}: by its speed, this vehicle drives {own:.4g} m, its leader "
                f"({leader}) {ahead:.4g} m, {limit}; is one of these speeds in "
                f"{_nearest(factor, declared)}?"
            )
        rates = gap_rates(kept)
        off = (rates > self.max_mismatch) | (rates < 1 / self.max_mismatch)
        gap = {key: unit for key, unit in units.items() if key == "gap"}
        for number, rate in zip(rates.index[off], rates[off], strict=True):
            # Gaps of a faulty sensor fit no unit; where all are off, the check of all says so.
            if (advice := fitting(rate, gap)) and not off.all():
                raise DataError(
                    f"{source}: {place(number, 'gap_m')} changes by {rate:.2f} m where the speeds "
                    f"of leader and follower say 1 m, {limit}; for this vehicle alone, {advice}"
                )

    def _check_units(
        self, kept: pd.DataFrame, source: str, setting: str, units: Mapping[str, str]
    ) -> list[str]:
        hard = hard_share(kept)
        if hard is not None and hard > self.max_hard:
            raise DataError(
                f"{source}: speeds change by more than {HARD:g} m/s within a second for "
                f"{100 * hard:.2g} % of the time, {setting}.max_hard={self.max_hard:g}; are they "
                "in km/h, mph or ft/s, or do they need smoothing?"
            )
        rate = gap_rate(kept)
        if rate is not None and not 1 / self.max_mismatch <= rate <= self.max_mismatch:
            advice = fitting(rate, units) or (
                "are speeds in km/h, mph or ft/s, gaps in feet, times not in s, or leader and "
                "follower exchanged?"
            )
            raise DataError(
                f"{source}: gaps change by {rate:.2f} m where the speeds of leader and follower "
                f"say 1 m, {setting}.max_mismatch={self.max_mismatch:g}; {advice}"
            )
        stand = standing_gap(kept)
        if stand is not None and stand > self.max_standing_gap:
            raise DataError(
                f"{source}: cars stand {stand:.3g} m behind a car that stands (median), "
                f"{setting}.max_standing_gap={self.max_standing_gap:g}; are gaps, and speeds, in "
                "feet (data.units)?"
            )
        few = f"too few samples to tell whether speeds are in m/s: fewer than {LEAST_SAMPLES}"
        return [f"{few} a second apart"] if hard is None else []

    def _faults(self, table: pd.DataFrame, first: Mask) -> Iterator[Fault]:
        """What may be outside of a threshold; ``first`` marks the first row of each record."""
        time = table["time_s"].to_numpy(np.float64)
        step = np.diff(time, prepend=time[0])
        step[first] = 0.0
        late = step > self.max_step
        yield "time_s", "is {:g} s after the sample before it", step, "max_step", late
        for name in map(str, table.columns):
            if not name.endswith(("speed_mps", "length_m", "gap_m")):
                continue
            values = table[name].to_numpy(np.float64)
            if name.endswith("speed_mps"):
                words = "holds {:g} m/s (is it km/h or ft/s?)"
                yield name, words, values, "max_speed", values > self.max_speed
                yield name, "holds {:g} m/s", values, "min_speed", values < self.min_speed
                rate = np.diff(values, prepend=values[0]) / np.where(step > 0, step, np.inf)
                rough = np.abs(rate) > self.max_acceleration
                yield name, "changes by {:g} m/s²", rate, "max_acceleration", rough
            elif name == "gap_m":
                yield name, "holds {:g} m", values, "max_gap", values > self.max_gap
                yield name, "holds {:g} m", values, "min_gap", values < self.min_gap
            else:
                short = (values != 0) & (values < self.min_length)
                yield name, "holds {:g} m", values, "min_length", short
                yield name, "holds {:g} m", values, "max_length", values > self.max_length


def without_blank(
    file: TableFile, read: dict[str, NDArray], keys: Iterable[str]
) -> tuple[dict[str, NDArray], NDArray[np.int64]]:
    """Leave rows out in which one of some columns is blank; the notes of the file count them.

    Args:
        file: the table.
        read: its columns.
        keys: those in which a blank cell costs the row.

    Returns:
        The columns without these rows, and the numbers of the rows that are left.

    Raises:
        DataError: if every row has a blank cell.
    """
    blank = {key: np.isnan(read[key]) for key in keys if key in read}
    wrong = np.logical_or.reduce([*blank.values()])
    if not wrong.any():
        return read, np.arange(len(wrong))
    row = int(np.argmax(wrong))
    first = file.fault(row, next(key for key in blank if blank[key][row]), "is blank")
    if wrong.all():
        raise first
    file.notes.append(f"left out {int(wrong.sum()):,} rows with a blank cell, the first: {first}")
    return {key: values[~wrong] for key, values in read.items()}, np.flatnonzero(~wrong)


def hard_share(table: pd.DataFrame) -> float | None:
    """Return the largest share of samples whose speed changes by more than 4 m/s in a second.

    Args:
        table: see :meth:`Plausible.select`; of the columns that end in ``speed_mps`` the worst
            counts.

    Returns:
        The share; None where there are too few samples to tell.
    """
    step = usual_step(table)
    reach = max(1, round(1 / step)) if step > 0 else 1
    same = table["episode"].diff(reach) == 0
    if same.sum() < LEAST_SAMPLES:
        return None
    names = [str(name) for name in table.columns if str(name).endswith("speed_mps")]
    time = table["time_s"].diff(reach)[same]
    shares = [(table[x].diff(reach)[same].abs() > HARD * time).mean() for x in names]
    return float(max(shares, default=0.0))


def standing_gap(table: pd.DataFrame) -> float | None:
    """Return the median gap while leader and follower stand [m]; None with too few samples."""
    if not set(table.columns) >= OF_PAIRS:
        return None
    stand = table[["follower_speed_mps", "leader_speed_mps"]].max(axis=1) < STANDING
    return float(table["gap_m"][stand].median()) if stand.sum() >= LEAST_SAMPLES else None


def usual_step(table: pd.DataFrame) -> float:
    """Return the median time between samples of a record [s]; 0 if none has two."""
    step = table["time_s"].diff()[table["episode"].diff() == 0].median()
    return float(step) if step == step else 0.0


def _not_negative(table: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """Speeds a little below 0, which are noise, as 0; and a line if there are any."""
    names = [str(name) for name in table.columns if str(name).endswith("speed_mps")]
    below = {name: table[name] < 0.0 for name in names}
    count = sum(int(mask.sum()) for mask in below.values())
    if not count:
        return table, []
    least = min(float(table[name].min()) for name in names)
    table = table.assign(**{name: table[name].clip(lower=0.0) for name in names})
    return table, [f"{count:,} speeds below 0, the least {least:.3g} m/s, count as 0"]


def pair_place(episodes: pd.DataFrame) -> Place:
    """Return what describes a sample of an episode table: recording, vehicle, time and column."""

    def place(row: int, column: str) -> str:
        entry = episodes.iloc[row]
        role = "leader" if column.startswith("leader") else "follower"
        where = f"recording {entry['recording']}, vehicle {entry[f'{role}_id']} ({role})"
        return f"{where}, {entry['time_s']:g} s, column {column!r}"

    return place


def gap_rate(episodes: pd.DataFrame) -> float | None:
    """Return by how much gaps change where the speeds say 1.

    The slope of a least-squares fit of changes of the gap over windows of 5 s on the integral of
    the relative speed, both without their mean over the episode, which a calibration error of
    speedometers may be.

    Args:
        episodes: rows of an episode lie together, in order of time: episode, time_s, gap_m,
            follower_speed_mps, leader_speed_mps.

    Returns:
        The slope, 1 for consistent data; None where a column is missing or too little changes.
    """
    if not set(episodes.columns) >= OF_PAIRS or episodes.empty:
        return None
    slope = _slopes(_changes(episodes).assign(episode=0), LEAST_WINDOWS)
    return None if slope.empty else float(slope.iloc[0])


def gap_rates(episodes: pd.DataFrame) -> pd.Series:
    """Return :func:`gap_rate` of each episode in which enough changes, by its number."""
    return _slopes(_changes(episodes), LEAST_OF_ONE)


def _slopes(changes: pd.DataFrame, least: int) -> pd.Series:
    products = changes.assign(both=changes["said"] * changes["seen"], said=changes["said"] ** 2)
    sums = products.groupby("episode")[["both", "said"]].sum()
    count = products.groupby("episode").size()
    enough = (count >= least) & (sums["said"] >= count * LEAST_CHANGE**2)
    return (sums["both"] / sums["said"])[enough]


def _changes(episodes: pd.DataFrame) -> pd.DataFrame:
    """Change of the gap in windows of 5 s as seen, and as the speeds say; see :func:`gap_rate`."""
    episode = episodes["episode"].to_numpy()
    first = np.append(True, episode[1:] != episode[:-1])
    time, gap = (episodes[name].to_numpy(np.float64) for name in ("time_s", "gap_m"))
    way = np.cumsum(_steps(episodes, "leader") - _steps(episodes, "follower"))
    number = np.cumsum(first) - 1
    window = np.floor((time - time[first][number]) / WINDOW)
    marks = np.flatnonzero(first | (np.diff(window, prepend=0.0) != 0))
    same = np.diff(number[marks]) == 0
    found = {"said": np.diff(way[marks])[same], "seen": np.diff(gap[marks])[same]}
    changes = pd.DataFrame(found).assign(episode=episode[marks][1:][same])
    return changes - changes.groupby("episode").transform("mean").assign(episode=0)


def _steps(episodes: pd.DataFrame, role: str) -> NDArray[np.float64]:
    """Way from the sample before, by the speed of leader or follower; 0 as an episode begins."""
    speed = episodes[f"{role}_speed_mps"].astype(np.float64)
    way = (speed + speed.shift()) / 2 * episodes["time_s"].diff()
    return way.where(episodes["episode"].diff() == 0, 0.0).to_numpy()


def farther(episodes: pd.DataFrame) -> pd.DataFrame:
    """Return how much farther one car of a pair drives than the other, by their speeds.

    The way of the leader may be less by what the gap grows. Whichever is nearer to the follower's
    counts, since a gap may jump to another car.

    Args:
        episodes: see :func:`gap_rate`.

    Returns:
        By episodes of at least 50 m: the ways of follower and leader, own and ahead [m], and the
        factor, at least 1.
    """
    own, ahead = (_steps(episodes, role) for role in ROLES)
    ways = pd.DataFrame({"own": own, "ahead": ahead}).groupby(episodes["episode"].to_numpy()).sum()
    gap = episodes.groupby("episode")["gap_m"]
    others = ways["ahead"], ways["ahead"] - (gap.last() - gap.first())
    factors = [np.exp(np.abs(np.log(ways["own"].clip(1.0) / way.clip(1.0)))) for way in others]
    ways["factor"] = np.minimum(*factors)
    return ways[ways[["own", "ahead"]].max(axis=1) >= LEAST_WAY]


def _nearest(factor: float, declared: str) -> str:
    """Return the unit of speeds that is larger or smaller than another by a factor, if one is."""
    sizes = {**SPEEDS, declared: UNITS["speed"][declared]}
    off = {unit: abs(log(size / sizes[declared])) for unit, size in sizes.items()}
    near = min(off, key=lambda unit: abs(off[unit] - log(factor)))
    return near if abs(off[near] - log(factor)) < log(NEAR) else f"another unit than {declared}"


def fitting(rate: float, units: Mapping[str, str]) -> str:
    """Return in words which other units bring :func:`gap_rate` near 1; empty where none does.

    A unit that the user declared is doubted before SI, the default; then the nearest comes first.

    Args:
        rate: as measured.
        units: units that the gap and the speeds were read in, by their keys in ``data.units``.
    """
    found = []
    for quantity, end, sense in (("length", "gap", 1), ("speed", "speed", -1)):
        keys = [key for key in units if key.endswith(end)]
        if len({units[key] for key in keys}) != 1:
            continue
        declared = units[keys[0]]
        for size, unit in {size: unit for unit, size in reversed(UNITS[quantity].items())}.items():
            there = rate * (size / UNITS[quantity][declared]) ** sense
            if 1 / NEAR < there < NEAR:
                option = " ".join(f"data.units.{key}={unit}" for key in keys)
                words = f"with {option} it would be {there:.2f} m"
                found.append((declared == SI[quantity], abs(log(there)), words))
    return ", ".join(words for *_, words in sorted(found))
