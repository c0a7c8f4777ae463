"""A leader that another vehicle replaces during the episode: cut-in and cut-out."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.errors import require
from lcc_rl.functional.layout import join
from lcc_rl.functional.random import between, stream_id
from lcc_rl.pieces.base import Entry
from lcc_rl.pieces.leader import NGSIMLeader
from lcc_rl.pieces.string import PLACEMENT
from lcc_rl.pieces.world import World
from lcc_rl.settings import Increasing, NonNegative, Number, Positive

FAR = 1e6  # longer than any gap [m]
Range = Annotated[tuple[NonNegative, NonNegative], Increasing]


class ReplacedLeader(NGSIMLeader):
    """Another vehicle takes the place of the leader once in an episode.

    With ``gap`` a vehicle cuts in at this gap, or at the present one if that is shorter. With
    ``farther`` the leader leaves, and the next vehicle is farther ahead by this distance. From then
    on the new vehicle drives at the speed of the record plus an excess, which decays with the time
    constant ``settling``. Every episode draws time, distance and excess by its seed.
    """

    at: Range = (10.0, 10.0)  # time of the change, from the start of the episode [s]
    gap: Range | None = None  # of a vehicle that cuts in [m]
    farther: Range | None = None  # distance from the leaving vehicle to the next one [m]
    # Excess of the new vehicle's speed over that of the record when it appears [m/s].
    excess: Annotated[tuple[Number, Number], Increasing] = (0.0, 0.0)
    settling: Positive = 5.0  # time constant with which the excess decays [s]

    replaces = True
    event = (PLACEMENT, ("vehicles", "gap"))
    more = (Entry(PLACEMENT, "–, m, m", "1 if the leader is replaced; largest gap; added gap", 3),)

    def validate(self) -> None:
        if (self.gap is None) == (self.farther is None):
            raise ValueError("give gap (cut-in) or farther (cut-out), one of them")

    def setup(self, world: World) -> None:
        super().setup(world)
        end = world.horizon * world.time_step
        require(
            world.time_step <= self.at[0] and self.at[1] < end,
            f"scenario.pieces.leader.at={list(self.at)} must lie within the episode of {end:g} s "
            "(scenario.horizon); scenario.pieces.leader.at=[2,3] sets other times",
        )
        names = ("at", "distance", "excess")
        self.changes = [stream_id(f"leader.replaced.{name}") for name in names]

    def _change(self, seed: Tensor) -> tuple[Tensor, Tensor]:
        """Return the step of the change, and the excess of speed then [m/s]."""
        time, _, excess = self.changes
        at = (between(self.at, seed, time) / self.time_step).round()
        return at, between(self.excess, seed, excess)

    def speed_at(self, profile: Tensor, first: Tensor, step: Tensor, seed: Tensor) -> Tensor:
        at, excess = self._change(seed)
        since = (step - at) * self.time_step
        decayed = excess * torch.exp(-since.clamp(min=0.0) / self.settling)
        added = torch.where(since >= 0.0, decayed, torch.zeros_like(decayed))
        return (super().speed_at(profile, first, step, seed) + added).clamp(min=0.0)

    def compute(
        self, profile: Tensor, first: Tensor, speed: Tensor, step: Tensor, seed: Tensor
    ) -> tuple[Tensor, ...]:
        """Return the motion of the leader, and its placement."""
        at, excess = self._change(seed)
        changed = step == at
        reached, acceleration, *more = super().compute(profile, first, speed, step, seed)
        record = [
            super(ReplacedLeader, self).speed_at(profile, first, x, seed) for x in (step, step - 1)
        ]
        own = (record[0] - record[1]) / self.time_step - excess / self.settling
        distance = between(self.gap or self.farther or (0.0, 0.0), seed, self.changes[1])
        near, added = (distance, 0.0 * distance) if self.gap else (0.0 * distance + FAR, distance)
        numbers = (changed.to(speed.dtype), near, added)
        none = (torch.zeros_like(near), torch.full_like(near, FAR), torch.zeros_like(near))
        placement = [torch.where(changed, x, y) for x, y in zip(numbers, none, strict=True)]
        return (reached, torch.where(changed, own, acceleration), *more, join(placement, -1))

    def happened(self, placement: Tensor, gap: Tensor) -> Tensor:
        """Return the steps of a change, ``[*batch, 1]``; a cut-in must shorten the gap."""
        changed, near, _ = placement.split(1, -1)
        return (changed > 0.0) & ((near >= FAR) | (gap[..., 0, :] > 0.999 * near))

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> Any:
        super().begin(given, start)
        speed = start.get(("leader", "speed"))
        start.set(
            PLACEMENT, torch.stack([0.0 * speed, 0.0 * speed + FAR, 0.0 * speed], -1).squeeze(-2)
        )
