"""Speed profiles that leaders drive: stretches of speed records, traffic, evaluation cases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from lcc_rl.config_types import check_types
from lcc_rl.data.plausible import Plausible
from lcc_rl.data.profiles import Profiles, Split, at_step, from_records, leader_profiles
from lcc_rl.data.sources import NgsimSource
from lcc_rl.data.speed_records import read_speed_record, resample
from lcc_rl.data.units import FRAME
from lcc_rl.errors import (
    ConfigError,
    DataError,
    require_in,
    require_positive,
    require_whole,
    unknown_name,
)
from lcc_rl.functional.pattern import LARGEST


@dataclass(frozen=True)
class Case:
    """Evaluation run of a platoon behind a given stretch of a record.

    Args:
        name: name in tables and figures.
        profile: speed of the leader, one record.
        followers: number of vehicles behind the leader.
    """

    name: str
    profile: Profiles
    followers: int

    @property
    def horizon(self) -> int:
        """Steps of the run."""
        return int(self.profile.lengths[0]) - 1


@dataclass(frozen=True)
class Leaders:
    """Speed profiles of leaders, for training and for evaluation.

    Args:
        training: records to draw windows from.
        windows: held-out windows of one horizon.
        cases: named evaluation cases.
        full_length: whole held-out records.
        report: lines on what was read.
    """

    training: Profiles
    windows: Profiles
    cases: tuple[Case, ...] = ()
    full_length: tuple[Case, ...] = ()
    report: tuple[str, ...] = ()


def stretch(
    path: str,
    time_step: float,
    scale: float = 1.0,
    from_s: float | None = None,
    to_s: float | None = None,
    name: str | None = None,
    plausible: Plausible | None = None,
) -> Profiles:
    """Cut a stretch out of a record, as one profile.

    Args:
        path: see :func:`read_speed_record`.
        time_step: step of the scenario [s].
        scale: factor of the speeds (the paper drives its record "twice as slow", 0.5).
        from_s: beginning within the record, by its own time [s]; None for its start.
        to_s: end [s]; None for its end.
        name: of the profile; None makes one from the path and the times.
        plausible: see :func:`read_speed_record`.

    Raises:
        DataError: if the record cannot be read or does not cover the stretch.
        ConfigError: if the scale is not positive, the leader implausibly fast or the stretch empty.
    """
    require_positive(f"leader: {path}", scale=scale)
    time, speed = read_speed_record(path, plausible)
    begin = time[0] if from_s is None else float(from_s)
    end = time[-1] if to_s is None else float(to_s)
    if not begin < end:
        raise ConfigError(f"leader: the stretch {begin:g}–{end:g} s of {path} is empty")
    if begin < time[0] or end > time[-1] + 1e-6:
        raise DataError(
            f"{path}: covers {time[0]:g}–{time[-1]:g} s, not the stretch {begin:g}–{end:g} s; "
            "leader=record takes a record of any length"
        )
    limit = (plausible or Plausible()).max_speed
    if scale * speed.max() > limit:
        raise ConfigError(
            f"leader: {path} at scale={scale:g} drives up to {scale * speed.max():.3g} m/s, "
            f"leader.plausible.max_speed={limit:g}"
        )
    stem = Path(path).stem
    label = name or f"{stem}@{begin:g}s"
    speeds = resample(time, scale * speed, time_step, begin, end)
    return from_records([speeds], [label], [stem], time_step)


def join(parts: Sequence[Profiles]) -> Profiles:
    """Put several profiles of one step into one collection."""
    sizes = [len(part.speeds) for part in parts]
    known = [part.lengths if part.reach is None else part.reach for part in parts]
    return Profiles(
        speeds=torch.cat([part.speeds for part in parts]),
        offsets=torch.cat([part.offsets + sum(sizes[:i]) for i, part in enumerate(parts)]),
        lengths=torch.cat([part.lengths for part in parts]),
        names=tuple(name for part in parts for name in part.names),
        recordings=tuple(name for part in parts for name in part.recordings),
        time_step=parts[0].time_step,
        reach=None if all(part.reach is None for part in parts) else torch.cat(known),
    )


# Settings of a stretch and of a case in the configuration.
STRETCH = {"path", "scale", "from_s", "to_s"}
CASE = {"path", "scale", "start_s", "followers"}
WHOLE = "full length"  # a case that is a whole record, before the record's name


@dataclass(frozen=True)
class RecordLeaders:
    """Leaders that drive speed records or drive cycles from files.

    Args:
        training: training stretches by name: ``path``, ``scale``, ``from_s``, ``to_s``.
        held_out: stretches that windows for evaluation are cut from, likewise.
        cases: by name (``case_1`` for "case 1"): ``path``, ``scale``, ``start_s``, ``followers``.
        full_length: stretches driven from end to end, by name; None for none.
        least_variation: evaluation windows whose total speed change is below this are left out
            [m/s].
        path: default path of the stretches.
        plausible: thresholds of every sample before scaling, of its speed also afterwards; None for
            the defaults.

    Raises:
        ConfigError: if ``least_variation`` is negative.
    """

    training: Mapping[str, Any]
    held_out: Mapping[str, Any]
    cases: Mapping[str, Any] = field(default_factory=dict)
    full_length: Mapping[str, Any] | None = None
    least_variation: float = 2.0
    path: str | None = None
    plausible: Plausible | None = None

    def __post_init__(self) -> None:
        require_in("leader", "[0, inf)", least_variation=self.least_variation)

    def load(self, time_step: float, horizon: int, followers: int | None = None) -> Leaders:
        """Read everything.

        Args:
            time_step: step of the scenario [s].
            horizon: steps of a window and of a case.
            followers: vehicles behind a whole record; None reads neither these nor the cases.

        Raises:
            DataError: if a record cannot be used, naming the file.
            ConfigError: if an option is unknown or impossible, naming it.
        """
        training = join(self._stretches("training", self.training, time_step))
        held_out = join(self._stretches("held_out", self.held_out, time_step))
        windows = varying(held_out.windows(horizon), self.least_variation)
        report = [f"{len(windows)} held-out windows of {horizon * time_step:g} s"]
        for group, profiles in (("training", training), ("held_out", held_out)):
            for name, length in zip(profiles.names, profiles.lengths.tolist(), strict=True):
                report.append(f"{group}: {name}, {length * time_step:g} s")
        if followers is None:
            return Leaders(training, windows, report=tuple(report))
        whole = self._stretches("full_length", self.full_length or {}, time_step)
        return Leaders(
            training,
            windows,
            tuple(self._case(name, node, time_step, horizon) for name, node in self.cases.items()),
            tuple(
                Case(f"{WHOLE} {name}", profile, followers)
                for name, profile in zip(self.full_length or {}, whole, strict=True)
            ),
            tuple(report),
        )

    def _stretches(self, group: str, nodes: Mapping[str, Any], time_step: float) -> list[Profiles]:
        if not nodes and group != "full_length":
            raise ConfigError(f"leader.{group} names no record")
        return [
            stretch(time_step=time_step, **self._checked(node, f"leader.{group}.{name}", STRETCH))
            for name, node in nodes.items()
        ]

    def _case(self, name: str, node: Mapping[str, Any], time_step: float, horizon: int) -> Case:
        given = self._checked(node, f"leader.cases.{name}", CASE)
        start, followers = given.pop("start_s", 0.0), given.pop("followers", 6)
        require_in(f"leader.cases.{name}", "[0, inf)", start_s=start)
        require_whole(f"leader.cases.{name}", 1, LARGEST, followers=followers)
        end = start + horizon * time_step
        profile = stretch(time_step=time_step, from_s=start, to_s=end, **given)
        return Case(name.replace("_", " "), profile, followers)

    def _checked(self, node: Any, where: str, known: set[str]) -> dict[str, Any]:
        """Settings of a stretch or case with its path, or a ConfigError."""
        if not isinstance(node, Mapping | None):
            raise ConfigError(f"{where} must be a mapping with {', '.join(sorted(known))}")
        settings = {} if node is None else dict(node)
        for key in settings:
            if key not in known:
                raise unknown_name(f"setting of {where}", str(key), known)
        check_types(stretch, {k: x for k, x in settings.items() if k != "path" or x}, where)
        path = settings.get("path") or self.path
        if path is None:
            raise ConfigError(f"{where}.path is required: the name of a cycle or a file")
        return {**settings, "path": path, "plausible": self.plausible}


def from_trajectories(path: str | Path | Sequence[str], time_step: float) -> Profiles:
    """Read the speed profiles of the leaders in car-following episodes of NGSIM files.

    Args:
        path: one or several files of any published NGSIM layout, or a pattern; see
            :class:`lcc_rl.data.sources.NgsimSource`, whose default criteria apply.
        time_step: step of the profiles [s]; the records are interpolated to it.

    Raises:
        ConfigError: if the step is not positive and finite.
        DataError: if a file cannot be read or holds no car-following episode.
    """
    require_positive("profiles", time_step=time_step)
    episodes = NgsimSource(path).load().episodes
    return at_step(leader_profiles(episodes, FRAME), time_step)


@dataclass(frozen=True)
class TrajectoryLeaders:
    """Leaders recorded in traffic: those of car-following episodes, such as NGSIM's.

    Args:
        source: where the episodes come from, like the nodes of ``data``.
        split: how they are divided, like the nodes of ``split``.
        source_step: step of the episodes [s].
        least_variation: see :class:`RecordLeaders`.

    Raises:
        ConfigError: if a number is out of range.
    """

    source: Any
    split: Split
    source_step: float = 0.1
    least_variation: float = 2.0

    def __post_init__(self) -> None:
        require_positive("leader", source_step=self.source_step)
        require_in("leader", "[0, inf)", least_variation=self.least_variation)

    def load(self, time_step: float, horizon: int, followers: int | None = None) -> Leaders:
        """Read everything; see :meth:`RecordLeaders.load`."""
        loaded = self.source.load()
        profiles = at_step(leader_profiles(loaded.episodes, self.source_step), time_step)
        training, held_out = self.split(profiles.at_least(horizon))
        windows = varying(held_out.windows(horizon), self.least_variation)
        return Leaders(training, windows, report=tuple(loaded.report))


def varying(profiles: Profiles, least_variation: float) -> Profiles:
    """Return the records whose speed changes by at least so much in total [m/s].

    Raises:
        DataError: if there is none.
    """
    variation = [float(profiles.record(i).diff().abs().sum()) for i in range(len(profiles))]
    kept = [i for i, total in enumerate(variation) if total >= least_variation]
    if not kept:
        raise DataError(
            f"no held-out window in which the leader's speed changes by {least_variation:g} m/s; "
            "lower leader.least_variation or give another record"
        )
    return profiles.select(kept)
