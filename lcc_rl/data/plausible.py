"""Plausibility of recorded motion: one check, by the same thresholds, for every reader."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lcc_rl.data.gap_rates import gap_rate
from lcc_rl.errors import ConfigError, DataError

SMOOTHING = "'data.smoothing={_target_:lcc_rl.data.smoothing.SavitzkyGolay,window_s:1.5}'"
Floats = NDArray[np.float64]


class Fault(NamedTuple):
    """Samples outside one threshold.

    Args:
        column: of the table.
        words: what was found, with a place for the number.
        values: that number, ``[rows]``.
        setting: the threshold's name.
        wrong: which samples are outside, ``[rows]``.
    """

    column: str
    words: str
    values: Floats
    setting: str
    wrong: NDArray[np.bool_]


@dataclass(frozen=True)
class Plausible:
    """Thresholds of recorded motion; a record with a sample outside of one is left out.

    Args:
        max_speed: [m/s]; beyond it, a column is in km/h or ft/s rather than driven that fast.
        max_acceleration: change of speed between consecutive samples, either sign [m/s²].
        min_length, max_length: length of a vehicle [m]; 0 counts as not given.
        max_gap: gap between bumpers [m].
        max_step: time between consecutive samples [s].
        max_share: share of the records that may be left out, 0…1; beyond, the data are refused.
        max_mismatch: factor, either way, between what gaps change by and what the speeds say
            (:func:`lcc_rl.data.gap_rates.gap_rate`); beyond, the data are refused.

    Raises:
        ConfigError: if a threshold is not positive, the share is not in 0…1 or the factor is
            below 1.
    """

    max_speed: float = 70.0
    max_acceleration: float = 10.0
    min_length: float = 2.0
    max_length: float = 30.0
    max_gap: float = 500.0
    max_step: float = 10.0
    max_share: float = 0.1
    max_mismatch: float = 1.5

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0 and not (name in ("min_length", "max_share") and value == 0):
                raise ConfigError(f"plausible.{name} must be positive, got {value}")
        if not self.max_share <= 1:
            raise ConfigError(f"plausible.max_share must be 0 to 1, got {self.max_share}")
        if not self.max_mismatch >= 1:
            raise ConfigError(f"plausible.max_mismatch must be at least 1, got {self.max_mismatch}")

    def select(
        self,
        table: pd.DataFrame,
        source: str,
        place: Callable[[int, str], str],
        setting: str = "data.plausible",
        remedy: str = "",
    ) -> tuple[pd.DataFrame, list[str]]:
        """Leave out the records that hold an implausible sample.

        Args:
            table: rows of a record (column ``episode``) lie together, in order of time: time_s
                and, where present, gap_m and columns that end in ``speed_mps`` and ``length_m``.
            source: the file or files, for messages.
            place: describes a row to the user, by its number and the column at fault.
            setting: where the configuration has these thresholds.
            remedy: what else a user may do about accelerations.

        Returns:
            The other records, and a line for each kind of fault, counted by its first reason.

        Raises:
            DataError: if more than ``max_share`` of the records, or all, would be left out, or
                gaps and speeds contradict each other.
        """
        first = table["episode"].ne(table["episode"].shift()).to_numpy()
        starts = np.flatnonzero(first)
        lengths = np.diff([*starts, len(table)])
        keep, lines, told = np.ones(len(starts), dtype=bool), [], ""
        for fault in self.faults(table, first):
            bad = np.logical_or.reduceat(fault.wrong, starts) & keep
            if not bad.any():
                continue
            row = int(np.argmax(fault.wrong & np.repeat(bad, lengths)))
            limit = f"{setting}.{fault.setting}={getattr(self, fault.setting):g}"
            said = f"{place(row, fault.column)} {fault.words.format(fault.values[row])}, {limit}"
            lines.append(f"left out {int(bad.sum()):,} implausible record(s), the first: {said}")
            more = remedy if fault.setting == "max_acceleration" else ""
            told = told or f"{said}; mend the file{more}, or raise that threshold"
            keep &= ~bad
        self._check_share(keep, f"{setting}.max_share={self.max_share:g}", source, told)
        kept = table if keep.all() else table[np.repeat(keep, lengths)].reset_index(drop=True)
        self._check_gaps(kept, f"{setting}.max_mismatch={self.max_mismatch:g}", source)
        return kept, lines

    def _check_gaps(self, table: pd.DataFrame, limit: str, source: str) -> None:
        """Refuse data whose gaps do not change as the speeds of leader and follower say."""
        rate = gap_rate(table)
        if rate is None or 1 / self.max_mismatch <= rate <= self.max_mismatch:
            return
        raise DataError(
            f"{source}: gaps change by {rate:.2f} m where the speeds of leader and follower say "
            f"1 m, {limit}; are speeds in km/h, mph or ft/s, gaps in feet, or leader and follower "
            "exchanged?"
        )

    def _check_share(self, keep: NDArray[np.bool_], limit: str, source: str, told: str) -> None:
        """Refuse data of which too many records are left out."""
        if keep.any() and np.mean(~keep) <= self.max_share:
            return
        raise DataError(
            f"{source}: {int((~keep).sum()):,} of {len(keep):,} records are implausible (at most "
            f"{limit} of them may be left out), the first: {told}"
        )

    def faults(self, table: pd.DataFrame, first: NDArray[np.bool_]) -> Iterator[Fault]:
        """Yield what is outside of the thresholds; ``first`` marks the first row of each record."""
        time = table["time_s"].to_numpy(np.float64)
        step = np.diff(time, prepend=time[0])
        step[first] = 0.0
        late = step > self.max_step
        yield Fault("time_s", "is {:g} s after the sample before it", step, "max_step", late)
        for name in map(str, table.columns):
            if not (name.endswith(("speed_mps", "length_m")) or name == "gap_m"):
                continue
            values = table[name].to_numpy(np.float64)
            if name.endswith("speed_mps"):
                fast = values > self.max_speed
                words = "holds {:g} m/s (is it km/h or ft/s?)"
                yield Fault(name, words, values, "max_speed", fast)
                rate = np.diff(values, prepend=values[0]) / np.where(step > 0, step, np.inf)
                rough = np.abs(rate) > self.max_acceleration
                yield Fault(name, "changes by {:g} m/s²", rate, "max_acceleration", rough)
            elif name == "gap_m":
                yield Fault(name, "holds {:g} m", values, "max_gap", values > self.max_gap)
            else:
                short = (values != 0) & (values < self.min_length)
                yield Fault(name, "holds {:g} m", values, "min_length", short)
                yield Fault(name, "holds {:g} m", values, "max_length", values > self.max_length)


def pair_place(episodes: pd.DataFrame) -> Callable[[int, str], str]:
    """Return what describes a row of an episode table: recording, vehicle, time and column."""

    def place(row: int, column: str) -> str:
        entry = episodes.iloc[row]
        role = "leader" if column.startswith("leader") else "follower"
        where = f"recording {entry['recording']}, vehicle {entry[f'{role}_id']} ({role})"
        return f"row {row} ({where}, {entry['time_s']:g} s), column {column!r}"

    return place
