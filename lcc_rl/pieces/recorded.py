"""The recorded driver behind the leader, as a controller and as a start."""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.errors import ConfigError
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.leader import PROFILE, PROFILE_START
from lcc_rl.pieces.world import Part, World
from lcc_rl.settings import Positive


def _followers(world: World, where: str) -> Tensor:
    """Return speed [m/s] and gap [m] of the recorded drivers, ``[samples, 2]``.

    Raises:
        ConfigError: if no driver was recorded behind the leaders.
    """
    found = None if world.profiles is None else world.profiles.followers
    if found is None:
        raise ConfigError(
            f"{where}: no driver was recorded behind these leaders; use trajectories of several "
            "vehicles, such as data=ngsim, data=openacc, data=table or data=episodes"
        )
    followers: Tensor = found
    return followers


class RecordedDriver(Controller):
    """Drives as the recorded driver behind the leader; for the first place of a string.

    The speeds are those of the record. Gaps are the integral of the relative speed. Speeds of two
    instruments differ by up to 1 %, which would move the car tens of metres from its recorded
    place. The gap error is therefore corrected with the time constant ``led_back``.
    """

    led_back: Positive = 10.0  # time constant of the correction of the gap [s]

    reads = ("self.speed", "self.gap", "leader.profile", "leader.start", "episode.step")

    records: ClassVar[Tensor]
    offsets: ClassVar[Tensor]

    def setup(self, world: World) -> None:
        """Read the records."""
        found = _followers(world, f"scenario.controllers.{self.name}")
        self.register_buffer("records", found)
        self.register_buffer("offsets", world.profiles.offsets)
        self.declare(world)
        self.limits = None

    def command(
        self, speed: Tensor, gap: Tensor, profile: Tensor, first: Tensor, step: Tensor
    ) -> Tensor:
        """Return the commands."""
        sample = self.offsets[profile] + first + step
        off = gap - self.records[sample][..., 1].view_as(gap)
        reached = self.records[sample + 1][..., 0].view_as(speed) + off / self.led_back
        return (reached.clamp(min=0.0) - speed) / self.time_step


class RecordedStart(Part):
    """The speed and gap of the recorded driver behind the leader at the start of the episode."""

    def setup(self, world: World) -> None:
        """Read the records."""
        self.followers = _followers(world, f"scenario.start.{self.name}")
        self.offsets = world.profiles.offsets

    def __call__(self, start: TensorDictBase, role: str, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Return speed and gap, see :class:`lcc_rl.pieces.string.Start`."""
        device = speed.device
        sample = self.offsets.to(device)[start.get(PROFILE)] + start.get(PROFILE_START)
        found = self.followers.to(device)[sample].expand(*speed.shape[:-1], 2)
        own, gap = torch.split(found, 1, -1)
        return own, gap
