"""Optimal velocity model and full velocity difference model.

Bando, Hasebe, Nakayama, Shibata, Sugiyama, "Dynamical model of traffic congestion and numerical
simulation", Physical Review E 51 (1995); Jiang, Wu, Zhu, "Full velocity difference model for a
car-following theory", Physical Review E 64 (2001).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lcc_rl.functional.driver_models import DriverConstants, Each


@dataclass(frozen=True)
class OVMConstants(DriverConstants):
    """The optimal velocity model and its parameters besides v0 and T.

    T is defined in :meth:`optimal_speed`.

    Args:
        min_gap: gap s0 at which the optimal speed is zero [m].
        sensitivity: κ, how fast the speed adapts to the optimal one [1/s].
        form: β, position of the steepest slope: s0 + β A T.
    """

    min_gap: float = 2.0
    sensitivity: float = 1.0
    form: float = 1.5

    def optimal_speed(self, gap: Tensor, desired_speed: Each, time_gap: Each) -> Tensor:
        """Return V(s) = A (tanh((s − s0)/(A T) − β) + tanh β), A = v0/(1 + tanh β).

        This is Bando's function in parameters that other models have, too: it is 0 at s0 and v0
        at large gaps, and its steepest slope is 1/T. Bando's original, 16.8 m/s
        (tanh(0.086 (Δx − 25 m)) + 0.913), has v0 = 32.1 m/s, T = 0.69 s and β = 1.54.

        Args:
            gap: bumper-to-bumper gap s [m].
            desired_speed: v0 [m/s].
            time_gap: T [s].

        Returns:
            Speed, negative below s0 [m/s], broadcast over the arguments.
        """
        scale, offset = self._scale(desired_speed, gap)
        shift = (gap - self.min_gap) / (scale * time_gap) - self.form
        return scale * (shift.tanh() + offset)

    def _scale(self, desired_speed: Each, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return A and tanh β."""
        offset = torch.as_tensor(self.form, dtype=like.dtype, device=like.device).tanh()
        return desired_speed / (1.0 + offset), offset

    def wish(
        self, speed: Tensor, gap: Tensor, approach_rate: Tensor, desired_speed: Each, time_gap: Each
    ) -> Tensor:
        """Return κ (V(s) − v); this model ignores the approach rate."""
        return self.sensitivity * (self.optimal_speed(gap, desired_speed, time_gap) - speed)

    def steady_gap(self, speed: Tensor, desired_speed: Tensor, time_gap: Tensor) -> Tensor:
        """Return the gap with V(s) = v."""
        scale, offset = self._scale(desired_speed, speed)
        level = (speed / scale - offset).clamp(max=1.0 - 1e-6)
        return self.min_gap + scale * time_gap * (level.atanh() + self.form)


@dataclass(frozen=True)
class FVDMConstants(OVMConstants):
    """The full velocity difference model and its parameters besides v0 and T.

    λ is the same at all gaps; in the paper it is 0 beyond 100 m.

    Args:
        speed_gain: λ, the weight of the speed difference [1/s].
        sensitivity, form, min_gap: see :class:`OVMConstants`.
    """

    sensitivity: float = 0.41
    speed_gain: float = 0.5

    def wish(
        self, speed: Tensor, gap: Tensor, approach_rate: Tensor, desired_speed: Each, time_gap: Each
    ) -> Tensor:
        """Return κ (V(s) − v) − λ Δv."""
        adapting = super().wish(speed, gap, approach_rate, desired_speed, time_gap)
        return adapting - self.speed_gain * approach_rate
