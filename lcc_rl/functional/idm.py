"""Intelligent Driver Model: acceleration and equilibrium gap (A3–A4)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from lcc_rl.functional.driver_models import DriverConstants, Each


@dataclass(frozen=True)
class IDMConstants(DriverConstants):
    """The Intelligent Driver Model and its parameters besides desired speed v0 and time gap T.

    Args:
        acceleration: maximum acceleration a [m/s²].
        deceleration: comfortable deceleration b [m/s²].
        min_gap: gap s0 at standstill [m].
        exponent: acceleration exponent δ.
        gap_floor: smaller gaps count as this, so that the result is finite at contact [m].
    """

    acceleration: float = 1.0
    deceleration: float = 1.5
    min_gap: float = 2.0
    exponent: float = 4.0
    gap_floor: float = 0.1

    def desired_gap(self, speed: Tensor, approach_rate: Tensor, time_gap: Each) -> Tensor:
        """Return the desired gap s* = s0 + max(0, vT + vΔv / (2√(ab))) (A4) [m].

        Args:
            speed: speed v of the follower [m/s].
            approach_rate: Δv = v − v_ahead, positive when closing [m/s].
            time_gap: desired time gap T [s].
        """
        root = 2.0 * (self.acceleration * self.deceleration) ** 0.5
        return self.min_gap + (speed * (time_gap + approach_rate / root)).clamp(min=0.0)

    def wish(
        self, speed: Tensor, gap: Tensor, approach_rate: Tensor, desired_speed: Each, time_gap: Each
    ) -> Tensor:
        """Return a(1 − (v/v0)^δ − (s*/s)²) (A3)."""
        free_road = power(speed / desired_speed, self.exponent)
        ratio = self.desired_gap(speed, approach_rate, time_gap) / gap.clamp(min=self.gap_floor)
        return self.acceleration * (1.0 - free_road - ratio * ratio)

    def steady_gap(self, speed: Tensor, desired_speed: Tensor, time_gap: Tensor) -> Tensor:
        """Return (s0 + vT)/√(1 − (v/v0)^δ)."""
        free_road = power(speed / desired_speed, self.exponent)
        return (self.min_gap + speed * time_gap) * (1.0 - free_road).clamp(min=1e-6).rsqrt()


def power(base: Tensor, exponent: float) -> Tensor:
    """Raise to the exponent δ; δ = 4 by squaring, which is several times faster."""
    if exponent == 4.0:
        square = base * base
        return square * square
    return base**exponent
