"""Starts: speeds and gaps of a role's vehicles at reset."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.errors import ConfigError, require
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.functional.random import stream_id, uniform
from lcc_rl.pieces.base import SEED
from lcc_rl.pieces.controllers import stream_name
from lcc_rl.pieces.leader import PROFILE, PROFILE_START
from lcc_rl.pieces.world import Part, World
from lcc_rl.settings import Factors, NonNegative, Positive

DEFAULT_TIME_GAP = 1.5  # [s]
RECORDED_GAP = "it starts at the recorded gap; time_gap=1.5 sets another"
GAP_STREAM, SPEED_STREAM = stream_id("platoon.gap"), stream_id("platoon.speed")


def draw_uniform(start: TensorDictBase, stream: int, like: Tensor) -> Tensor:
    """Draw from U[0, 1) for every vehicle of a role, by the seed of its episode."""
    index = torch.arange(like.shape[-2], device=like.device).unsqueeze(-1)
    return uniform(start.get(SEED).unsqueeze(-2), 0, stream + index)


class TimeGapStart(Part):
    """Speed and gap of the driver that was recorded behind the leader, or a given time gap.

    A given time gap T starts a vehicle at the leader's speed v and the gap s0 + T v. So start
    vehicles behind which no driver was recorded: those that do not follow the leader directly, and
    those behind other leaders.
    """

    standstill_gap: Positive = 2.0  # s0, gap at standstill [m]
    # T, not given in the ALCC paper [s]; recorded: 1.5 s where no driver was recorded.
    time_gap: NonNegative | Literal["recorded"] = "recorded"
    # Range of a factor on the gap, drawn uniformly by the episode's seed; 1 in evaluation. Training
    # thus includes gaps that good driving never reaches.
    gap_range: Factors = (0.1, 1.5)

    of_training = ("gap_range",)
    name = AUTOMATED

    def setup(self, world: World) -> None:
        """Choose the range and the random stream of the role."""
        self.stream = stream_id(f"{stream_name(self.name)}.gap_factor")
        self.lowest, self.highest = world.deviations(self.gap_range)
        self.given = DEFAULT_TIME_GAP if self.time_gap == "recorded" else float(self.time_gap)
        profiles, places = world.profiles, world.string.places(self.name)
        recorded = places[:1] == (0,) and not world.string.drawn and profiles is not None
        recorded = recorded and profiles.followers is not None and self.time_gap == "recorded"
        self.records = (profiles.followers, profiles.offsets) if recorded else None
        changed = self.standstill_gap != type(self).standstill_gap
        # Changed settings without effect on this role, and why.
        unused = recorded and changed and len(places) == 1
        self.idle = {"standstill_gap": RECORDED_GAP} if unused else {}

    def __call__(self, start: TensorDictBase, role: str, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Return speed and gap, see :class:`lcc_rl.pieces.string.Start`."""
        uniformly = draw_uniform(start, self.stream, speed)
        factor = self.lowest + (self.highest - self.lowest) * uniformly
        gap = self.standstill_gap + self.given * speed
        if self.records is not None:
            followers, offsets = (x.to(speed.device) for x in self.records)
            motion = followers[offsets[start.get(PROFILE)] + start.get(PROFILE_START)]
            pairs = zip(motion.split(1, -1), (speed, gap), strict=True)
            speed, gap = (torch.cat([x.to(y), y[..., 1:, :]], -2) for x, y in pairs)
        return speed, factor * gap


class EquilibriumStart(Part):
    """The gap at which the role's own drivers neither brake nor accelerate, at the leader's speed.

    It is computed with the parameters that the drivers of the population share.
    """

    # Time gap of the cap, see DriverConstants.equilibrium_gap [s].
    cap_time_gap: Positive = 3.0

    def setup(self, world: World) -> None:
        self.drivers = world.population.constants.mean()

    def __call__(self, start: TensorDictBase, role: str, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Return speed and gap, see :class:`lcc_rl.pieces.string.Start`."""
        desired_speed, time_gap = (
            start.get((role, name), None) for name in ("desired_speed", "desired_time_gap")
        )
        if desired_speed is None or time_gap is None:
            raise ConfigError(
                f"scenario.start.{role}: EquilibriumStart needs {role}.desired_speed and "
                f"{role}.desired_time_gap, which only driver models write; use for example "
                f"'scenario.start.{role}=${{scenario.start.automated}}'"
            )
        gap = start.get((role, "equilibrium_gap"), None)
        if gap is not None:
            return speed, self.drivers.capped(gap, speed, self.cap_time_gap)
        args = (desired_speed, time_gap, self.cap_time_gap)
        return speed, self.drivers.equilibrium_gap(speed, *args)


class HeadwayStart(Part):
    """A fixed gap at the leader's speed, with deviations from both in training (HCFS)."""

    headway: Positive = 5.0  # h, the gap at equilibrium; not given in the paper [m]
    gap_spread: NonNegative = 2.0  # largest deviation of a gap; 0 in evaluation [m]
    speed_spread: NonNegative = 1.0  # largest deviation of a speed; 0 in evaluation [m/s]

    of_training = ("gap_spread", "speed_spread")
    steady = True

    def setup(self, world: World) -> None:
        """Choose the deviations; 0 in an evaluation."""
        self.gaps, self.speeds = map(world.deviation, (self.gap_spread, self.speed_spread))
        text = f"scenario.start.{self.name}.gap_spread={self.gaps:g} must be below its "
        require(self.gaps < self.headway, f"{text}headway={self.headway:g}")

    def __call__(self, start: TensorDictBase, role: str, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Return speed and gap, see :class:`lcc_rl.pieces.string.Start`."""
        shift = 2.0 * draw_uniform(start, GAP_STREAM, speed) - 1.0
        gap = self.headway + self.gaps * shift
        shift = 2.0 * draw_uniform(start, SPEED_STREAM, speed) - 1.0
        return (speed + self.speeds * shift).clamp(min=0.0), gap
