"""Limits of a measured entry, such as a longest gap or a shortest time gap."""

from __future__ import annotations

import torch
from torch import Tensor

from lcc_rl.pieces.rewards import RewardTerm
from lcc_rl.pieces.surrogates import excess
from lcc_rl.pieces.world import World
from lcc_rl.settings import Positive, Share


class RangeReward(RewardTerm):
    """−1 where an entry of the automated vehicle leaves its range, else 0."""

    entry: str = "gap"  # the vehicle's gap [m], time_gap [s], speed [m/s] …
    least: Positive | None = None  # in the entry's unit; None for no bound
    largest: Positive | None = None

    def validate(self) -> None:
        if self.least is None and self.largest is None:
            raise ValueError("needs least, largest or both")
        if self.least is not None and self.largest is not None and self.least >= self.largest:
            raise ValueError(f"least={self.least} must be below largest={self.largest}")

    def setup(self, world: World) -> None:
        self.declare(world, [f"self.{self.entry}"])

    def reward(self, entry: Tensor) -> Tensor:
        return -self.missed(entry).to(entry.dtype)

    def missed(self, entry: Tensor) -> Tensor:
        """Return where the range is left, ``[*batch, A, 1]``."""
        outside = torch.zeros_like(entry, dtype=torch.bool)
        if self.least is not None:
            outside = outside | (entry < self.least)
        if self.largest is not None:
            outside = outside | (entry > self.largest)
        return outside


class SmoothRange(RangeReward):
    """Minus the share by which an entry leaves its range, smooth; begins inside the range."""

    margin: Share = 0.05  # distance from a bound at which the price begins, as a share of it
    width: Positive = 0.05  # range over which the price bends, as a share of a bound

    def reward(self, entry: Tensor) -> Tensor:
        price = torch.zeros_like(entry)
        if self.least is not None:
            price = price + excess(1.0 + self.margin - entry / self.least, self.width)
        if self.largest is not None:
            price = price + excess(entry / self.largest - 1.0 + self.margin, self.width)
        return -price
