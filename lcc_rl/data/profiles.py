"""Speed profiles of leaders: extraction, windows, division into training and evaluation."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
import pandas as pd
import torch
from pydantic import Field
from torch import Tensor

from lcc_rl.data.grid import steps_at
from lcc_rl.data.trajectories import listed
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.settings import Settings

EvaluationShare = Annotated[float, Field(gt=0.0, le=1.0)]
MOST_LINES = 5  # most records with a line
NONE_LEFT = "no speed profile left: at least one leader's record is needed"


@dataclass(frozen=True)
class Profiles:
    """Speed records of leaders, stored end to end.

    Args:
        speeds: all records, shape ``[samples]``, float32 [m/s].
        offsets: where each record starts, shape ``[profiles]``, int64.
        lengths: samples of each record, shape ``[profiles]``, int64.
        names: name of each record: recording, vehicle and start.
        recordings: the recording of each record.
        time_step: time between samples [s].
        reach: samples of each record including those after a window's end, shape ``[profiles]``,
            for previews.
        weights: relative frequency of each record in training, ``[profiles]``, float64; None: all
            are equal.
        sources: the source of each record, if there are several; else empty.
        followers: speed [m/s] and gap [m] of the recorded driver behind each leader,
            ``[samples, 2]``, float32; None if there is none.
        grades: grade of the road at each sample, for energies of trips [rad]; None: not read.
        starts: time in its recording at which each record starts [s]; empty: unknown.
    """

    speeds: Tensor
    offsets: Tensor
    lengths: Tensor
    names: tuple[str, ...]
    recordings: tuple[str, ...]
    time_step: float
    reach: Tensor
    weights: Tensor | None = None
    sources: tuple[str, ...] = ()
    followers: Tensor | None = None
    grades: Tensor | None = None
    starts: tuple[float, ...] = ()

    def __len__(self) -> int:
        return len(self.names)

    def record(self, index: int) -> Tensor:
        """Return one speed record, shape ``[samples]`` [m/s]."""
        start = int(self.offsets[index])
        return self.speeds[start : start + int(self.lengths[index])]

    def follower(self, index: int) -> Tensor | None:
        """Return the recorded follower, ``[samples, 2]``, see ``followers``."""
        start = int(self.offsets[index])
        records = self.followers
        return None if records is None else records[start : start + int(self.lengths[index])]

    def select(self, indices: Iterable[int]) -> Profiles:
        """Return the records with the given indices, in that order.

        Raises:
            DataError: if there is none.
        """
        chosen = [int(i) for i in indices]
        if not chosen:
            raise DataError(NONE_LEFT)
        index = torch.tensor(chosen)
        reach = self.reach[index]
        spans = torch.stack([self.offsets[index], self.offsets[index] + reach], 1).tolist()
        behind = self.followers
        return replace(
            self,
            speeds=torch.cat([self.speeds[first:end] for first, end in spans]),
            followers=None if behind is None else torch.cat([behind[a:b] for a, b in spans]),
            offsets=torch.cumsum(reach, 0) - reach,
            lengths=self.lengths[index],
            names=tuple(self.names[i] for i in chosen),
            recordings=tuple(self.recordings[i] for i in chosen),
            reach=reach,
            weights=None if self.weights is None else self.weights[index],
            sources=tuple(self.sources[i] for i in chosen if self.sources),
            starts=tuple(self.starts[i] for i in chosen if self.starts),
        )

    def windows(self, horizon: int, limit: int | None = None) -> Profiles:
        """Cut the records into consecutive windows of ``horizon`` steps that do not overlap.

        The samples after a window in its record are kept, see ``reach``.

        Args:
            horizon: steps per window; a window has one sample more.
            limit: most windows, spread evenly over all; None: all windows.

        Raises:
            DataError: if no record is long enough.
        """
        cuts = [
            (index, start)
            for index in range(len(self))
            for start in range(0, int(self.lengths[index]) - horizon, horizon + 1)
        ]
        if not cuts:
            raise DataError(self._too_short(horizon))
        cuts = [cuts[i] for i in evenly(len(cuts), limit)]
        whole = from_records(
            [self.record(i)[start:] for i, start in cuts],
            [f"{self.names[i]}+{start * self.time_step:g}s" for i, start in cuts],
            [self.recordings[i] for i, _ in cuts],
            self.time_step,
            None if self.followers is None else [self.follower(i)[start:] for i, start in cuts],  # type: ignore[index]
            [self.starts[i] + start * self.time_step for i, start in cuts if self.starts],
        )
        played = torch.full_like(whole.lengths, horizon + 1)
        return replace(whole, lengths=played)

    def spread(self, limit: int | None) -> Profiles:
        """Return at most ``limit`` records of each source, spread evenly; None: all."""
        groups: dict[str, list[int]] = {}
        for index, source in enumerate(self.sources or [""] * len(self)):
            groups.setdefault(source, []).append(index)
        return self.select(g[i] for g in groups.values() for i in evenly(len(g), limit))

    def at_least(self, horizon: int) -> Profiles:
        """Return the records with at least ``horizon`` steps.

        Raises:
            DataError: if there is none.
        """
        long = [i for i in range(len(self)) if int(self.lengths[i]) > horizon]
        if not long:
            raise DataError(self._too_short(horizon))
        return self.select(long)

    def _too_short(self, horizon: int) -> str:
        if not len(self):
            return NONE_LEFT
        longest = int(self.lengths.argmax())
        steps = int(self.lengths[longest]) - 1
        return (
            f"profile shorter than the horizon: the longest of {len(self)} speed profiles, "
            f"{self.names[longest]}, has {steps} steps ({steps * self.time_step:g} s), an episode "
            f"needs {horizon} ({horizon * self.time_step:g} s); lower scenario.horizon or give "
            "longer data"
        )


def evenly(count: int, limit: int | None) -> list[int]:
    """Return at most ``limit`` of the indices below ``count``, spread evenly; None: all."""
    if limit is None or limit >= count:
        return list(range(count))
    return [int(i) for i in np.linspace(0, count - 1, limit).round()]


def from_records(
    records: Sequence[Tensor],
    names: Sequence[str],
    recordings: Sequence[str],
    time_step: float,
    followers: Sequence[Tensor] | None = None,
    starts: Sequence[float] = (),
) -> Profiles:
    """Build profiles from separate speed records; arguments as for :class:`Profiles`.

    Raises:
        DataError: if there is none, or a speed is negative or missing.
    """
    if not records:
        raise DataError(NONE_LEFT)
    for name, record in zip(names, records, strict=True):
        fits = record.isfinite() & (record >= 0)
        if not fits.all():
            sample = int(fits.int().argmin())
            wrong = f"sample {sample}, from 0, is {record[sample]:g}"
            raise DataError(f"profile {name}: {wrong}; speeds must be finite and not negative")
    lengths = torch.tensor([len(record) for record in records])
    return Profiles(
        speeds=torch.cat([record.to(torch.float32) for record in records]),
        offsets=torch.cumsum(lengths, 0) - lengths,
        lengths=lengths,
        reach=lengths,
        names=tuple(names),
        recordings=tuple(recordings),
        time_step=time_step,
        followers=None if followers is None else torch.cat(list(followers)).to(torch.float32),
        starts=tuple(starts),
    )


def no_profiles(time_step: float) -> Profiles:
    """Return empty profiles, for training if all are for evaluation."""
    none = torch.zeros(0, dtype=torch.int64)
    return Profiles(torch.zeros(0), none, none, (), (), time_step, none)


def joined(parts: Sequence[Profiles]) -> Profiles:
    """Concatenate several profiles with one time step."""
    sizes = [len(part.speeds) for part in parts]
    behind = [part.followers for part in parts if part.followers is not None]
    return Profiles(
        speeds=torch.cat([part.speeds for part in parts]),
        offsets=torch.cat([part.offsets + sum(sizes[:i]) for i, part in enumerate(parts)]),
        lengths=torch.cat([part.lengths for part in parts]),
        names=tuple(name for part in parts for name in part.names),
        recordings=tuple(name for part in parts for name in part.recordings),
        time_step=parts[0].time_step,
        reach=torch.cat([part.reach for part in parts]),
        followers=torch.cat(behind) if len(behind) == len(parts) else None,
        starts=sum((part.starts for part in parts if all(x.starts for x in parts)), ()),
    )


def described_records(profiles: Profiles, horizon: int) -> list[str]:
    """Return lines on duration, mean and largest speed of the records, fastest first.

    A last line counts the records that are shorter than ``horizon`` steps.
    """
    lines, short = [], []
    for index, name in enumerate(profiles.names):
        x = profiles.record(index)
        seconds, most = (len(x) - 1) * profiles.time_step, float(x.max())
        line = f"{name}: {seconds:,.0f} s, speed {float(x.mean()):.3g} m/s, at most {most:.3g} m/s"
        lines.append((-most, line))
        short += [f"{name} ({seconds:g} s)"] * (len(x) <= horizon)
    notes = [f"… and {len(lines) - MOST_LINES:,} slower records"] if len(lines) > MOST_LINES else []
    text = f"left out {len(short):,} of {len(profiles):,} record(s), shorter than an episode of"
    text += f" {horizon * profiles.time_step:g} s (scenario.horizon={horizon})"
    notes += [f"{text}: {listed(short)}"] * bool(short)
    return [
        line for _, line in (sorted(lines)[:MOST_LINES] if len(lines) > MOST_LINES else lines)
    ] + notes


def leader_profiles(episodes: pd.DataFrame, time_step: float) -> Profiles:
    """Return the leader's speed record of every episode, with its follower's speed and gap.

    Args:
        episodes: the SI table of episodes (see :mod:`lcc_rl.data.episodes`).
        time_step: step of the table [s].

    Raises:
        DataError: if the table has another time step, or no episode.
    """
    records, names, recordings, followers, starts = [], [], [], [], []
    columns = [episodes[name].to_numpy() for name in ("time_s", "recording", "leader_id")]
    speeds = episodes["leader_speed_mps"].to_numpy(np.float32)
    behind = episodes[["follower_speed_mps", "gap_m"]].to_numpy(np.float32)
    for number, rows in episodes.groupby("episode", sort=True).indices.items():
        time, recording, leader = (column[rows] for column in columns)
        if len(time) > 1 and not np.allclose(np.diff(time), time_step, atol=0.1 * time_step):
            raise DataError(
                f"episode {number}: samples are {np.median(np.diff(time)):g} s apart (or not "
                f"evenly spaced), but scenario.time_step={time_step:g}: leaders are played at the "
                "rate at which they were recorded; remove the setting"
            )
        records.append(torch.from_numpy(speeds[rows]))
        names.append(f"{recording[0]}/{int(leader[0])}@{time[0]:.1f}s")
        recordings.append(str(recording[0]))
        starts.append(float(time[0]))
        followers.append(torch.from_numpy(behind[rows]))
    return from_records(records, names, recordings, time_step, followers, starts)


def resample(
    time: np.ndarray,
    speed: np.ndarray,
    time_step: float,
    begin: float | None = None,
    end: float | None = None,
) -> Tensor:
    """Interpolate or average a record to another step (:func:`lcc_rl.data.grid.steps_at`).

    No speed becomes negative and no peak grows.

    Args:
        time: increasing times [s].
        speed: speeds [m/s].
        time_step: new step [s].
        begin, end: part of the record [s]; None: the whole record.

    Returns:
        Speeds, ``[steps]``, float32 [m/s].
    """
    begin, end = time[0] if begin is None else begin, time[-1] if end is None else end
    grid = begin + time_step * np.arange(int(np.floor((end - begin) / time_step + 1e-6)) + 1)
    speeds = steps_at(np.asarray(grid), time_step, time, speed)
    return torch.tensor(speeds.clip(min=0.0), dtype=torch.float32)


def at_step(profiles: Profiles, time_step: float) -> Profiles:
    """Interpolate every record to another step [s]."""
    if time_step == profiles.time_step:
        return profiles

    def changed(series: Tensor) -> Tensor:
        values = series.numpy().astype(float)
        return resample(np.arange(len(values)) * profiles.time_step, values, time_step)

    numbers, followers = range(len(profiles)), None
    if profiles.followers is not None:
        followers = [changed(profiles.follower(index)) for index in numbers]  # type: ignore[arg-type]
    records = [changed(profiles.record(index)) for index in numbers]
    same = profiles.names, profiles.recordings, time_step, followers, profiles.starts
    return from_records(records, *same)


class Split(Settings):
    """Division into training and evaluation profiles that share no recording or vehicle.

    ``recording`` holds out whole recordings, which share no traffic wave. ``vehicle`` holds out
    leaders within every recording. With an ``evaluation_share`` of 1 all profiles are for
    evaluation.
    """

    by: Literal["recording", "vehicle"] = "recording"
    evaluation_share: EvaluationShare = 0.34  # of the recordings or vehicles
    # For choosing settings: leave out the evaluation profiles and divide the training profiles
    # again by the same rule.
    tuning: bool = False

    def __call__(self, profiles: Profiles) -> tuple[Profiles, Profiles]:
        """Return the training and the evaluation profiles.

        Raises:
            DataError: if there are not at least two recordings (or vehicles) to divide.
        """
        if self.evaluation_share == 1:
            return no_profiles(profiles.time_step), profiles
        if self.tuning:
            profiles, _ = self._divide(profiles)
        return self._divide(profiles)

    def _divide(self, profiles: Profiles) -> tuple[Profiles, Profiles]:
        # The vehicle is the part of the name before the time, so that episodes behind the same
        # leader are on one side.
        vehicles = [vehicle.rsplit("@", 1)[0] for vehicle in profiles.names]
        groups = [*profiles.recordings] if self.by == "recording" else vehicles
        distinct = sorted(set(groups))
        if len(distinct) < 2:
            other = self.by == "recording" and len(set(vehicles)) > 1
            use = "split.by=vehicle" if other else "split=single (train and evaluate on one)"
            raise DataError(
                f"cannot split {len(profiles)} profiles by {self.by}: only {distinct} found; "
                f"give more data, or use {use}; evaluations also take split.evaluation_share=1"
            )
        count = min(max(round(self.evaluation_share * len(distinct)), 1), len(distinct) - 1)
        # Evenly spread over the sorted groups, always with the last one. No seed is used, so all
        # runs hold out the same data.
        picks = np.linspace(len(distinct) - 1, 0, count, endpoint=False).round().astype(int)
        evaluation = {distinct[i] for i in picks}
        inside = [i for i, group in enumerate(groups) if group in evaluation]
        outside = [i for i, group in enumerate(groups) if group not in evaluation]
        return profiles.select(outside), profiles.select(inside)


class SingleProfile(Settings):
    """One profile for training, as probably in the ALCC paper."""

    # Its number among all profiles that are long enough, or, with ``held_out``, among its training
    # profiles.
    profile: int = 0
    # Division that provides the evaluation profiles; None: evaluate on the training profile.
    held_out: Split | None = None

    def __call__(self, profiles: Profiles) -> tuple[Profiles, Profiles]:
        """Return the training and the evaluation profiles.

        Raises:
            ConfigError: if there is no profile of that number.
            DataError: if ``held_out`` cannot divide the profiles.
        """
        training, evaluation = (
            (profiles, None) if self.held_out is None else self.held_out(profiles)
        )
        if not 0 <= self.profile < len(training):
            raise ConfigError(
                f"split.profile must lie in 0…{len(training) - 1} with these data, "
                f"got {self.profile}"
            )
        chosen = training.select([self.profile])
        return chosen, chosen if evaluation is None else evaluation
