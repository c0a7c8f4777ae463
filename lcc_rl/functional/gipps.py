"""Gipps' model: Gipps, "A behavioural car-following model", Transportation Research B 15 (1981)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lcc_rl.functional.driver_models import DriverConstants, DriverLaw, capped, limit


@dataclass(frozen=True)
class GippsConstants(DriverConstants):
    """The parameters that drivers of Gipps' model share.

    Args:
        acceleration: largest acceleration a that the driver wishes [m/s²].
        deceleration: hardest braking b that the driver wishes, positive [m/s²].
        leader_deceleration: b̂, what the driver believes of the vehicle ahead, positive [m/s²].
        min_gap: gap s0 at standstill [m].
        braking_limit: largest physical deceleration, positive [m/s²].
        acceleration_limit: largest physical acceleration [m/s²].

    Raises:
        ConfigError: if a parameter is not positive.
    """

    acceleration: float = 1.7
    deceleration: float = 3.4
    leader_deceleration: float = 3.2
    min_gap: float = 2.0
    braking_limit: float = 8.0
    acceleration_limit: float = 5.0


def gipps_acceleration(
    speed: Tensor,
    gap: Tensor,
    approach_rate: Tensor,
    desired_speed: Tensor | float,
    time_gap: Tensor | float,
    constants: GippsConstants,
) -> Tensor:
    """Acceleration (v_G − v)/τ that reaches Gipps' speed v_G after the reaction time τ = 2T/3.

    v_G is the less of v + 2.5 a τ (1 − v/v0) √(0.025 + v/v0), on a free road, and
    −bτ + √(b²τ² + b (2 (s − s0) − vτ) + v_ahead² b/b̂), at which the driver can stop behind the
    vehicle ahead. With a time step of τ this is the paper's rule; with shorter ones it is
    renewed within the reaction time. T is the time gap at equilibrium if b̂ = b: τ and the
    paper's further τ/2.

    Args:
        speed: speed v of the follower [m/s].
        gap: bumper-to-bumper gap s to the vehicle ahead [m].
        approach_rate: Δv = v − v_ahead, positive when closing [m/s].
        desired_speed: desired speed v0 [m/s].
        time_gap: T [s].
        constants: the shared parameters.

    Returns:
        Acceleration [m/s²], held within physical limits, broadcast over the arguments.
    """
    share, tau = speed / desired_speed, time_gap / 1.5
    free = 2.5 * constants.acceleration * (1.0 - share) * (0.025 + share).sqrt()
    brake, ahead = constants.deceleration * tau, speed - approach_rate
    room = constants.deceleration * (2.0 * (gap - constants.min_gap) - speed * tau)
    believed = constants.deceleration / constants.leader_deceleration * ahead * ahead
    # The root of nothing has no slope: it is that of a tiny number instead.
    root = (brake * brake + room + believed).clamp(min=1e-12).sqrt()
    return limit(torch.minimum(free, (root - brake - speed) / tau), constants)


def gipps_equilibrium_gap(
    speed: Tensor,
    desired_speed: Tensor,
    time_gap: Tensor,
    constants: GippsConstants,
    cap_time_gap: float = 3.0,
) -> Tensor:
    """Gap s0 + vT + v²/2 (1/b − 1/b̂), capped as :func:`lcc_rl.functional.idm.equilibrium_gap`.

    Below v0 a driver keeps it behind an equally fast leader; at v0 any larger one, too.

    Args:
        speed: common speed v [m/s].
        desired_speed: desired speed v0; of no influence here [m/s].
        time_gap: T [s].
        constants: the shared parameters.
        cap_time_gap: time gap of the cap [s].

    Returns:
        Gap, at least s0 [m], broadcast over the arguments.
    """
    trust = 1.0 / constants.deceleration - 1.0 / constants.leader_deceleration
    more = (speed * time_gap + 0.5 * speed * speed * trust).clamp(min=0.0)
    return capped(constants.min_gap + more, speed, constants, cap_time_gap)


GIPPS_LAW = DriverLaw(
    gipps_acceleration,
    gipps_equilibrium_gap,
    GippsConstants,
    (
        *("desired_speed", "time_gap", "acceleration", "deceleration"),
        *("min_gap", "leader_deceleration"),
    ),
)
