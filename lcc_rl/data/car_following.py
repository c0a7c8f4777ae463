"""Extraction of car-following episodes from trajectories.

A candidate is a maximal stretch of consecutive frames in which a vehicle has the same preceding
vehicle, both have a row and the gap is within limits. Each criterion then removes whole
candidates, in a fixed order; the report counts them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field

from lcc_rl.arrays import Mask
from lcc_rl.data.grid import ORIGIN, Place, Places, places
from lcc_rl.data.trajectories import FRAME, Trajectories, find_leaders
from lcc_rl.errors import LARGEST, ConfigError, DataError
from lcc_rl.settings import NonNegative, Number, Settings

PASSENGER_CAR = 2
SAMPLE_COLUMNS = (
    *("vehicle", "frame", "segment", "time_s", "position_m", "lane", "length_m", "vehicle_class"),
    *("speed_mps", "preceding", "space_headway_m"),
)


class Criteria(Settings):
    """Criteria of a car-following episode; None: no limit.

    Gaps are bumper to bumper. A candidate is cut where a gap is beyond its limits, and the criteria
    apply to the parts. ``passenger_cars_only``: both vehicles always have class 2; the criterion is
    skipped, with a note in the report, if no vehicle has a class. Both vehicles must share a lane:
    ``split`` cuts a candidate where they do not; ``reject`` removes candidates with a lane change.
    """

    min_duration_s: Annotated[float, Field(ge=FRAME, le=LARGEST)] = 15.0
    max_duration_s: NonNegative | None = None  # longer ones are removed, not cut
    min_gap_m: Number | None = 0.0
    max_gap_m: NonNegative | None = 120.0  # a driver does not follow at longer gaps
    passenger_cars_only: bool = True
    lane_changes: Literal["split", "reject"] = "split"

    def validate(self) -> None:
        for quantity in ("duration_s", "gap_m"):
            low, high = (getattr(self, f"{end}_{quantity}") for end in ("min", "max"))
            if low is not None and high is not None and low > high:
                raise ConfigError(f"criteria: min_{quantity}={low} is above max_{quantity}={high}")


@dataclass
class ExtractionReport:
    """Counts of kept and removed candidates and samples.

    Args:
        place: returns the description of a sample.
        candidates: stretches of one vehicle behind another.
        removed: candidates removed by each criterion, in the order of application.
        kept: episodes left.
        rows: samples in the episodes.
        left_out: samples left out, by reason.
        first: place of the first such sample, by reason.
        notes: further remarks, one a line.
    """

    place: Place
    candidates: int = 0
    removed: dict[str, int] = field(default_factory=dict)
    kept: int = 0
    rows: int = 0
    left_out: dict[str, int] = field(default_factory=dict)
    first: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def lines(self) -> list[str]:
        """Return the report as plain lines."""
        minutes = self.rows * FRAME / 60
        left_out = [
            f"left out {count:,} sample{'s' * (count > 1)}: {why}, the first: {self.first[why]}"
            for why, count in self.left_out.items()
        ]
        return [
            f"{self.candidates:,} candidates: stretches of one vehicle behind another",
            *left_out,
            *(f"removed {count:,}: {name}" for name, count in self.removed.items()),
            *self.notes,
            f"kept {self.kept:,} episodes: {self.rows:,} samples, {minutes:,.1f} min",
        ]

    def leave_out(self, rows: NDArray[np.intp], why: str, column: str) -> None:
        """Count samples that are left out, and describe the first."""
        if len(rows):
            self.left_out[why] = len(rows)
            self.first[why] = self.place(int(rows[0]), column)


def extract(
    trajectories: Trajectories, criteria: Criteria, place: Places = places
) -> tuple[pd.DataFrame, ExtractionReport]:
    """Extract episodes of car following.

    Args:
        trajectories: samples in the shape of :class:`lcc_rl.data.trajectories.Trajectories`.
        criteria: criteria of an episode.
        place: returns for an episode table the function that describes its samples.

    Returns:
        The episode table (:data:`lcc_rl.data.episodes.SCHEMA`), numbered from 0 in the order of
        recording, follower and time, with file and rows if the samples have them; gap_m is the
        space headway minus the leader's length. And a report on the candidates.

    Raises:
        DataError: if no vehicle follows another, or naming the criterion that removes the last
            candidate.
    """
    table = trajectories.samples
    columns = [*SAMPLE_COLUMNS, *(name for name in ORIGIN if name in table)]
    samples = {str(name): table[name].to_numpy() for name in columns}
    recording = table["recording"].cat

    def at(row: int, column: str) -> str:
        return place(table.iloc[[row]])(0, column)

    report = ExtractionReport(at)
    follower, leader = _pairs(samples, recording.codes.to_numpy(), criteria, report)
    gap = samples["space_headway_m"][follower] - samples["length_m"][leader]
    near = _near(gap, follower, criteria, report)
    follower, leader, gap = follower[near], leader[near], gap[near]
    # A candidate begins after a left-out row or a change of segment, leader or lane.
    cut = np.append(True, np.diff(follower) != 1)
    for name in ("segment", "preceding", *(["lane"] if criteria.lane_changes == "split" else [])):
        values = samples[name][follower]
        cut[1:] |= values[1:] != values[:-1]
    starts = np.flatnonzero(cut)
    report.candidates = len(starts)
    lengths = np.diff(np.append(starts, len(follower)))
    keep = np.ones(len(starts), dtype=bool)
    for name, passes in _criteria(samples, follower, leader, starts, criteria, report):
        report.removed[name] = int((keep & ~passes).sum())
        keep &= passes
        if not keep.any():
            longest = f"the longest candidate lasts {FRAME * (lengths.max() - 1):.3g} s"
            message = f"no episode is left after the criterion {name!r}"
            raise DataError("; ".join([message, longest, *report.lines()]))
    entry = np.flatnonzero(np.repeat(keep, lengths))
    report.kept, report.rows = int(keep.sum()), len(entry)
    number = np.repeat(np.arange(report.kept, dtype=np.int32), lengths[keep])
    follower, leader, gap = follower[entry], leader[entry], gap[entry]
    names = pd.Categorical.from_codes(recording.codes.to_numpy()[follower], recording.categories)
    return _episodes(samples, pd.Series(names).astype(str), number, follower, leader, gap), report


def _episodes(
    samples: dict[str, NDArray],
    recording: pd.Series,
    number: NDArray[np.int32],
    follower: NDArray[np.intp],
    leader: NDArray[np.int64],
    gap: NDArray,
) -> pd.DataFrame:
    """Return the episode table from rows of followers and of their leaders."""
    episodes = {
        "episode": number,
        "recording": recording,
        "follower_id": samples["vehicle"][follower],
        "leader_id": samples["vehicle"][leader],
        "time_s": samples["time_s"][follower],
        "follower_position_m": samples["position_m"][follower],
        "follower_speed_mps": samples["speed_mps"][follower],
        "leader_position_m": samples["position_m"][leader],
        "leader_speed_mps": samples["speed_mps"][leader],
        "leader_length_m": samples["length_m"][leader],
        "gap_m": gap,
    }
    if "row" in samples:
        episodes |= {"row": samples["row"][follower], "leader_row": samples["row"][leader]}
        episodes["file"] = samples["file"][follower]
    # The samples have the schema's types; a conversion would copy millions of rows.
    return pd.DataFrame(episodes, copy=False)


def _pairs(
    samples: dict[str, NDArray], recording: NDArray, criteria: Criteria, report: ExtractionReport
) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Return rows of followers with a leader in the same frame, and the rows of the leaders."""
    preceding, lane = samples["preceding"], samples["lane"]
    ahead = find_leaders(recording, samples["vehicle"], samples["frame"], preceding)
    follows, visible = preceding > 0, ahead >= 0
    unseen = "the preceding vehicle is not seen in that frame"
    report.leave_out(np.flatnonzero(follows & ~visible), unseen, "preceding")
    if criteria.lane_changes == "split":
        in_lane = lane[ahead] == lane
        other = "the preceding vehicle is on another lane"
        report.leave_out(np.flatnonzero(visible & ~in_lane), other, "lane")
        visible &= in_lane
    follower = np.flatnonzero(visible)
    if len(follower) == 0:
        named = int(follows.sum())
        cause = f"{named:,} name a preceding vehicle, and none of these has a row"
        raise DataError(
            f"no vehicle follows another in the same lane and frame: of {len(lane):,} samples "
            f"{cause if named else 'none has a preceding vehicle other than itself'}; see "
            f"{report.place(0, 'preceding')}; data=episodes reads tables of pairs, with a follower "
            "and its leader in each row"
        )
    return follower, ahead[follower]


def _near(
    gap: NDArray, follower: NDArray[np.intp], criteria: Criteria, report: ExtractionReport
) -> Mask:
    """Return the samples with a gap within limits; candidates are cut at the others."""
    low, high = criteria.min_gap_m, criteria.max_gap_m
    keep = np.ones(len(gap), dtype=bool)
    for name, limit, sign in (("min_gap_m", low, -1.0), ("max_gap_m", high, 1.0)):
        if limit is None:
            continue
        wrong = sign * gap > sign * limit
        report.leave_out(follower[wrong], f"gap beyond {name}={limit:g}", "gap_m")
        keep &= ~wrong
    if not keep.any():
        message = "no sample is left within min_gap_m and max_gap_m"
        raise DataError("; ".join([message, *report.lines()]))
    return keep


def _criteria(
    samples: dict[str, NDArray],
    follower: NDArray[np.intp],
    leader: NDArray[np.int64],
    starts: NDArray[np.intp],
    criteria: Criteria,
    report: ExtractionReport,
) -> Iterator[tuple[str, Mask]]:
    """Yield the name of each criterion and the candidates that pass it, in order."""
    lengths = np.diff(np.append(starts, len(follower)))

    def always(holds: Mask) -> Mask:
        return np.logical_and.reduceat(holds, starts)

    if criteria.lane_changes == "reject":
        lane = samples["lane"]
        first = np.repeat(lane[follower[starts]], lengths)
        yield "lane_changes: reject", always((lane[follower] == first) & (lane[leader] == first))
    # Half a frame of tolerance: durations are sums of inexact tenths.
    duration = (lengths - 1) * FRAME
    shortest, longest = criteria.min_duration_s, criteria.max_duration_s
    yield f"min_duration_s: {shortest:g}", duration > shortest - FRAME / 2
    if longest is not None:
        yield f"max_duration_s: {longest:g}", duration < longest + FRAME / 2
    if criteria.passenger_cars_only and samples["vehicle_class"].any():
        cars = samples["vehicle_class"] == PASSENGER_CAR
        yield "passenger_cars_only", always(cars[follower] & cars[leader])
    elif criteria.passenger_cars_only:
        report.notes.append(
            "passenger_cars_only: no vehicle has a class (v_Class is all zero or blank), so "
            "all vehicles are kept"
        )
