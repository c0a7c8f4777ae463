"""Drive cycles and other speed records: from a file to profiles of a platoon's leader."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

import lcc_rl.assets
from lcc_rl.data.profiles import Profiles, Split, from_records, leader_profiles
from lcc_rl.errors import ConfigError, DataError, unknown_name

CYCLES = Path(lcc_rl.assets.__file__).parent / "cycles"
TIME, SPEED = "time_s", "speed_mps"


def shipped_cycles() -> list[str]:
    """Return the names of the drive cycles in the package."""
    return sorted(path.stem for path in CYCLES.glob("*.csv"))


def read_speed_record(path: str) -> tuple[np.ndarray, np.ndarray]:
    """Read a speed record of any sampling rate.

    Args:
        path: name of a shipped cycle (``udds``, ``us06``, ``wltc_3b``, ``hwfet``), or a .csv or
            .parquet file with the columns ``time_s`` [s] and ``speed_mps`` [m/s].

    Returns:
        Time [s], increasing, and speed [m/s], both ``[samples]``, float64.

    Raises:
        DataError: naming the file and the row or column at fault.
    """
    file = Path(path).expanduser()
    if not file.suffix and path in shipped_cycles():
        file = CYCLES / f"{path}.csv"
    if not file.is_file():
        raise DataError(
            f"{path}: no such file, and no shipped cycle ({', '.join(shipped_cycles())})"
        )
    try:
        frame = pd.read_parquet(file) if file.suffix == ".parquet" else pd.read_csv(file)
    except (ValueError, OSError) as error:
        raise DataError(f"{file}: not a readable table: {error}") from error
    missing = {TIME, SPEED} - set(frame.columns)
    if missing:
        raise DataError(f"{file}: lacks the column {', '.join(sorted(missing))}")
    try:
        time, speed = (frame[name].to_numpy(float) for name in (TIME, SPEED))
    except (ValueError, TypeError) as error:
        raise DataError(f"{file}: {TIME} and {SPEED} must be numbers: {error}") from error
    if len(time) < 2:
        raise DataError(f"{file}: holds {len(time)} samples, at least 2 are needed")
    for bad, words in (
        (~np.isfinite(time) | ~np.isfinite(speed), "is not a number"),
        (speed < 0, "has a negative speed"),
        (np.diff(time, prepend=-np.inf) <= 0, "does not follow the row before it in time"),
    ):
        if bad.any():
            raise DataError(f"{file}: data row {int(bad.argmax()) + 1} {words}")
    return time, speed


def resample(
    time: np.ndarray,
    speed: np.ndarray,
    time_step: float,
    begin: float | None = None,
    end: float | None = None,
) -> Tensor:
    """Interpolate a record to another step, monotonically between samples (PCHIP).

    The interpolant never overshoots its samples, so no speed becomes negative and no peak grows.

    Args:
        time: increasing [s].
        speed: [m/s].
        time_step: step wanted [s].
        begin, end: part of the record wanted [s]; None for all of it.

    Returns:
        Speeds, ``[steps]``, float32 [m/s].
    """
    begin, end = time[0] if begin is None else begin, time[-1] if end is None else end
    steps = int(np.floor((end - begin) / time_step + 1e-6)) + 1
    grid = np.minimum(begin + time_step * np.arange(steps), time[-1])
    return torch.tensor(PchipInterpolator(time, speed)(grid).clip(min=0.0), dtype=torch.float32)


@dataclass(frozen=True)
class Case:
    """One run of a platoon behind a given stretch of a record.

    Args:
        name: how tables and figures call it.
        profile: the stretch, one record.
        followers: vehicles behind the leader.
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
    """What a platoon's leader drives in training and in evaluation.

    Args:
        training: records to draw windows from.
        windows: held-out windows of one horizon.
        cases: the cases looked at closely.
        full_length: a whole held-out record; None for none.
        report: plain lines: what was read.
    """

    training: Profiles
    windows: Profiles
    cases: tuple[Case, ...] = ()
    full_length: Case | None = None
    report: tuple[str, ...] = ()


def stretch(
    path: str,
    time_step: float,
    scale: float = 1.0,
    from_s: float | None = None,
    to_s: float | None = None,
    name: str | None = None,
) -> Profiles:
    """Cut a stretch out of a record, as one profile.

    Args:
        path: see :func:`read_speed_record`.
        time_step: step of the scenario [s].
        scale: factor of the speeds (the paper drives its record "twice as slow", 0.5).
        from_s: beginning within the record, by its own time [s]; None for its start.
        to_s: end [s]; None for its end.
        name: of the profile; None makes one from the path and the times.

    Raises:
        DataError: if the record cannot be read or does not cover the stretch.
        ConfigError: if the scale is not positive or the stretch empty.
    """
    if not scale > 0:
        raise ConfigError(f"leader: scale of {path} must be positive, got {scale}")
    time, speed = read_speed_record(path)
    begin = time[0] if from_s is None else float(from_s)
    end = time[-1] if to_s is None else float(to_s)
    if not begin < end:
        raise ConfigError(f"leader: the stretch {begin:g}–{end:g} s of {path} is empty")
    if begin < time[0] or end > time[-1] + 1e-6:
        raise DataError(
            f"{path}: covers {time[0]:g}–{time[-1]:g} s, not the stretch {begin:g}–{end:g} s"
        )
    stem = Path(path).stem
    label = name or f"{stem}@{begin:g}s"
    speeds = resample(time, scale * speed, time_step, begin, end)
    return from_records([speeds], [label], [stem], time_step)


def join(profiles: list[Profiles]) -> Profiles:
    """Put several profiles into one collection."""
    return from_records(
        [p.record(i) for p in profiles for i in range(len(p))],
        [name for p in profiles for name in p.names],
        [recording for p in profiles for recording in p.recordings],
        profiles[0].time_step,
    )


# What a stretch may say in the configuration, beside the settings of a case.
STRETCH = {"path", "scale", "from_s", "to_s"}
CASE = {"path", "scale", "start_s", "followers"}


@dataclass(frozen=True)
class RecordLeaders:
    """Leaders that drive speed records or drive cycles from files.

    Args:
        training: stretches to train on, by name: ``path``, ``scale``, ``from_s``, ``to_s``.
            A shared record need not be repeated: see ``path``.
        held_out: stretches that windows for evaluation are cut from, likewise.
        cases: by name (``case_1`` for "case 1"): ``path``, ``scale``, ``start_s``, ``followers``.
        full_length: a stretch driven from end to end; None for none.
        least_variation: windows whose leader changes its speed by less in total are left out:
            nothing happens in them [m/s].
        path: record of the stretches that name none.
    """

    training: Mapping[str, Any]
    held_out: Mapping[str, Any]
    cases: Mapping[str, Any] = field(default_factory=dict)
    full_length: Mapping[str, Any] | None = None
    least_variation: float = 2.0
    path: str | None = None

    def load(self, time_step: float, horizon: int, followers: int) -> Leaders:
        """Read everything.

        Args:
            time_step: step of the scenario [s].
            horizon: steps of a window and of a case.
            followers: vehicles of windows and of the full length.

        Raises:
            DataError, ConfigError: naming the file or option at fault.
        """
        parts = {
            group: [
                stretch(
                    time_step=time_step,
                    **self._checked(node, f"leader.{group}.{name}", STRETCH),
                )
                for name, node in stretches.items()
            ]
            for group, stretches in (("training", self.training), ("held_out", self.held_out))
        }
        for group, found in parts.items():
            if not found:
                raise ConfigError(f"leader.{group} names no record")
        whole = None
        if self.full_length is not None:
            node = self._checked(self.full_length, "leader.full_length", STRETCH)
            whole = Case("full length", stretch(time_step=time_step, **node), followers)
        training, held_out = join(parts["training"]), join(parts["held_out"])
        windows = lively(held_out.windows(horizon), self.least_variation)
        report = [f"{len(windows)} held-out windows of {horizon * time_step:g} s"]
        report += [
            f"{group}: {p.names[0]}, {int(p.lengths[0]) * time_step:g} s"
            for group, found in parts.items()
            for p in found
        ]
        return Leaders(
            training,
            windows,
            tuple(self._case(name, node, time_step, horizon) for name, node in self.cases.items()),
            whole,
            tuple(report),
        )

    def _case(self, name: str, node: Mapping[str, Any], time_step: float, horizon: int) -> Case:
        given = self._checked(node, f"leader.cases.{name}", CASE)
        start, followers = float(given.pop("start_s", 0.0)), int(given.pop("followers", 6))
        if followers < 1:
            raise ConfigError(f"leader.cases.{name}.followers must be at least 1, got {followers}")
        end = start + horizon * time_step
        profile = stretch(time_step=time_step, from_s=start, to_s=end, **given)
        return Case(name.replace("_", " "), profile, followers)

    def _checked(self, node: Any, where: str, known: set[str]) -> dict[str, Any]:
        """Return a stretch as a dictionary with a path.

        Raises:
            ConfigError: if it has none or holds an unknown key.
        """
        settings = {} if node is None else dict(node)
        for key in settings:
            if key not in known:
                raise unknown_name(f"setting of {where}", str(key), known)
        path = settings.get("path") or self.path
        if path is None:
            raise ConfigError(f"{where}.path is required: the name of a cycle or a file")
        return {**settings, "path": path}


@dataclass(frozen=True)
class TrajectoryLeaders:
    """Leaders recorded in traffic: those of car-following episodes, such as NGSIM's.

    Args:
        source: where the episodes come from, like the nodes of ``data``.
        split: how they are divided, like the nodes of ``split``.
        source_step: step of the episodes [s].
        least_variation: see :class:`RecordLeaders`.
    """

    source: Any
    split: Split
    source_step: float = 0.1
    least_variation: float = 2.0

    def load(self, time_step: float, horizon: int, followers: int) -> Leaders:
        """Read everything; see :meth:`RecordLeaders.load`."""
        loaded = self.source.load()
        profiles = at_step(leader_profiles(loaded.episodes, self.source_step), time_step)
        training, held_out = self.split(profiles.at_least(horizon))
        windows = lively(held_out.windows(horizon), self.least_variation)
        return Leaders(training, windows, report=tuple(loaded.report))


def at_step(profiles: Profiles, time_step: float) -> Profiles:
    """Interpolate every record to another step."""
    records = []
    for index in range(len(profiles)):
        speed = profiles.record(index).numpy().astype(float)
        records.append(resample(np.arange(len(speed)) * profiles.time_step, speed, time_step))
    return from_records(records, profiles.names, profiles.recordings, time_step)


def lively(profiles: Profiles, least_variation: float) -> Profiles:
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
