"""Limits of a measured entry, such as a longest gap or a shortest time gap: terms and stand-ins."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from lcc_rl.errors import ConfigError, require_in, require_positive
from lcc_rl.functional.pattern import VehicleString
from lcc_rl.pieces.rewards import RewardTerm
from lcc_rl.pieces.surrogates import excess


class RangeReward(RewardTerm):
    """−1 where an entry of the automated vehicle leaves its range, else 0.

    Args:
        name, weight, string: see :class:`lcc_rl.pieces.rewards.RewardTerm`.
        entry: of the vehicle: ``gap`` [m], ``time_gap`` [s], ``speed`` [m/s] …
        least, largest: the range, in the entry's unit; None for no bound.

    Raises:
        ConfigError: if there is no bound, one is not positive, or they are the wrong way round.
    """

    where: ClassVar[str] = "reward.terms"

    def __init__(
        self,
        name: str = "range",
        weight: float = 1.0,
        entry: str = "gap",
        least: float | None = None,
        largest: float | None = None,
        string: VehicleString | None = None,
    ) -> None:
        bounds = {"least": least, "largest": largest}
        given = {key: value for key, value in bounds.items() if value is not None}
        require_positive(f"{self.where}.{name}", **given)
        if not given or (least is not None and largest is not None and least >= largest):
            raise ConfigError(
                f"{self.where}.{name} needs least, largest or both, the first below the second, "
                f"got {least} and {largest}"
            )
        super().__init__(name, weight, [f"self.{entry}"], string)
        self.least, self.largest = least, largest

    def reward(self, entry: Tensor) -> Tensor:
        """Return the unweighted term."""
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
    """Minus the share by which an entry leaves its range, smooth, from a little inside it.

    Args:
        name, weight, entry, least, largest, string: see :class:`RangeReward`; the bounds are the
            limits that count as missed.
        margin: share of a bound by which the price begins before it.
        width: share of a bound over which the price bends.

    Raises:
        ConfigError: as :class:`RangeReward`, or if the margin or the width is out of range.
    """

    where: ClassVar[str] = "agent.surrogates"

    def __init__(
        self,
        name: str = "range",
        weight: float = 1.0,
        entry: str = "gap",
        least: float | None = None,
        largest: float | None = None,
        margin: float = 0.05,
        width: float = 0.05,
        string: VehicleString | None = None,
    ) -> None:
        super().__init__(name, weight, entry, least, largest, string)
        require_in(f"{self.where}.{name}", "[0, 1)", margin=margin)
        require_positive(f"{self.where}.{name}", width=width)
        self.margin, self.width = margin, width

    def reward(self, entry: Tensor) -> Tensor:
        """Return the unweighted term."""
        price = torch.zeros_like(entry)
        if self.least is not None:
            price = price + excess(1.0 + self.margin - entry / self.least, self.width)
        if self.largest is not None:
            price = price + excess(entry / self.largest - 1.0 + self.margin, self.width)
        return -price
