"""Observed car-following episodes as tensors, longest first."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from lcc_rl.data.episodes import EPISODE_ALIASES
from lcc_rl.data.grid import places
from lcc_rl.errors import Concern, DataError
from lcc_rl.settings import NonNegative, Settings

PAIR_IDENTITY = ("recording", "follower_id", "leader_id")
NUMERIC_COLUMNS = ("time_s", "follower_speed_mps", "leader_speed_mps", "gap_m")


class Selection(Settings):
    """Criteria of the episodes used for calibration."""

    min_gap_m: NonNegative = 1.0  # smallest plausible gap [m]
    # At smaller gaps: cut the episode and use its longest part, or drop the episode.
    low_gaps: Literal["cut", "drop"] = "cut"
    max_duration_s: NonNegative | None = 60.0  # only the first part is used; None: all [s]
    min_duration_s: NonNegative = 10.0  # shorter episodes are dropped [s]
    # Slower episodes are dropped, because the relative error divides by speed [m/s].
    min_mean_speed_mps: NonNegative = 0.5

    def validate(self) -> None:
        longest = self.max_duration_s
        if longest is not None and longest < self.min_duration_s:
            raise ValueError(
                f"max_duration_s={longest:g} must not be below min_duration_s="
                f"{self.min_duration_s:g}"
            )


@dataclass(frozen=True)
class Observed:
    """Parallel episodes, sorted by decreasing length, so that the running ones are a prefix.

    Args:
        leader_speed: ``[time, episodes]`` [m/s]; zero after the end of an episode.
        follower_speed: likewise for the follower [m/s].
        gaps: likewise [m].
        samples: samples per episode, decreasing, on the CPU.
        identity: one row per episode: episode, recording, follower_id, leader_id.
        time_step: sampling interval [s].
        report: lines on dropped episodes and samples.
    """

    leader_speed: Tensor
    follower_speed: Tensor
    gaps: Tensor
    samples: np.ndarray
    identity: pd.DataFrame
    time_step: float
    report: list[str] = field(default_factory=list)

    @property
    def count(self) -> int:
        """Number of episodes."""
        return len(self.samples)

    def split(self, share: float) -> tuple[Observed, Observed]:
        """Cut off the end of every episode; the sample at the cut belongs to both parts.

        Args:
            share: share of the samples that are cut off.

        Raises:
            DataError: if a part of the shortest episode has fewer than two samples.
        """
        last = np.floor(share * self.samples).astype(np.int64)
        first = self.samples - last
        if last.min() < 1 or first.min() < 2:
            raise DataError(
                f"holdout {share:g} of an episode of {int(self.samples.min())} samples leaves a "
                "part without a step; expected longer episodes or another share"
            )
        length = int(last.max()) + 1
        # Rows of the second part, counted from the first sample of each episode.
        rows = torch.from_numpy(first - 1) + torch.arange(length).unsqueeze(-1)
        inside = torch.arange(length).unsqueeze(-1) <= torch.from_numpy(last)
        rows = torch.where(inside, rows, 0).to(self.gaps.device)
        inside = inside.to(self.gaps.device)

        def cut(series: Tensor) -> tuple[Tensor, Tensor]:
            head = series[: int(first.max())].clone()
            kept = torch.arange(len(head)).unsqueeze(-1) < torch.from_numpy(first)
            return head * kept.to(head), series.gather(0, rows) * inside

        speeds, followers, gaps = map(cut, (self.leader_speed, self.follower_speed, self.gaps))
        parts = zip(speeds, followers, gaps, (first, last + 1), strict=True)
        one, other = (
            replace(self, leader_speed=a, follower_speed=b, gaps=c, samples=n)
            for a, b, c, n in parts
        )
        return one, other

    def segments(self) -> Iterator[tuple[int, int, int]]:
        """Yield intervals between the ends of episodes, so that none is simulated beyond its end.

        Yields:
            First step, step after the last, number of episodes (a prefix) still running.
        """
        start = 0
        for stop in np.unique(self.samples) - 1:
            yield start, int(stop), int((self.samples - 1 > start).sum())
            start = int(stop)

    def to(self, device: torch.device | str, dtype: torch.dtype) -> Observed:
        """Return a copy on another device and in another precision."""
        return replace(
            self,
            leader_speed=self.leader_speed.to(device, dtype),
            follower_speed=self.follower_speed.to(device, dtype),
            gaps=self.gaps.to(device, dtype),
        )


def observe(episodes: pd.DataFrame, selection: Selection | None = None) -> Observed:
    """Convert an episode table to tensors, without episodes that cannot be calibrated.

    Args:
        episodes: one row per sample: episode, time_s, follower_speed_mps, leader_speed_mps,
            gap_m and, if known, recording, follower_id, leader_id (or event and period for episode
            and recording). Without follower_id every episode has another driver.
        selection: criteria of the episodes.

    Returns:
        The episodes in float64 on the CPU.

    Raises:
        DataError: if a column is missing or not numeric, or no episode remains.
    """
    selection = selection or Selection()
    frame = _canonical(episodes)
    step = _time_step(frame)
    frame, report = _above(frame, selection)
    frame["least_gap"] = frame.groupby("episode", sort=False)["gap_m"].transform("min")
    frame, shortened = _truncate(frame, selection.max_duration_s)
    table = _summary(frame, step)
    table, lines = _select(table, selection)
    table = table.sort_values("samples", ascending=False, kind="stable")
    length, count = int(table["samples"].iloc[0]), len(table)
    padded = np.zeros((3, length, count))
    series = frame[["leader_speed_mps", "follower_speed_mps", "gap_m"]].to_numpy(np.float64).T
    for column, (start, samples) in enumerate(zip(table["start"], table["samples"], strict=True)):
        padded[:, :samples, column] = series[:, start : start + samples]
    leader, follower, gaps = torch.from_numpy(padded)
    return Observed(
        leader_speed=leader,
        follower_speed=follower,
        gaps=gaps,
        samples=table["samples"].to_numpy(np.int64),
        identity=table[["episode", *PAIR_IDENTITY]].reset_index(drop=True),
        time_step=step,
        report=[*report, *lines, *shortened],
    )


def _canonical(episodes: pd.DataFrame) -> pd.DataFrame:
    """Check columns and types; order by episode and time."""
    aliases = {old: new for old, new in EPISODE_ALIASES.items() if new not in episodes.columns}
    frame = episodes.rename(columns=aliases)
    missing = [name for name in ("episode", *NUMERIC_COLUMNS) if name not in frame.columns]
    if missing:
        raise DataError(f"episode table: missing column(s) {', '.join(missing)}")
    if frame.empty:
        raise DataError("episode table: no rows")
    for name in NUMERIC_COLUMNS:
        if not pd.api.types.is_numeric_dtype(frame[name]):
            raise DataError(f"episode table: column {name!r} is not numeric")
    if "follower_id" not in frame.columns:
        frame = frame.assign(follower_id=frame["episode"])
    for name in PAIR_IDENTITY:
        if name not in frame.columns:
            frame = frame.assign(**{name: "" if name == "recording" else -1})
    return frame.sort_values(["episode", "time_s"], kind="stable", ignore_index=True)


def _time_step(frame: pd.DataFrame) -> float:
    """Return the sampling interval, the median over the table [s]."""
    difference = frame.groupby("episode", sort=False)["time_s"].diff()
    step = float(difference.median())
    if not step > 0.0:
        raise DataError(f"episode table: time_s does not advance (median step {step} s)")
    # Time stamps carry rounding noise that must not enter the simulation.
    return round(step, 6)


def _above(frame: pd.DataFrame, selection: Selection) -> tuple[pd.DataFrame, list[str]]:
    """Return the longest part of each episode without small gaps, and a line on cut episodes."""
    low = frame["gap_m"].to_numpy() < selection.min_gap_m
    if selection.low_gaps == "drop" or not low.any() or low.all():
        return frame, []
    episode, time = frame["episode"], frame["time_s"]
    begins = low | (episode != episode.shift()).to_numpy()
    part = pd.Series(np.cumsum(begins), index=frame.index).mask(low)
    length = time.groupby(part).transform("max") - time.groupby(part).transform("min")
    longest = part[length == length.groupby(episode).transform("max")].groupby(episode).min()
    kept = frame[part == episode.map(longest)]
    where = places(frame)(int(np.argmax(low)), "gap_m")
    line = (
        f"{episode[low].nunique()} of {episode.nunique()} episodes cut where the gap is below "
        f"{selection.min_gap_m:g} m, the first: {where}; their longest part is used"
    )
    return kept.reset_index(drop=True), [Concern(line)]


def _truncate(frame: pd.DataFrame, duration: float | None) -> tuple[pd.DataFrame, list[str]]:
    """Return the first seconds of each episode, and a line if samples are left out."""
    if duration is None:
        return frame, []
    elapsed = frame["time_s"] - frame.groupby("episode", sort=False)["time_s"].transform("first")
    kept = frame[elapsed <= duration + 1e-6].reset_index(drop=True)
    line = (
        f"fits the first {duration:g} s of each, {100 * len(kept) / len(frame):.0f} % of the "
        "samples (calibration.selection.max_duration_s=null for all)"
    )
    return kept, [line] if len(kept) < len(frame) else []


def _summary(frame: pd.DataFrame, step: float) -> pd.DataFrame:
    """Return one row per episode: its first row and the values that the selection checks."""
    values = frame[list(NUMERIC_COLUMNS)]
    frame = frame.assign(
        finite=np.isfinite(values.to_numpy(np.float64)).all(axis=1)
        & (values[["follower_speed_mps", "leader_speed_mps"]] >= 0.0).all(axis=1),
        uneven=(frame.groupby("episode", sort=False)["time_s"].diff() - step).abs() > 0.1 * step,
        row=np.arange(len(frame)),
    )
    return (
        frame.groupby("episode", sort=False)
        .agg(
            recording=("recording", "first"),
            follower_id=("follower_id", "first"),
            leader_id=("leader_id", "first"),
            start=("row", "first"),
            samples=("row", "size"),
            least_gap=("least_gap", "first"),
            mean_speed=("follower_speed_mps", "mean"),
            finite=("finite", "all"),
            uneven=("uneven", "any"),
            duration=("time_s", lambda time: time.iloc[-1] - time.iloc[0]),
        )
        .reset_index()
    )


def _select(table: pd.DataFrame, selection: Selection) -> tuple[pd.DataFrame, list[str]]:
    """Drop unusable episodes; each counts for its first reason."""
    reasons = {
        "missing, infinite or negative values": ~table["finite"],
        "uneven sampling": table["uneven"],
        f"shorter than {selection.min_duration_s:g} s": table["duration"]
        < selection.min_duration_s - 1e-6,
        f"gap below {selection.min_gap_m:g} m": table["least_gap"] < selection.min_gap_m,
        f"mean speed below {selection.min_mean_speed_mps:g} m/s": table["mean_speed"]
        < selection.min_mean_speed_mps,
    }
    keep = pd.Series(True, index=table.index)
    lines: list[str] = []
    for reason, bad in reasons.items():
        dropped = int((keep & bad).sum())
        keep &= ~bad
        if dropped:
            lines.append(Concern(f"{dropped} of {len(table)} episodes dropped: {reason}"))
    if not keep.any():
        raise DataError(f"no episode is fit for calibration: {'; '.join(lines)}")
    lines.append(f"{int(keep.sum())} of {len(table)} episodes used for calibration")
    return table[keep], lines
