"""What sensors make of a state: late, within bounds of their errors, and what that leaves open."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lcc_rl.functional.actuation import PairState


@dataclass(frozen=True)
class Sensing:
    """Bounds of measurements.

    Args:
        gap, speed, ahead: largest errors of the gap [m], of the own speed and of that of the
            vehicle ahead [m/s].
        late: age of a measurement that arrives, in steps.
        longest: steps in a row, at the most, in which none arrives and the last one stays.
    """

    gap: float
    speed: float
    ahead: float
    late: int
    longest: int

    @property
    def oldest(self) -> int:
        """Age of the oldest measurement [steps]."""
        return self.late + self.longest

    def worst(self, measured: PairState) -> PairState:
        """Return the state within the bounds from which braking leaves the least room.

        Room falls with the own speed, and grows with the gap and with the speed ahead.
        """
        return replace(
            measured,
            speed=measured.speed + self.speed,
            gap=measured.gap - self.gap,
            ahead=(measured.ahead - self.ahead).clamp(min=0.0),
        )


def brought_up(
    measured: PairState,
    age: Tensor,
    past: Tensor,
    ahead_acceleration: Tensor | float,
    time_step: float,
) -> PairState:
    """Return the present motion from a measurement of some steps ago.

    Args:
        measured: the motion then, entries ``[…, 1]``; its acceleration is the present one.
        age: of the measurement in steps, ``[…, 1]``.
        past: own accelerations of the last steps, the latest first, ``[…, oldest]`` [m/s²].
        ahead_acceleration: of the vehicle ahead since then [m/s²].
        time_step: T [s].
    """
    found = measured
    for number in reversed(range(past.shape[-1])):
        then = found.after(past[..., number : number + 1], ahead_acceleration, time_step)
        passed = number < age
        speed, gap, ahead = (
            torch.where(passed, new, old)
            for new, old in (
                (then.speed, found.speed),
                (then.gap, found.gap),
                (then.ahead, found.ahead),
            )
        )
        found = PairState(speed, gap, ahead, measured.acceleration)
    return found
