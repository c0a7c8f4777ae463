"""Leaders of a study: speed records, tables of drives, recorded traffic and mixtures."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field

from lcc_rl.data.columns import check_map
from lcc_rl.data.grid import BRIDGE_S, LongestHole
from lcc_rl.data.plausible import Plausible
from lcc_rl.data.profiles import (
    EvaluationShare,
    Profiles,
    at_step,
    described_records,
    from_records,
    joined,
    leader_profiles,
    no_profiles,
    resample,
)
from lcc_rl.data.sources import find_files
from lcc_rl.data.speed_records import DRIVE_COLUMNS, DRIVE_FIELDS, read_drives, read_speed_record
from lcc_rl.data.trajectories import FRAME, listed
from lcc_rl.errors import (
    ConfigError,
    DataError,
    raised_as,
    require,
    require_known,
    require_positive,
)
from lcc_rl.settings import Count, NonNegative, Number, Positive, Settings, parse

LISTED = 8  # most names in a line
WHOLE_RECORD = "full length"  # name of a case with a whole record, before the record's name
StretchNodes = Mapping[str, Mapping[str, Any] | None]


@dataclass(frozen=True, eq=False)
class Case:
    """Evaluation case of a platoon behind a given stretch of a record.

    Args:
        name: name in tables and figures.
        profile: speed of the leader; one record.
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
        training: records from which windows are drawn.
        windows: held-out windows of one horizon.
        cases: named evaluation cases.
        full_length: whole held-out records.
        report: lines on the data.
        left_out: number of windows that :func:`varying` leaves out, by source.
    """

    training: Profiles
    windows: Profiles
    cases: tuple[Case, ...] = ()
    full_length: tuple[Case, ...] = ()
    report: tuple[str, ...] = ()
    left_out: Mapping[str, int] = field(default_factory=dict)


class Stretch(Settings):
    """A part of a speed record."""

    path: str | None = None  # see lcc_rl.data.speed_records.read_speed_record
    scale: Positive = 1.0  # factor on the speeds (the paper's "twice as slow" is 0.5)
    from_s: Number | None = None  # start in the record's time [s]; None: start of the record
    to_s: Number | None = None  # end [s]; None: end of the record


class CaseSettings(Settings):
    """An evaluation case: a part of a speed record, one horizon long."""

    path: str | None = None
    scale: Positive = 1.0
    start_s: NonNegative = 0.0
    followers: Count = 6


def stretch(
    path: str,
    time_step: float,
    scale: float = 1.0,
    from_s: float | None = None,
    to_s: float | None = None,
    plausible: Plausible | None = None,
) -> Profiles:
    """Cut a stretch out of a record, as one profile.

    Args:
        path: see :func:`lcc_rl.data.speed_records.read_speed_record`.
        time_step: step of the scenario [s].
        scale, from_s, to_s: see :class:`Stretch`.
        plausible: thresholds of every sample, also for the scaled speed.

    Raises:
        DataError: if the record cannot be read or does not cover the stretch.
        ConfigError: if the leader is implausibly fast or the stretch empty.
    """
    time, speed = read_speed_record(path, plausible)
    begin = time[0] if from_s is None else float(from_s)
    end = time[-1] if to_s is None else float(to_s)
    require(begin < end, f"leader: the stretch {begin:g}–{end:g} s of {path} is empty")
    if begin < time[0] or end > time[-1] + 1e-6:
        raise DataError(
            f"{path}: covers {time[0]:g}–{time[-1]:g} s, not the stretch {begin:g}–{end:g} s; "
            "leader=record accepts records of any length"
        )
    limit = (plausible or Plausible()).max_speed
    fast = f"leader: {path} at scale={scale:g} drives up to {scale * speed.max():.3g} m/s, "
    require(scale * speed.max() <= limit, f"{fast}leader.plausible.max_speed={limit:g}")
    stem = Path(path).stem
    speeds = resample(time, scale * speed, time_step, begin, end)
    return from_records([speeds], [f"{stem}@{begin:g}s"], [stem], time_step, starts=[begin])


class RecordLeaders(Settings):
    """Leaders that follow speed records or drive cycles from files."""

    training: StretchNodes  # stretches by name, see Stretch
    held_out: StretchNodes  # stretches from which windows for evaluation are cut
    cases: StretchNodes = Field(default_factory=dict)  # ``case_1`` for "case 1", see CaseSettings
    full_length: StretchNodes | None = None  # stretches driven as a whole
    # Evaluation windows whose total speed change is below this are left out [m/s].
    least_variation: NonNegative = 2.0
    path: str | None = None  # file of stretches without a path
    plausible: Plausible | None = None  # None: the defaults

    def load(self, time_step: float, horizon: int, followers: int | None = None) -> Leaders:
        """Read all records.

        Args:
            time_step: step of the scenario [s].
            horizon: steps of a window and of a case.
            followers: vehicles behind a whole record; None: neither whole records nor cases.

        Raises:
            DataError: naming the file of an unusable record.
            ConfigError: naming an unknown or impossible option.
        """
        groups: dict[str, list[Profiles]] = {}
        for group in ("training", "held_out"):
            groups[group] = self._stretches(group, getattr(self, group), time_step)
            require(groups[group], f"leader.{group} names no record")
        every = joined(groups["held_out"]).windows(horizon)
        windows, left_out, lines = varying(every, self.least_variation)
        report = [f"{len(windows)} held-out windows of {horizon * time_step:g} s", *lines] + [
            f"{group}: {line}"
            for group, x in groups.items()
            for line in described_records(joined(x), horizon)
        ]
        training = joined(groups["training"])
        leaders = Leaders(training, windows, report=tuple(report), left_out=left_out)
        if followers is None:
            return leaders
        cases = []
        for name, node in self.cases.items():
            x = self._parsed(CaseSettings, node, f"leader.cases.{name}")
            end = x.start_s + horizon * time_step
            profile = self._cut(x, f"leader.cases.{name}", time_step, x.start_s, end)
            cases.append(Case(name.replace("_", " "), profile, x.followers))
        wholes = self.full_length or {}
        profiles = self._stretches("full_length", wholes, time_step)
        full_length = (
            Case(f"{WHOLE_RECORD} {name}", profile, followers)
            for name, profile in zip(wholes, profiles, strict=True)
        )
        return replace(leaders, cases=tuple(cases), full_length=tuple(full_length))

    def _stretches(self, group: str, nodes: StretchNodes, time_step: float) -> list[Profiles]:
        profiles = []
        for name, node in nodes.items():
            where = f"leader.{group}.{name}"
            x = self._parsed(Stretch, node, where)
            profiles.append(self._cut(x, where, time_step, x.from_s, x.to_s))
        return profiles

    def _cut(self, x: Any, where: str, time_step: float, begin: Any, end: Any) -> Profiles:
        with raised_as(DataError, where, DataError):
            return stretch(x.path, time_step, x.scale, begin, end, self.plausible)

    def _parsed(self, kind: type[Settings], node: Mapping[str, Any] | None, where: str) -> Any:
        """Return settings of a stretch or case; it or ``self`` has a path."""
        settings: Any = parse(kind, node or {}, where)
        settings.path = settings.path or self.path
        require(settings.path, f"{where}.path is required: the name of a cycle or a file")
        return settings


class TrajectoryLeaders(Settings):
    """Leaders recorded in traffic: those of car-following episodes, such as NGSIM's."""

    source: Any  # source of the episodes, like the nodes of ``data``
    split: Callable  # their division, like the nodes of ``split``
    least_variation: NonNegative = 2.0  # see RecordLeaders

    def load(self, time_step: float, horizon: int, followers: int | None = None) -> Leaders:
        """Read all records; see :meth:`RecordLeaders.load`."""
        loaded = self.source.load()
        profiles = at_step(leader_profiles(loaded.episodes, FRAME), time_step)
        training, held_out = self.split(profiles.at_least(horizon))
        windows, left_out, lines = varying(held_out.windows(horizon), self.least_variation)
        lines = [*described_records(profiles, horizon), *lines]
        report = (*loaded.report, *lines, *apart(training, held_out, loaded.vehicles))
        return Leaders(training, windows, report=report, left_out=left_out)


def apart(
    training: Profiles, held_out: Profiles, vehicles: Mapping[int, str] | None = None
) -> list[str]:
    """Return a line on the held-out recordings or vehicles, if there are any.

    Args:
        training, held_out: profiles of both sides.
        vehicles: names of the numbered vehicles, if the file names them.
    """

    def leader(name: str) -> str:
        recording, _, number = name.rsplit("@", 1)[0].rpartition("/")
        return f"{recording}/{(vehicles or {}).get(int(number), number)}"

    for kind, evaluated, trained in (
        ("recordings", held_out.recordings, training.recordings),
        ("vehicles", [*map(leader, held_out.names)], [*map(leader, training.names)]),
    ):
        if trained and not set(evaluated) & set(trained):
            names = list(dict.fromkeys(evaluated))
            suffix = f" … ({len(names)})" if len(names) > LISTED else ""
            return [f"held out: {kind} {', '.join(names[:LISTED])}{suffix}"]
    return []


class DriveLeaders(Settings):
    """Leaders that follow the speed records of a table.

    Several drives are divided by name: whether a drive is held out depends only on a SHA-256 hash
    of its name, or of the part that drives of one day share, so it is on the same side in every
    file. Of a single record the end is held out.
    """

    # One or several .csv or .parquet files, a pattern or a folder. A file without the column of
    # drives is one drive with the file's name; a native OpenACC file is that of its first car.
    path: str | Sequence[str]
    # Names of its columns: ``drive``, the name of the record, null for a table with one record;
    # ``time``, evenly spaced within a record; ``speed``.
    columns: Mapping[str, str | None] = Field(default_factory=lambda: dict(DRIVE_COLUMNS))
    units: Mapping[str, str] = Field(default_factory=dict)  # such as {speed: km/h}; else SI
    evaluation_share: EvaluationShare = 1 / 3  # of the names, or of the single record
    # Regular expression; drives with names that begin with the same match are on the same side.
    together: str | None = None
    tuning: bool = False  # leave out the evaluation's part and divide the rest again
    least_variation: NonNegative = 2.0  # see RecordLeaders
    fastest: Positive | None = None  # largest mean speed of the leader in held-out windows [m/s]
    plausible: Plausible | None = None  # None: the defaults
    # Width of a moving average of the speeds, before samples are checked; 0: none [s].
    average_s: Annotated[float, Field(ge=0.0, lt=600.0)] = 0.0
    bridge_s: LongestHole = BRIDGE_S  # longer holes divide records [s]

    def validate(self) -> None:
        self.columns = {**DRIVE_COLUMNS, **self.columns}
        check_map(DRIVE_FIELDS, self.columns, self.units, "leader")
        message = "leader.tuning=true leaves nothing to tune on: evaluation_share is 1"
        require(not self.tuning or self.evaluation_share < 1, message)
        message = "leader.together divides drives by name; the table holds one record"
        require(not self.together or self.columns["drive"] is not None, message)
        with raised_as(ConfigError, f"leader.together={self.together}", re.error):
            re.compile(self.together or "")

    def load(self, time_step: float, horizon: int, followers: int | None = None) -> Leaders:
        """Read all records; see :meth:`RecordLeaders.load`."""
        single = self.columns["drive"] is None
        profiles, report = self.profiles(time_step)
        message = (
            "leader.columns.grade: only lcc-rl energy uses it; +slope=hills gives roads grades"
        )
        require(profiles.grades is None, message)
        drives = {*profiles.recordings}
        per_file = 1 < len(drives) == len(find_files(self.path))  # a file is a drive
        if per_file and self.together and len({*map(self._family, drives)}) == 1:
            report.append(f"each file is a trip: leader.together={self.together} is in all names")
            self = copy(self)  # self is not changed
            self.together = None
        divide = self._by_time if single else self._by_name
        training, held_out = no_profiles(time_step), profiles
        if self.evaluation_share < 1:
            training, held_out = divide(profiles)
            if self.tuning:
                training, held_out = divide(training, again=True)
            training = training.at_least(horizon)
        every = held_out.windows(horizon)
        windows, left_out, lines = varying(every, self.least_variation, self.fastest)
        used = records_of(windows)
        if not single:  # parts of one drive count as one in intervals, too
            windows = replace(windows, recordings=tuple(map(self._family, windows.recordings)))
        by = "at the end" if single else f"by name (a hash, {self.evaluation_share:.2g} each)"
        count = f"{len(used)} of {len(profiles)} record(s) for evaluation, {by}: "
        line = f"{self.path}: {count}{', '.join(used)}"
        report += [*described_records(profiles, horizon), *lines, line]
        return Leaders(training, windows, report=tuple(report), left_out=left_out)

    def profiles(self, time_step: float) -> tuple[Profiles, list[str]]:
        """Read all records, see :func:`lcc_rl.data.speed_records.read_drives`."""
        options = (self.plausible, self.units, self.average_s, self.bridge_s)
        return read_drives(self.path, self.columns, time_step, *options)

    def _by_name(self, profiles: Profiles, again: bool = False) -> tuple[Profiles, Profiles]:
        """Divide drives by a hash of their names; twice for tuning."""
        share = self.evaluation_share
        hashes = np.array([hashed(self._family(name)) for name in profiles.recordings])
        if again:  # the other hashes lie in share…1
            hashes = (hashes - share) / (1 - share)
        held = hashes < share
        if held.all() or not held.any():
            side = "evaluation" if held.any() else "training"
            trips = len({self._family(name) for name in profiles.recordings})
            raise DataError(
                f"{self.path}: the names of all {len(held)} drives ({trips} apart by "
                f"leader.together={self.together}) fall on the side of {side}; change "
                "leader.evaluation_share (1: all for evaluation) or give more drives; "
                "leader.together=null divides parts of one trip, too"
            )
        return profiles.select(np.flatnonzero(~held)), profiles.select(np.flatnonzero(held))

    def _family(self, name: str) -> str:
        """Return the part of a name that determines the side of its drive."""
        if self.together is None:
            return name
        match = re.match(self.together, name)
        if not match or not match.group():
            raise DataError(f"{self.path}: drive {name!r} does not begin with {self.together!r}")
        return match.group()

    def _by_time(self, profiles: Profiles, again: bool = False) -> tuple[Profiles, Profiles]:
        """Divide a single record, or the parts of one, in order of time; its end is held out."""
        total = int(profiles.lengths.sum())
        cut = total - round(self.evaluation_share * total)
        sides: tuple[list[Any], list[Any]] = [], []
        for index, name in enumerate(profiles.names):
            record, split = profiles.record(index), max(cut, 0)
            since = split * profiles.time_step
            for side, piece, at in zip(
                sides, (record[:split], record[split:]), (0.0, since), strict=True
            ):
                label = f"{name}+{at:g}s" if at else name
                row = (piece, label, profiles.recordings[index], profiles.starts[index] + at)
                side += [row] if len(piece) > 1 else []
            cut -= len(record)
        if not all(sides):
            raise DataError(f"{self.path}: {total} samples cannot be divided")
        step = profiles.time_step
        first, last = (
            from_records(x, y, z, step, starts=starts)
            for x, y, z, starts in (zip(*side, strict=True) for side in sides)
        )
        return first, last


def records_of(windows: Profiles) -> list[str]:
    """Return the names of the records from which windows are cut."""
    return list(dict.fromkeys(name.rpartition("+")[0] for name in windows.names))


def varying(
    windows: Profiles, least: float, fastest: float | None = None
) -> tuple[Profiles, dict[str, int], list[str]]:
    """Return the windows with a total change of speed of at least ``least``.

    Args:
        windows: held-out windows.
        least: sum of the changes of speed [m/s].
        fastest: largest mean speed of a window [m/s]; None: no limit.

    Returns:
        The windows, the number of those left out by source, here ``""``, and a line on these and on
        the records without a window, if any.

    Raises:
        DataError: if there is none.
    """
    records = [windows.record(index) for index in range(len(windows))]
    indices = [
        index
        for index, record in enumerate(records)
        if float(record.diff().abs().sum()) >= least
        and (fastest is None or float(record.mean()) <= fastest)
    ]
    if not indices:
        slow = "" if fastest is None else f" and whose mean is at most leader.fastest={fastest:g}"
        raise DataError(
            f"no held-out window in which the leader's speed changes by {least:g} m/s{slow}; "
            "lower leader.least_variation, raise scenario.horizon or give another record"
        )
    kept, count = windows.select(indices), len(windows) - len(indices)
    line = f"left out {count} of {len(windows)} held-out windows, in which the leader's speed "
    line += f"changes by less than leader.least_variation={least:g} m/s"
    line += "" if fastest is None else f" or its mean exceeds leader.fastest={fastest:g}"
    left = set(records_of(kept))
    gone = [name for name in records_of(windows) if name not in left]
    line += f"; no window is left of {len(gone)} record(s): {listed(gone)}" * bool(gone)
    return kept, {"": count}, [line] * bool(count)


def hashed(name: str) -> float:
    """Return a number in [0, 1) that depends on a name only, the same on every machine.

    The prefix makes it independent of other divisions by the plain hash of the same names.
    """
    digest = hashlib.sha256(f"lcc_rl held out: {name}".encode()).digest()
    return int.from_bytes(digest[:6], "big") / 2**48


class Mixture:
    """Leaders from several sources.

    Training draws a source by its weight, then one of its records. Evaluation uses the windows of
    all sources.

    Args:
        weights: relative frequency of a source in training, by name; 1 by default.
        **sources: sources by name, each like a node of ``leader``.

    Raises:
        ConfigError: if there is no source, or a weight is not positive or of no source.
    """

    def __init__(self, weights: Mapping[str, float] | None = None, **sources: Any) -> None:
        require(sources, "leader: a mixture names no source of leaders")
        for name, source in sources.items():
            message = f"leader.{name} must be a source of leaders, got {source!r}; "
            message += f"use +leader@leader.{name}=…"
            require(callable(getattr(source, "load", None)), message)
        require_known("source in leader.weights", weights or (), sources)
        for name, weight in (weights or {}).items():
            require_positive(f"leader.weights.{name}", weight)
        self.sources, self.weights = sources, dict(weights or {})

    def load(self, time_step: float, horizon: int, followers: int | None = None) -> Leaders:
        """Read all records; see :meth:`RecordLeaders.load`."""
        loaded: dict[str, Leaders] = {}
        for name, source in self.sources.items():
            with raised_as(DataError, f"leader.{name}", DataError):
                loaded[name] = source.load(time_step, horizon, followers)
        # A source for evaluation only has no training records.
        learned = {name: one for name, one in loaded.items() if len(one.training)}
        trainings = [one.training.at_least(horizon) for one in learned.values()]
        training = joined(trainings) if trainings else next(iter(loaded.values())).training
        shares = []
        for name, records in zip(learned, trainings, strict=True):
            even = torch.ones(len(records), dtype=torch.float64) / len(records)
            shares.append(self.weights.get(name, 1.0) * even)
        windows = joined([one.windows for one in loaded.values()])
        names = tuple(name for name, one in loaded.items() for _ in range(len(one.windows)))
        left_out = {name: sum(one.left_out.values()) for name, one in loaded.items()}
        return Leaders(
            replace(training, weights=torch.cat(shares) if shares else None),
            replace(windows, sources=names),
            tuple(case for one in loaded.values() for case in one.cases),
            tuple(case for one in loaded.values() for case in one.full_length),
            tuple(
                type(line)(f"{name}: {line}") for name, one in loaded.items() for line in one.report
            ),
            left_out,
        )
