"""Engine and brakes: commands act with a delay, a lag and within limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lcc_rl.functional.kinematics import advance_gap, advance_speed


@dataclass(frozen=True)
class Response:
    """How commands become accelerations.

    A command acts after ``late`` steps; from then on every step closes ``share`` of the
    remaining difference (a first-order lag τ, sampled: share = 1 − e^(−T/τ)).

    Args:
        late: steps between a command and its first effect.
        share: in (0, 1]; 1 without lag.
        braking: hardest braking possible, positive [m/s²].
        time_step: T [s].
    """

    late: int
    share: float
    braking: float
    time_step: float

    @classmethod
    def of(cls, late: int, lag: float, braking: float, time_step: float) -> Response:
        """Return the response with a delay in steps and a lag in s."""
        share = 1.0 if lag == 0.0 else 1.0 - math.exp(-time_step / lag)
        return cls(late, share, braking, time_step)

    @property
    def hold(self) -> float:
        """Time for which holding the last acceleration bounds the effect of the lag [s].

        With the lag, full braking from acceleration a reaches a speed that exceeds that without
        lag by T·(a + braking)·(1 − share + (1 − share)² + …). Holding a for this time,
        then braking fully, bounds the lagged speed from above.
        """
        return self.time_step * (1.0 - self.share) / self.share

    def next(self, acceleration: Tensor, command: Tensor) -> Tensor:
        """Return the acceleration of a step from that of the step before [m/s²]."""
        wanted = command.clamp(min=-self.braking)
        return acceleration + self.share * (wanted - acceleration)


@dataclass(frozen=True)
class PairState:
    """State of a vehicle and of the vehicle ahead.

    Args:
        speed: of the vehicle [m/s].
        gap: to the vehicle ahead [m].
        ahead: speed of the vehicle ahead [m/s].
        acceleration: of the step before [m/s²].
    """

    speed: Tensor
    gap: Tensor
    ahead: Tensor
    acceleration: Tensor

    def after(self, own: Tensor, ahead: Tensor | float, time_step: float) -> PairState:
        """Return the motion after a step with accelerations of both [m/s²]; neither reverses."""
        speed, _ = advance_speed(self.speed, own, time_step)
        reached, _ = advance_speed(self.ahead, torch.as_tensor(ahead), time_step)
        gap = advance_gap(self.gap, self.ahead, self.speed, reached, speed, time_step)
        return PairState(speed, gap, reached, own)


def predicted(
    now: PairState, pending: Tensor, ahead_acceleration: Tensor | float, response: Response
) -> list[PairState]:
    """Return the motion after every step in which commands already given act.

    Args:
        now: the motion, entries of any one shape ``[…, 1]``.
        pending: commands that do not act yet, oldest first, ``[…, late]`` [m/s²].
        ahead_acceleration: constant, of the vehicle ahead, which does not reverse [m/s²].
        response: how commands become accelerations.

    Returns:
        The present motion, then one per step.
    """
    found = [now]
    for number in range(pending.shape[-1]):  # split would give an empty one of none
        own = response.next(found[-1].acceleration, pending[..., number : number + 1])
        found.append(found[-1].after(own, ahead_acceleration, response.time_step))
    return found
