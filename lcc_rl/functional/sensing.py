"""Measurements with delay and bounded errors, and the states consistent with them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lcc_rl.functional.actuation import PairState
from lcc_rl.functional.layout import join

ROUNDING = 0.02  # exceeds the rounding of a gap's rate in single precision [m/s]
# A gap that differs by more from its prediction is that of another vehicle ahead [m, m/s].
OTHER_TARGET, OTHER_TARGET_RATE = 4.0, 40.0


@dataclass(frozen=True)
class Sensing:
    """Bounds of measurements.

    Args:
        gap, speed, ahead: largest errors of the gap [m], the own speed [m/s] and the speed of the
            vehicle ahead [m/s].
        scale: largest relative error of both speeds.
        late: age of a measurement when it arrives, in steps.
        longest: largest number of consecutive steps without a new measurement.
    """

    gap: float
    speed: float
    ahead: float
    scale: float
    late: int
    longest: int

    @property
    def oldest(self) -> int:
        """Age of the oldest measurement [steps]."""
        return self.late + self.longest

    def worst(self, measured: PairState) -> PairState:
        """Return the state within the bounds from which braking leaves the least room.

        Room decreases with the own speed and increases with the gap and the speed ahead.
        """
        return replace(
            measured,
            speed=(measured.speed + self.speed) / (1.0 - self.scale),
            gap=measured.gap - self.gap,
            ahead=(measured.ahead - self.ahead).clamp(min=0.0) / (1.0 + self.scale),
        )


@dataclass(frozen=True)
class Agreement:
    """Compares the rate of the measured gap with the measured relative speed.

    Gaps and speeds may come from different instruments, or from different columns of a record.
    Where they disagree, each limit uses the worse of both.

    Args:
        sensing: bounds of errors, which explain some of the difference.
        time_step: T [s].
        settling: time constant of the average of differences [s].
    """

    sensing: Sensing
    time_step: float
    settling: float = 0.5

    def next(self, kept: Tensor, gap: Tensor, relative: Tensor) -> Tensor:
        """Return the memory after a measurement, ``[…, 3]``; zeros reset it.

        It holds 1; the measured gap plus half a step of relative motion, from which the trapezoidal
        rule predicts the next gap [m]; and the average difference [m/s]. A vehicle that cuts in or
        out changes the gap by more than its own length, which resets the memory.
        """
        begun, predicted, average = kept.split(1, -1)
        half = 0.5 * self.time_step * relative
        share = (1.0 - math.exp(-self.time_step / self.settling)) * begun
        change = gap - half - predicted
        average = average + share * (change / self.time_step - average)
        own = max(OTHER_TARGET, OTHER_TARGET_RATE * self.time_step) + 2.0 * self.sensing.gap
        most = own + self.time_step * self.sensing.longest * relative.abs()
        average = torch.where(change.abs() > most, 0.0, average)
        return join([torch.ones_like(gap), gap + half, average], -1)

    def difference(self, kept: Tensor, relative: Tensor) -> Tensor:
        """Return the rate of the gap minus the relative speed [m/s].

        It is zero where rounding or the known errors of the sensors explain the difference.
        """
        sensing, found = self.sensing, kept[..., 2:]
        held = self.time_step * sensing.longest * relative.abs()  # no measurement arrived
        explained = (2.0 * sensing.gap + held) / self.settling + sensing.speed + sensing.ahead
        return torch.where(found.abs() > explained + ROUNDING, found, 0.0)


def brought_up(
    measured: PairState,
    ages: Tensor,
    past: Tensor,
    ahead_acceleration: Tensor | float,
    time_step: float,
) -> PairState:
    """Return the present state from a measurement of some steps ago.

    Args:
        measured: the measured state, entries ``[…, 1]``; its acceleration is the present one.
        ages: ages of the target's measurement and of the own speed's, not older, in steps,
            ``[…, 2]``.
        past: own accelerations of the last steps, latest first, ``[…, oldest]`` [m/s²].
        ahead_acceleration: of the vehicle ahead since then [m/s²].
        time_step: T [s].
    """
    driven = list(past.split(1, -1)) if past.shape[-1] else []
    speed, age = measured.speed, ages[..., :1]
    for number, acceleration in enumerate(driven):  # back to the speed at the target's measurement
        since = (ages[..., 1:] <= number) & (number < age)
        speed = torch.where(since, speed - time_step * acceleration, speed)
    found = replace(measured, speed=speed.clamp(min=0.0))
    for number, acceleration in reversed([*enumerate(driven)]):
        then = found.after(acceleration, ahead_acceleration, time_step)
        passed = number < age
        speed, gap, ahead = (
            torch.where(passed, getattr(then, name), getattr(found, name))
            for name in ("speed", "gap", "ahead")
        )
        found = PairState(speed, gap, ahead, measured.acceleration)
    return found
