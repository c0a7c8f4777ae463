"""Plausibility of recorded motion: the same thresholds for all readers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field

from lcc_rl.arrays import Floats, Mask
from lcc_rl.data.agreement import OF_PAIRS, STANDING, check_pairs, numbers_of_pairs
from lcc_rl.data.columns import Units
from lcc_rl.data.grid import ORIGIN, Place, Places, divided, steps_of, stretches
from lcc_rl.data.trajectories import BATCH, FRAME, starts_of
from lcc_rl.errors import LARGEST, Concern, DataError
from lcc_rl.settings import NonNegative, Number, Positive, Settings

SMOOTHING = "'data.smoothing={_target_:lcc_rl.data.smoothing.SavitzkyGolay,window_s:1.5}'"
SHORTEST_PART = 10.0  # least length of parts of a cut record [s]
HARD, LEAST_SAMPLES = 4.0, 300  # change of speed in a second [m/s]; least samples of a share
JUMP_S, HELD_S = 0.5, 1.0  # time in which a gap jumps; longest time without a measurement [s]
NOISE = 12.0  # least jump, as a multiple of the median change of a gap beyond that by the speeds
# Step of speeds per sample [m/s²] from which they are coarse; least changes, and share in steps.
COARSE, LEAST_CHANGES, STEPPED = 0.5, 100, 0.8
# Top speed that may be in mph [m/s]; range of speeds [m/s] and rate [m/s²] of too slow a clock.
FASTEST, STOPS, SLOW_RATE = 50.0, 8.0, 0.4
MOST_JUMPS = 0.5  # largest share of samples that jumps of gaps may cost
WORDS = {
    "max_speed": "holds {:g} m/s (is it in km/h or ft/s, or a value for no target?)",
    "min_speed": "holds {:g} m/s (is it relative to another car, or against an axis?)",
    "max_gap": "holds {:g} m (is it in cm, data.units.gap=cm, or a value for no target?)",
}
# Column, words with a place for a number, the numbers ``[rows]``, name of the threshold, and the
# samples outside of it ``[rows]``.
Finding = tuple[str, str, NDArray[np.float64], str, Mask]


class Plausible(Settings):
    """Thresholds of recorded motion; records are cut where a sample is outside of one.

    The data are refused if more than ``max_share`` of the samples would be left out, or if gap and
    speeds of a pair contradict each other (:func:`lcc_rl.data.agreement.check_pairs`).
    """

    max_speed: Positive = 70.0  # larger speeds are probably in km/h or ft/s [m/s]
    # Smaller speeds are left out; those between this and 0 count as 0 [m/s].
    min_speed: Annotated[float, Field(le=0.0)] = -0.5
    max_acceleration: Positive = 10.0  # absolute change of speed between samples [m/s²]
    min_length: NonNegative = 2.0  # length of a vehicle [m]; 0 counts as not given
    max_length: Positive = 30.0
    min_gap: Number = 0.0  # between bumpers [m]
    max_gap: Positive = 500.0
    max_jump: Positive = 4.0  # change of a gap in 0.5 s beyond that by both speeds [m]
    max_step: Positive = 10.0  # time between consecutive samples [s]
    max_share: Annotated[float, Field(ge=0.0, le=1.0)] = 0.1  # largest share of implausible samples
    # Largest factor between the change of a gap and that by the speeds.
    max_mismatch: Annotated[float, Field(ge=1.0, le=LARGEST)] = 1.5
    max_lag: NonNegative = 1.0  # of a gap or a speed behind the others [s]
    # Largest share of the time with a change of speed above 4 m/s in a second. It is at most
    # 0.0001 in recorded traffic, and about 0.06 for the same speeds in km/h.
    max_hard: Annotated[float, Field(ge=0.0, le=1.0)] = 0.005

    def select(
        self,
        table: pd.DataFrame,
        source: str,
        place: Places,
        setting: str = "data.plausible",
        remedy: str = "",
        units: Units | None = None,
    ) -> tuple[pd.DataFrame, list[str]]:
        """Cut records where a sample is implausible; parts shorter than 10 s are left out, too.

        Args:
            table: consecutive rows of each record (column ``episode``), sorted by time: time_s
                and, if present, gap_m and columns that end in ``speed_mps`` and ``length_m``.
            source: the file or files, for messages.
            place: see :func:`lcc_rl.data.grid.places`.
            setting: place of these thresholds in the configuration.
            remedy: further remedy for accelerations.
            units: see :func:`lcc_rl.data.agreement.mistakes`.

        Returns:
            The other rows, numbered by :func:`lcc_rl.data.grid.divided`, with speeds of at least 0,
            and a line for each kind of fault.

        Raises:
            DataError: if more than ``max_share`` of the samples, or all, would be left out, or
                gaps and speeds contradict each other.
        """
        node, known = setting.split(".")[0], units or {}
        unit = ", ".join(f"{node}.units.{x}={known[x]}" for x in known if "speed" in x) or "units"
        wrong, lines, advice = self._outside(table, place(table), setting, remedy, unit)
        rest = divided(table, wrong, np.zeros_like(wrong), SHORTEST_PART)
        lost = 1 - len(rest) / len(table)
        if lost > self.max_share or rest.empty:
            raise DataError(
                f"{source}: {100 * lost:.3g} % of the samples are implausible or lie within less "
                f"than {SHORTEST_PART:g} s between such (at most {setting}.max_share="
                f"{self.max_share:g} of them may), the first: {advice}"
            )
        lines += cut_line(table, rest, wrong) if lines else []
        rest, more_lines = _not_negative(rest)
        agree, last = False, list[str]()
        if set(rest.columns) >= OF_PAIRS:
            rest, jumps = self._without_jumps(rest, source, place, setting)
            more_lines += jumps
            limits = {"max_mismatch": self.max_mismatch, "max_lag": self.max_lag}
            try:
                last, agree = check_pairs(rest, place(rest), units or {}, **limits)
            except DataError as error:
                shown = ", ".join(f"{setting}.{name}={limits[name]:g}" for name in limits)
                raise DataError(f"{source}: {error} ({shown})") from error
        hint = f"are they in km/h, mph or ft/s ({unit}), or do they need smoothing?"
        if agree:
            hint = "gaps agree: are both in another unit, or are such changes real?"
        more_lines += self._check_hard(rest, source, setting, hint)
        return rest.drop(columns=ORIGIN, errors="ignore"), [*lines, *more_lines, *last]

    def _outside(
        self, table: pd.DataFrame, place: Place, setting: str, remedy: str, unit: str
    ) -> tuple[Mask, list[str], str]:
        """Return samples outside of a threshold, a line for each kind, and advice on the first."""
        wrong, lines, advice = np.zeros(len(table), dtype=bool), [], ""
        for column, form, values, name, beyond in self._faults(table):
            new = beyond & ~wrong
            if name == "max_acceleration":  # not the change from a sample that is left out
                new[1:] &= ~wrong[:-1]
            if not new.any():
                continue
            row = int(np.argmax(new))
            limit = f"{setting}.{name}={getattr(self, name):g}"
            example = f"{place(row, column)} {form.format(values[row])}, {limit}"
            hint = remedy if name == "max_acceleration" else ""
            line = f"left out {int(new.sum()):,} implausible sample(s), the first: {example}"
            lines.append(f"{line}{hint and '; to keep it'}{hint}")
            fix = unit if column.endswith("speed_mps") else "units"
            advice = advice or f"{example}; correct the file or {fix}{hint}, or raise the threshold"
            wrong |= new
        return wrong, lines, advice

    def _without_jumps(
        self, table: pd.DataFrame, source: str, place: Places, setting: str
    ) -> tuple[pd.DataFrame, list[str]]:
        """Cut records of pairs where their gap jumps, and report it."""
        off, wrong = gap_jumps(table, self.max_jump)
        if not wrong.any():
            return table, []
        first, rest = int(np.argmax(wrong)), divided(table, wrong, wrong, SHORTEST_PART)
        near = table.iloc[first : first + round(JUMP_S / FRAME)]  # a change is over several samples
        gap = near.loc[near["episode"] == near["episode"].iloc[0], "gap_m"].to_numpy()
        row = first + int(np.argmax(np.abs(np.diff(gap, prepend=gap[0]))))
        change = off[first : first + len(gap)]
        fault = (
            f"{int(wrong.sum()):,} sample(s) where the gap jumps or is held, the first: "
            f"{place(table)(row, 'gap_m')} changes by {change[np.abs(change).argmax()]:.3g} m more "
            f"than the speeds give, {setting}.max_jump={self.max_jump:g}"
        )
        if len(rest) < (1 - MOST_JUMPS) * len(table):
            raise DataError(f"{source}: has {fault}; expected the gap to one leader")
        lines = [f"left out {fault}", *cut_line(table, rest, wrong)]
        return rest, [*lines, "parts behind another car are records, too: leave out such rows"]

    def _check_hard(self, table: pd.DataFrame, source: str, setting: str, hint: str) -> list[str]:
        """Check that speeds change as those of cars; ``hint``: a probable reason."""
        hard = hard_share(table)
        if hard is not None and hard > self.max_hard:
            raise DataError(
                f"{source}: speeds change by more than {HARD:g} m/s within a second for "
                f"{100 * hard:.2g} % of the time, {setting}.max_hard={self.max_hard:g}; {hint}"
            )
        few = f"unit of speeds not checked: fewer than {LEAST_SAMPLES} samples"
        return [f"{few} a second apart"] if hard is None else []

    def _faults(self, table: pd.DataFrame) -> Iterator[Finding]:
        """Yield the checks of all thresholds."""
        time = table["time_s"].to_numpy(np.float64)
        step = np.diff(time, prepend=time[0])
        step[starts_of(table["episode"].to_numpy())] = 0.0
        words = "is {:g} s after the sample before it"
        yield "time_s", words, step, "max_step", step > self.max_step
        step[step <= 0] = np.inf
        for name in map(str, table.columns):
            if not name.endswith(("speed_mps", "length_m", "gap_m")):
                continue
            values, kind = table[name].to_numpy(np.float64), name.split("_")[-2]
            for limit, beyond in ((f"max_{kind}", np.greater), (f"min_{kind}", np.less)):
                outside = beyond(values, getattr(self, limit))
                outside &= (kind != "length") | (values != 0)  # a length of 0 is not given
                yield name, WORDS.get(limit, "holds {:g} m"), values, limit, outside
            if kind == "speed":
                rate = np.diff(values, prepend=values[0])
                rate /= step
                rough = (rate > self.max_acceleration) | (rate < -self.max_acceleration)
                yield name, "changes by {:g} m/s²", rate, "max_acceleration", rough


def gap_jumps(table: pd.DataFrame, limit: float) -> tuple[Floats, Mask]:
    """Return where the gap of a pair jumps: to another car, or to a value for none.

    Args:
        table: see :meth:`Plausible.select`.
        limit: least jump [m]; that of a noisy record is 12 times its median change.

    Returns:
        The change of each gap in 0.5 s, or a longer step, beyond that by both speeds ``[rows]``
        [m]; and the rows at which it exceeds the limit, or a gap beside them is held for 1 s.
    """
    _, held = stretches(table["row"].to_numpy()) if "row" in table else ([], np.ones(1, int))
    reach = max(round(JUMP_S / FRAME), int(held.max()))  # or the longest step of the recording
    ends = np.flatnonzero(np.diff(numbers_of_pairs(table), append=-1)) + 1  # of pairs
    ends = ends[np.diff(ends // BATCH, append=-1) != 0]
    parts = [
        _jumps(table.iloc[start:end], limit, reach)
        for start, end in zip([0, *ends[:-1]], ends, strict=True)
    ]
    return np.concatenate([off for off, _ in parts]), np.concatenate([x for _, x in parts])


def _jumps(table: pd.DataFrame, limit: float, reach: int) -> tuple[Floats, Mask]:
    """Return :func:`gap_jumps` of whole pairs; ``reach``: samples in which a gap changes."""
    number, gap, time = (table[x].to_numpy(np.float64) for x in ("episode", "gap_m", "time_s"))
    relative = (table["leader_speed_mps"] - table["follower_speed_mps"]).to_numpy(np.float64)
    path = np.cumsum(np.diff(time, prepend=time[0]) * (relative + np.append(0, relative[:-1])) / 2)
    starts, lengths = stretches(number + 1j * gap)  # of equal gaps
    ends = starts + lengths - 1
    # Sensors hold a value until the next one: linear between the samples at which it changes.
    last = np.append(starts_of(number)[1:], len(gap)) - 1  # of each record
    long = time[ends] - time[starts] > HELD_S  # not measured
    node = np.zeros(len(gap), bool)
    for places in (starts, last, ends[long]):
        node[places] = True
    nodes = np.flatnonzero(node)
    rest = pd.Series(np.interp(np.arange(len(gap)), nodes, gap[nodes]) - path)
    change = rest.groupby(number).diff(reach)
    change -= change.groupby(number).transform("median")
    noise = change.abs().groupby(number).transform("median")
    jump = change.where(change.abs() > np.maximum(limit, NOISE * noise), 0.0)
    off = jump.shift(-(reach // 2), fill_value=0.0).to_numpy(np.float64)
    drift = (gap - path)[ends] - (gap - path)[starts]
    beside = np.logical_or.reduceat(off != 0, starts)
    held = long & (beside | (np.abs(drift) > limit))
    edges = np.flatnonzero(np.diff(numbers_of_pairs(table), prepend=-1, append=-1))
    held &= ~np.isin(starts, edges) | ~np.isin(ends + 1, edges)  # not all of a pair
    wrong = (off != 0) | np.repeat(held, lengths)
    return np.where(off != 0, off, np.repeat(drift, lengths)), wrong


def cut_line(table: pd.DataFrame, kept: pd.DataFrame, wrong: Mask) -> list[str]:
    """Return a line on the samples that were left out of records with ``wrong`` samples."""
    starts = starts_of(table["episode"].to_numpy())
    records = int(np.logical_or.reduceat(wrong, starts).sum())
    count = len(table) - len(kept)
    line = (
        f"{records:,} of {len(starts):,} records were cut there: {count:,} samples, "
        f"{count * usual_step(table):,.0f} s, are left out, with parts shorter than "
        f"{SHORTEST_PART:g} s"
    )
    return [Concern(line)]


def hard_share(table: pd.DataFrame) -> float | None:
    """Return the share of samples with a change of speed above 4 m/s in a second.

    Args:
        table: see :meth:`Plausible.select`; the worst column that ends in ``speed_mps`` counts.

    Returns:
        The share; None if there are too few samples.
    """
    step = usual_step(table)
    reach = max(1, round(1 / step)) if step > 0 else 1
    inside = table["episode"].diff(reach) == 0
    if inside.sum() < LEAST_SAMPLES:
        return None
    names = [str(name) for name in table.columns if str(name).endswith("speed_mps")]
    time = table["time_s"].diff(reach)[inside]
    shares = [(table[x].diff(reach)[inside].abs() > HARD * time).mean() for x in names]
    return float(max(shares, default=0.0))


def doubts(table: pd.DataFrame, node: str) -> list[str]:
    """Return concerns about the resolution of speeds and, of single cars, about their units.

    ``node``: section of the settings that help; empty if there is none.
    """

    def by(setting: str) -> str:
        return f" ({node}.{setting})" if node else ""

    step, inside = usual_step(table), table["episode"].diff() == 0
    lines, coarse = list[str](), 0.0
    for name in (str(name) for name in table.columns if str(name).endswith("speed_mps")):
        speed = table[name].astype(float)
        rise = speed.diff().abs()[inside]
        changes = rise[rise > 1e-4]
        least = changes[changes <= 1.5 * changes.quantile(0.02)].median()
        stepped = ((changes / least + 0.1) % 1 < 0.2).mean() > STEPPED
        if stepped and len(changes) >= LEAST_CHANGES and least >= COARSE * step:
            coarse = max(coarse, float(least))
        if "gap_m" in table:
            continue
        if (top := speed.max()) > FASTEST:
            lines.append(f"speeds reach {top:.3g} m/s; are they in mph{by('units.speed=mph')}?")
        fastest = rise.quantile(0.995)
        if step == 1.0 and fastest < SLOW_RATE and speed.min() < STANDING and top > STOPS:
            text = f"cars stop, but 99.5 % of speeds change by less than {fastest:.2g} m/s² in 1 s"
            lines.append(f"{text}; are times frames{by('units.time=frames/10')}?")
    if coarse:
        text = f"of {coarse:.2g} m/s, {step:.2g} s apart: recorded energies and fuel are too large"
        lines.append(f"speeds have a resolution {text}; average them{by('average_s=1.1')}")
    return [Concern(line) for line in lines]


def usual_step(table: pd.DataFrame) -> float:
    """Return the median step within records [s]; 0 if no record has two samples."""
    steps = steps_of(table)
    return float(np.median(steps, overwrite_input=True)) if len(steps) else 0.0


def _not_negative(table: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """Set negative speeds, which are noise, to 0; return a line if there are any."""
    names = [str(name) for name in table.columns if str(name).endswith("speed_mps")]
    below = {name: table[name] < 0.0 for name in names}
    count = sum(int(mask.sum()) for mask in below.values())
    if not count:
        return table, []
    least = min(float(table[name].min()) for name in names)
    table = table.assign(**{name: table[name].clip(lower=0.0) for name in names})
    return table, [f"{count:,} speeds below 0, the least {least:.3g} m/s, count as 0"]
