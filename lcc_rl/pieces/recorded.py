"""The recorded driver behind the leader, as a controller."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from lcc_rl.errors import require
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.world import World
from lcc_rl.settings import Positive


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
        """Read the records.

        Raises:
            ConfigError: if no driver was recorded behind the leaders.
        """
        recorded = world.profiles is not None and world.profiles.followers is not None
        require(
            recorded,
            f"scenario.controllers.{self.name}: no driver was recorded behind these leaders; use "
            "trajectories of several vehicles, such as data=ngsim, data=openacc, data=table or "
            "data=episodes",
        )
        self.register_buffer("records", world.profiles.followers)
        self.register_buffer("offsets", world.profiles.offsets)
        self.declare(world)
        self.limits = None

    def command(
        self, speed: Tensor, gap: Tensor, profile: Tensor, first: Tensor, step: Tensor
    ) -> Tensor:
        sample = self.offsets[profile] + first + step
        off = gap - self.records[sample][..., 1].view_as(gap)
        reached = self.records[sample + 1][..., 0].view_as(speed) + off / self.led_back
        return (reached.clamp(min=0.0) - speed) / self.time_step
