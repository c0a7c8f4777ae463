"""The leader: plays back a recorded speed profile chosen at reset."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Unbounded

from lcc_rl.data.profiles import Profiles
from lcc_rl.errors import ConfigError
from lcc_rl.functional.random import choose, stream_id, uniform
from lcc_rl.pieces.base import SEED, STEP, Transition, following


class RecordedLeader(Transition):
    """Base of leaders: draws a window of a speed profile at reset.

    The profile is random by the episode's seed, or given to ``env.reset`` as ``("leader",
    "profile")`` and ``("leader", "start")``, one per episode: an id, or a list paired with
    drivers.

    Args:
        profiles: the records to play; each must hold at least ``horizon`` steps.
        horizon: steps per episode.
        time_step: duration of a step [s].
        start: ``"random"`` draws where in the record the window begins, ``"first"`` begins at
            its first sample.
        profile: the record to play in every episode; None draws one for each.
        name: namespace of the written entries.
        reads, writes: entries read and written besides those of every leader.

    Raises:
        ConfigError: if ``start`` or ``profile`` is unknown.
        DataError: if no record is as long as the horizon.
    """

    speeds: Tensor
    offsets: Tensor
    starts: Tensor

    def __init__(
        self,
        profiles: Profiles,
        horizon: int,
        time_step: float,
        start: str = "random",
        profile: int | None = None,
        name: str = "leader",
        reads: Sequence[NestedKey] = (),
        writes: Sequence[NestedKey] = (),
    ) -> None:
        if start not in ("random", "first"):
            raise ConfigError(f"leader start must be 'random' or 'first', got {start!r}")
        chosen = [(name, "profile"), (name, "start")]
        super().__init__(
            reads=[*chosen, (name, "speed"), following(STEP), *reads],
            writes=[(name, "speed"), (name, "acceleration"), *writes],
            constants=chosen,
            choices=chosen,
        )
        profiles = profiles.at_least(horizon)
        if profile is not None and not 0 <= profile < len(profiles):
            raise ConfigError(f"{name}.profile must lie in 0…{len(profiles) - 1}, got {profile}")
        self.name, self.start, self.time_step = name, start, time_step
        self.profile = profile
        self.profile_stream = stream_id(f"{name}.profile")
        self.start_stream = stream_id(f"{name}.start")
        self.register_buffer("speeds", profiles.speeds)
        self.register_buffer("offsets", profiles.offsets)
        self.register_buffer("starts", profiles.lengths - horizon)

    def constant_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Any, Any]:
        spec = Unbounded(shape=(*batch, 1), dtype=torch.int64, device=device)
        return {key: spec.clone() for key in self.constants}

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        profile, first = self._window(given, start.get(SEED))
        speed = self.speeds[self.offsets[profile] + first]
        start.set(self.choices[0], profile)
        start.set(self.choices[1], first)
        start.set((self.name, "speed"), speed)
        start.set((self.name, "acceleration"), torch.zeros_like(speed))

    def _window(self, given: TensorDictBase, seed: Tensor) -> tuple[Tensor, Tensor]:
        """Return the profile and its first sample, as given or else drawn."""
        profile, first = given.get(self.choices[0], None), given.get(self.choices[1], None)
        if profile is None and self.profile is not None:
            profile = torch.full_like(seed, self.profile)
        elif profile is None:
            profile = choose(seed, len(self.offsets), self.profile_stream)
        elif bool(((profile < 0) | (profile >= len(self.offsets))).any()):
            raise ConfigError(f"profile ids must lie in 0…{len(self.offsets) - 1}, got {profile}")
        if first is None:
            first = torch.zeros_like(profile)
            if self.start == "random":
                first = choose(seed, self.starts[profile], self.start_stream)
        return profile, first


class NGSIMLeader(RecordedLeader):
    """Plays back a window of a speed profile (the PV of the ALCC scenarios).

    Writes ``(name, "speed")`` [m/s] and ``(name, "acceleration")`` [m/s²], shape ``[*batch, 1]``.

    Args:
        profiles, horizon, time_step, start, profile, name: see :class:`RecordedLeader`.
    """

    def __init__(
        self,
        profiles: Profiles,
        horizon: int,
        time_step: float,
        start: str = "random",
        profile: int | None = None,
        name: str = "leader",
    ) -> None:
        super().__init__(profiles, horizon, time_step, start, profile, name)

    def compute(
        self, profile: Tensor, start: Tensor, speed: Tensor, step: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return speed and acceleration at the moment reached."""
        reached = self.speeds[self.offsets[profile] + start + step]
        return reached, (reached - speed) / self.time_step


class PlatoonLeader(RecordedLeader):
    """Plays back a window of a speed record, in training with perturbed speeds (HCFS).

    A perturbed leader drives max(0, (1 + p c) v + p A sin(2π t/τ + φ)): every episode has its own
    c ~ U(−0.2, 0.2), A ~ U(0, 1) m/s, τ ~ U(4, 20) s and φ, all by its seed.

    Writes ``(name, "speed")`` [m/s], ``(name, "acceleration")`` [m/s²], the backward difference,
    and ``(name, "next_speed")`` [m/s], the speed one step ahead, which only an ``oracle`` may
    look at; shape ``[*batch, 1]``.

    Args:
        profiles, horizon, time_step, start, profile, name: see :class:`RecordedLeader`.
        perturbation: p, 0 for the record as it is.

    Raises:
        ConfigError: if ``perturbation`` is negative, or as :class:`RecordedLeader`.
    """

    lengths: Tensor

    def __init__(
        self,
        profiles: Profiles,
        horizon: int,
        time_step: float,
        start: str = "random",
        profile: int | None = None,
        perturbation: float = 0.0,
        name: str = "leader",
    ) -> None:
        if not perturbation >= 0:
            raise ConfigError(f"{name}.perturbation must not be negative, got {perturbation}")
        super().__init__(
            profiles, horizon, time_step, start, profile, name, [SEED], [(name, "next_speed")]
        )
        self.perturbation = perturbation
        self.streams = [stream_id(f"{name}.perturbation.{part}") for part in "cAtp"]
        self.register_buffer("lengths", profiles.at_least(horizon).lengths)

    def compute(
        self, profile: Tensor, start: Tensor, speed: Tensor, step: Tensor, seed: Tensor
    ) -> tuple[Tensor, ...]:
        """Return speed, acceleration and next speed at the moment reached."""
        reached = self.speed_at(profile, start, step, seed)
        following_speed = self.speed_at(profile, start, step + 1, seed)
        return reached, (reached - speed) / self.time_step, following_speed

    def speed_at(self, profile: Tensor, start: Tensor, step: Tensor, seed: Tensor) -> Tensor:
        """Return the speed at a step of the episode; a record that is over keeps its last."""
        sample = torch.minimum(start + step, self.lengths[profile] - 1)
        speed = self.speeds[self.offsets[profile] + sample]
        if not self.perturbation:
            return speed
        share, height, period, phase = (uniform(seed, 0, stream) for stream in self.streams)
        angle = 2 * math.pi * (step * self.time_step / (4.0 + 16.0 * period) + phase)
        factor = 1.0 + self.perturbation * 0.4 * (share - 0.5)
        return (factor * speed + self.perturbation * height * angle.sin()).clamp(min=0.0)

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        super().begin(given, start)
        seed, still = start.get(SEED), torch.zeros_like(start.get(SEED))
        profile, first = (start.get(key) for key in self.choices)
        start.set((self.name, "speed"), self.speed_at(profile, first, still, seed))
        start.set((self.name, "next_speed"), self.speed_at(profile, first, still + 1, seed))
