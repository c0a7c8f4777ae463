"""Gipps' model: Gipps, "A behavioural car-following model", Transportation Research B 15 (1981)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lcc_rl.functional.driver_models import DriverConstants, Each


@dataclass(frozen=True)
class GippsConstants(DriverConstants):
    """Gipps' model and its parameters besides v0 and T.

    T is the time gap at equilibrium if b̂ = b: the reaction time τ and the paper's further τ/2.

    Args:
        acceleration: largest desired acceleration a [m/s²].
        deceleration: hardest desired braking b, positive [m/s²].
        min_gap: gap s0 at standstill [m].
        leader_deceleration: b̂, braking that the driver expects of the vehicle ahead, positive
            [m/s²].
    """

    acceleration: float = 1.7
    deceleration: float = 3.4
    min_gap: float = 2.0
    leader_deceleration: float = 3.2

    def wish(
        self, speed: Tensor, gap: Tensor, approach_rate: Tensor, desired_speed: Each, time_gap: Each
    ) -> Tensor:
        """Return (v_G − v)/τ, which reaches Gipps' speed v_G after the reaction time τ = 2T/3.

        v_G is the less of v + 2.5 a τ (1 − v/v0) √(0.025 + v/v0), on a free road, and
        −bτ + √(b²τ² + b (2 (s − s0) − vτ) + v_ahead² b/b̂), at which the driver can stop behind
        the vehicle ahead. With a time step of τ this is the paper's rule; with shorter steps the
        speed is updated within the reaction time.
        """
        share, tau = speed / desired_speed, time_gap / 1.5
        free = 2.5 * self.acceleration * (1.0 - share) * (0.025 + share).sqrt()
        brake, ahead = self.deceleration * tau, speed - approach_rate
        room = self.deceleration * (2.0 * (gap - self.min_gap) - speed * tau)
        expected = self.deceleration / self.leader_deceleration * ahead * ahead
        # Clamped: the gradient of sqrt is infinite at 0.
        root = (brake * brake + room + expected).clamp(min=1e-12).sqrt()
        return torch.minimum(free, (root - brake - speed) / tau)

    def steady_gap(self, speed: Tensor, desired_speed: Tensor, time_gap: Tensor) -> Tensor:
        """Return s0 + vT + v²/2 (1/b − 1/b̂), at least s0.

        Below v0 this is the only equilibrium gap; at v0 every larger gap is one, too.
        """
        trust = 1.0 / self.deceleration - 1.0 / self.leader_deceleration
        more = (speed * time_gap + 0.5 * speed * speed * trust).clamp(min=0.0)
        return self.min_gap + more
