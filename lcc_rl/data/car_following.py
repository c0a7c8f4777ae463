"""Extraction of car-following episodes from trajectories.

A candidate is a maximal stretch of consecutive frames in which a vehicle names the same preceding
vehicle and both have a row. Each criterion then removes whole candidates, in a fixed order, and
the report counts how many.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field

from lcc_rl.data.trajectories import FRAME, Trajectories, find_leaders
from lcc_rl.errors import LARGEST, ConfigError, DataError
from lcc_rl.settings import NonNegative, Number, Settings

PASSENGER_CAR = 2
Mask = NDArray[np.bool_]


class Criteria(Settings):
    """Criteria of a car-following episode; None stands for no limit.

    Gaps are bumper to bumper, at any time. ``passenger_cars_only``: both vehicles are of class 2
    throughout; where no vehicle has a class this is skipped, with a note in the report. Both
    vehicles share one lane throughout: ``split`` cuts a candidate where they do not and judges the
    parts; ``reject`` removes a candidate with any lane change.
    """

    min_duration_s: Annotated[float, Field(ge=FRAME, le=LARGEST)] = 15.0
    max_duration_s: NonNegative | None = None  # longer ones are removed, not cut
    min_gap_m: Number | None = 0.0
    max_gap_m: NonNegative | None = 120.0  # beyond it, a driver does not follow
    passenger_cars_only: bool = True
    lane_changes: Literal["split", "reject"] = "split"

    def settled(self) -> None:
        for quantity in ("duration_s", "gap_m"):
            low, high = (getattr(self, f"{end}_{quantity}") for end in ("min", "max"))
            if low is not None and high is not None and low > high:
                raise ConfigError(f"criteria: min_{quantity}={low} is above max_{quantity}={high}")


@dataclass
class ExtractionReport:
    """Counts of what the extraction kept and removed.

    Args:
        candidates: stretches of one vehicle behind another.
        removed: candidates removed by each criterion, in the order of application.
        kept: episodes left.
        rows: samples in the episodes.
        unseen: samples that name a preceding vehicle which has no row in that frame.
        other_lane: samples that name a preceding vehicle on another lane, left out by ``split``.
        notes: further remarks, one a line.
    """

    candidates: int = 0
    removed: dict[str, int] = field(default_factory=dict)
    kept: int = 0
    rows: int = 0
    unseen: int = 0
    other_lane: int = 0
    notes: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def lines(self) -> list[str]:
        """The report as plain lines."""
        minutes = self.rows * FRAME / 60
        left_out = {
            "name a preceding vehicle that is not seen in that frame": self.unseen,
            "name a preceding vehicle on another lane": self.other_lane,
        }
        return [
            f"{self.candidates:,} candidates: stretches of one vehicle behind another",
            *(f"left out {count:,} samples that {why}" for why, count in left_out.items() if count),
            *(f"removed {count:,}: {name}" for name, count in self.removed.items()),
            *self.notes,
            f"kept {self.kept:,} episodes: {self.rows:,} samples, {minutes:,.1f} min",
        ]


@dataclass
class _Pairs:
    """Samples of followers whose leader has a row in the frame, grouped into candidates.

    Args:
        follower, leader: rows of the samples table, one entry per sample of a candidate.
        starts, lengths: first entry and number of entries of each candidate.
        gap: bumper-to-bumper gap of each entry [m].
    """

    follower: NDArray[np.int64]
    leader: NDArray[np.int64]
    starts: NDArray[np.intp]
    lengths: NDArray[np.intp]
    gap: NDArray[np.float32]

    def always(self, holds: Mask) -> Mask:
        """Candidates in which a condition holds throughout."""
        return np.logical_and.reduceat(holds, self.starts)


def extract(
    trajectories: Trajectories, criteria: Criteria
) -> tuple[pd.DataFrame, ExtractionReport]:
    """Extract episodes of car following.

    Args:
        trajectories: samples in the shape of :class:`lcc_rl.data.trajectories.Trajectories`.
        criteria: what counts as an episode.

    Returns:
        The episode table (:data:`lcc_rl.data.episodes.SCHEMA`), numbered from 0 in the order of
        recording, follower and time; gap_m is the space headway less the leader's length. And a
        report on what each criterion removed.

    Raises:
        DataError: if no vehicle follows another, or a criterion removes the last candidate; it
            names the criterion.
    """
    samples = trajectories.samples
    report = ExtractionReport()
    pairs = _pairs(samples, criteria, report)
    keep = np.ones(len(pairs.starts), dtype=bool)
    for name, passes in _criteria(samples, pairs, criteria, report):
        report.removed[name] = int((keep & ~passes).sum())
        keep &= passes
        if not keep.any():
            raise DataError(f"no episode is left after the criterion {name!r}:\n{report}")
    episodes = _episodes(samples, pairs, keep)
    report.kept, report.rows = int(keep.sum()), len(episodes)
    return episodes, report


def _pairs(samples: pd.DataFrame, criteria: Criteria, report: ExtractionReport) -> _Pairs:
    """All candidates."""
    preceding = samples["preceding"].to_numpy()
    ahead = find_leaders(
        samples["recording"].cat.codes.to_numpy(),
        samples["vehicle"].to_numpy(),
        samples["frame"].to_numpy(),
        preceding,
    )
    report.unseen = int(((preceding > 0) & (ahead < 0)).sum())
    lane = samples["lane"].to_numpy()
    seen = ahead >= 0
    if criteria.lane_changes == "split":
        same = lane[ahead] == lane
        report.other_lane = int((seen & ~same).sum())
        seen &= same
    follower = np.flatnonzero(seen)
    if len(follower) == 0:
        raise DataError(
            f"no vehicle follows another in the same lane and frame: of {len(samples):,} samples "
            f"{int((preceding > 0).sum()):,} name a preceding vehicle, and none of those is seen; "
            "expected a Preceding column that names vehicles in the file"
        )
    leader = ahead[follower]
    starts = _cuts(samples, follower, criteria)
    report.candidates = len(starts)
    length = samples["length_m"].to_numpy()[leader]
    gap = samples["space_headway_m"].to_numpy()[follower] - length
    return _Pairs(follower, leader, starts, np.diff(np.append(starts, len(follower))), gap)


def _cuts(
    samples: pd.DataFrame, follower: NDArray[np.int64], criteria: Criteria
) -> NDArray[np.intp]:
    """First entry of each candidate: a row left out, or a change of segment, leader or lane."""
    cut = np.ones(len(follower), dtype=bool)
    cut[1:] = np.diff(follower) != 1
    names = ["segment", "preceding"] + (["lane"] if criteria.lane_changes == "split" else [])
    for name in names:
        values = samples[name].to_numpy()[follower]
        cut[1:] |= values[1:] != values[:-1]
    return np.flatnonzero(cut)


def _criteria(
    samples: pd.DataFrame, pairs: _Pairs, criteria: Criteria, report: ExtractionReport
) -> Iterator[tuple[str, Mask]]:
    """Name of each criterion and which candidates pass it, in the order of application."""
    if criteria.lane_changes == "reject":
        lane = samples["lane"].to_numpy()
        first = np.repeat(lane[pairs.follower[pairs.starts]], pairs.lengths)
        one_lane = (lane[pairs.follower] == first) & (lane[pairs.leader] == first)
        yield "lane_changes: reject", pairs.always(one_lane)
    # Half a frame of slack: durations are sums of inexact tenths.
    duration = (pairs.lengths - 1) * FRAME
    shortest, longest = criteria.min_duration_s, criteria.max_duration_s
    yield f"min_duration_s: {shortest:g}", duration > shortest - FRAME / 2
    if longest is not None:
        yield f"max_duration_s: {longest:g}", duration < longest + FRAME / 2
    if criteria.passenger_cars_only:
        kind = samples["vehicle_class"].to_numpy()
        if kind.any():
            car = kind == PASSENGER_CAR
            yield "passenger_cars_only", pairs.always(car[pairs.follower] & car[pairs.leader])
        else:
            report.notes.append(
                "passenger_cars_only: no vehicle has a class (v_Class is all zero or blank), so "
                "there is nothing to filter on and every vehicle stays"
            )
    forward = samples["speed_mps"].to_numpy() >= 0
    yield "speeds of at least 0", pairs.always(forward[pairs.follower] & forward[pairs.leader])
    if criteria.min_gap_m is not None:
        yield f"min_gap_m: {criteria.min_gap_m:g}", pairs.always(pairs.gap >= criteria.min_gap_m)
    if criteria.max_gap_m is not None:
        yield f"max_gap_m: {criteria.max_gap_m:g}", pairs.always(pairs.gap <= criteria.max_gap_m)


def _episodes(samples: pd.DataFrame, pairs: _Pairs, keep: Mask) -> pd.DataFrame:
    """The episode table of the candidates that are left."""
    entry = np.flatnonzero(np.repeat(keep, pairs.lengths))
    follower, leader = pairs.follower[entry], pairs.leader[entry]
    position, speed = samples["position_m"].to_numpy(), samples["speed_mps"].to_numpy()
    vehicle, recording = samples["vehicle"].to_numpy(), samples["recording"].cat
    number = np.arange(int(keep.sum()), dtype=np.int32)
    names = pd.Categorical.from_codes(recording.codes.to_numpy()[follower], recording.categories)
    columns: dict[str, Any] = {
        "episode": np.repeat(number, pairs.lengths[keep]),
        "recording": pd.Series(names).astype(str),
        "follower_id": vehicle[follower],
        "leader_id": vehicle[leader],
        "time_s": samples["time_s"].to_numpy()[follower],
        "follower_position_m": position[follower],
        "follower_speed_mps": speed[follower],
        "leader_position_m": position[leader],
        "leader_speed_mps": speed[leader],
        "leader_length_m": samples["length_m"].to_numpy()[leader],
        "gap_m": pairs.gap[entry],
    }
    # The samples have the schema's types; a conversion would copy what may be millions of rows.
    return pd.DataFrame(columns, copy=False)
