"""The leader: plays back a recorded speed profile chosen at reset."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.errors import ConfigError
from lcc_rl.functional.random import choose, stream_id, uniform
from lcc_rl.pieces.base import SEED, STEP, Entry, StepTransform, next_key, require_option
from lcc_rl.pieces.views import EPISODE
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative

PERTURBATION = [stream_id(f"leader.perturbation.{letter}") for letter in "cAtp"]
PROFILE, PROFILE_START = ("leader", "profile"), ("leader", "start")
LEADER_SPEED, LEADER_ACCELERATION, NEXT_SPEED = (
    ("leader", name) for name in ("speed", "acceleration", "next_speed")
)


def perturbed(speed: Tensor, seconds: Tensor, seed: Tensor, size: float) -> Tensor:
    """Return a perturbed leader's speeds [m/s], see :class:`NGSIMLeader`.

    Args:
        speed: v of the record, any shape [m/s].
        seconds: t, the time since the start of the episode, of a shape that broadcasts [s].
        seed: the episode's seed.
        size: p.
    """
    share, height, period, phase = (uniform(seed, 0, stream) for stream in PERTURBATION)
    angle = 2 * math.pi * (seconds / (4.0 + 16.0 * period) + phase)
    factor = 1.0 + size * 0.4 * (share - 0.5)
    return (factor * speed + size * height * angle.sin()).clamp(min=0.0)


class NGSIMLeader(StepTransform):
    """Plays back a window of a speed record ahead of the string (PV in ALCC, leader in HCFS).

    The record and its first sample are drawn by the episode's seed, or given to ``env.reset`` as
    ``("leader", "profile")`` and ``("leader", "start")``, one number per episode.

    A perturbed leader drives max(0, (1 + p c) v + p A sin(2π t/τ + φ)). Every episode draws
    c ~ U(−0.2, 0.2), A ~ U(0, 1) m/s, τ ~ U(4, 20) s and φ by its seed.
    """

    start: Literal["random", "first"] = "random"  # sample of the record at which a window begins
    profile: int | None = None  # the record of every episode; None: one is drawn per episode
    perturbation: NonNegative = 0.0  # p; 0 in evaluation
    foresight: bool = False  # write the next speed, too

    of_training = ("start", "perturbation")
    steady = True
    role = EPISODE
    keeps = (
        Entry(PROFILE, "–", "id of the speed record that the leader plays", option=True),
        Entry(PROFILE_START, "–", "sample of the record at which the episode begins", option=True),
    )
    writes = (
        Entry(LEADER_SPEED, "m/s", "speed of the leader"),
        Entry(LEADER_ACCELERATION, "m/s²", "backward difference of the leader's speed"),
        Entry(NEXT_SPEED, "m/s", "speed of the leader one step ahead, for oracles"),
    )
    more: ClassVar[tuple[Entry, ...]] = ()  # entries that a subclass writes
    speeds: ClassVar[Tensor]
    offsets: ClassVar[Tensor]
    lengths: ClassVar[Tensor]
    starts: ClassVar[Tensor]
    shares: ClassVar[Tensor | None]

    def setup(self, world: World) -> None:
        """Select the records that are as long as the horizon, and their weights if they have any.

        Raises:
            DataError: if no record is as long as the horizon.
        """
        reads = [PROFILE, PROFILE_START, LEADER_SPEED, next_key(STEP), SEED]
        self.declare(world, reads, [*self.writes[: 2 + self.foresight], *self.more])
        self.perturbed = world.deviation(self.perturbation)
        profiles = world.given("profiles", self.title).at_least(world.horizon)
        last = len(profiles) - 1
        if self.profile is not None and not 0 <= self.profile <= last:
            raise ConfigError(f"leader.profile must lie in 0…{last}, got {self.profile}")
        self.time_step, self.names = world.time_step, profiles.names
        self.profile_stream = stream_id("leader.profile")
        self.start_stream = stream_id("leader.start")
        self.register_buffer("speeds", profiles.speeds)
        self.register_buffer("offsets", profiles.offsets)
        self.register_buffer("lengths", profiles.lengths)
        self.register_buffer("starts", profiles.lengths - world.horizon)
        shares = None  # cumulative shares of the draws
        if profiles.weights is not None:
            shares = profiles.weights.cumsum(0) / profiles.weights.sum()
        self.register_buffer("shares", shares)

    def compute(
        self, profile: Tensor, first: Tensor, speed: Tensor, step: Tensor, seed: Tensor
    ) -> tuple[Tensor, ...]:
        """Return speed, acceleration and next speed after the step."""
        reached = self.speed_at(profile, first, step, seed)
        motion = (reached, (reached - speed) / self.time_step)
        if not self.foresight:
            return motion
        return (*motion, self.speed_at(profile, first, step + 1, seed))

    def speed_at(self, profile: Tensor, first: Tensor, step: Tensor, seed: Tensor) -> Tensor:
        """Return the speed at a step of the episode; after the end of a record, its last speed."""
        sample = first + step
        if self.foresight:
            sample = torch.minimum(sample, self.lengths[profile] - 1)
        speed = self.speeds[self.offsets[profile] + sample]
        size, seconds = self.perturbed, step * self.time_step
        return perturbed(speed, seconds, seed, size) if size else speed

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        seed = start.get(SEED)
        profile, first = self._window(given, seed)
        still = torch.zeros_like(seed)
        speed = self.speed_at(profile, first, still, seed)
        start.set(PROFILE, profile)
        start.set(PROFILE_START, first)
        start.set(LEADER_SPEED, speed)
        start.set(LEADER_ACCELERATION, torch.zeros_like(speed))
        if self.foresight:
            start.set(NEXT_SPEED, self.speed_at(profile, first, still + 1, seed))

    def _drawn(self, seed: Tensor) -> Tensor:
        """Draw a record by its weight, by counter."""
        if self.shares is None:
            return choose(seed, len(self.offsets), self.profile_stream)
        draw = uniform(seed, 0, self.profile_stream).double()
        drawn = torch.searchsorted(self.shares, draw, right=True)
        return drawn.clamp(max=len(self.offsets) - 1)  # rounding may leave the last share below 1

    def _window(self, given: TensorDictBase, seed: Tensor) -> tuple[Tensor, Tensor]:
        """Return the record and its first sample, given or drawn."""
        profile, first = given.get(PROFILE, None), given.get(PROFILE_START, None)
        if profile is None and self.profile is not None:
            profile = torch.full_like(seed, self.profile)
        elif profile is None:
            profile = self._drawn(seed)
        else:
            require_option(PROFILE, profile, len(self.offsets))
        if first is None:
            first = torch.zeros_like(profile)
            if self.start == "random":
                first = choose(seed, self.starts[profile], self.start_stream)
        else:
            require_option(PROFILE_START, first, self.starts[profile])
        return profile, first
