"""Intelligent Driver Model: acceleration, equilibrium gap and a simulated follower (A3–A4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from lcc_rl.functional.driver_models import DriverConstants, DriverLaw, capped, limit
from lcc_rl.functional.kinematics import advance_gap, advance_speed


@dataclass(frozen=True)
class IDMConstants(DriverConstants):
    """The parameters that drivers share; desired speed v0 and time gap T are a driver's own.

    Args:
        acceleration: maximum acceleration a [m/s²].
        deceleration: comfortable deceleration b [m/s²].
        min_gap: gap s0 at standstill [m].
        exponent: acceleration exponent δ.
        gap_floor: gaps below this count as this, so that contact stays finite [m].
        braking_limit: largest physical deceleration, positive [m/s²].
        acceleration_limit: largest physical acceleration [m/s²].

    Raises:
        ConfigError: if a parameter is not positive.
    """

    acceleration: float = 1.0
    deceleration: float = 1.5
    min_gap: float = 2.0
    exponent: float = 4.0
    gap_floor: float = 0.1
    braking_limit: float = 8.0
    acceleration_limit: float = 5.0


def desired_gap(
    speed: Tensor, approach_rate: Tensor, time_gap: Tensor | float, constants: IDMConstants
) -> Tensor:
    """Dynamic desired gap s* = s0 + max(0, vT + vΔv / (2√(ab))) (A4).

    Args:
        speed: speed v of the follower [m/s].
        approach_rate: Δv = v − v_ahead, positive when closing [m/s].
        time_gap: desired time gap T [s].
        constants: the shared parameters.

    Returns:
        Desired gap [m], broadcast over the arguments.
    """
    root = 2.0 * (constants.acceleration * constants.deceleration) ** 0.5
    return constants.min_gap + (speed * (time_gap + approach_rate / root)).clamp(min=0.0)


def idm_acceleration(
    speed: Tensor,
    gap: Tensor,
    approach_rate: Tensor,
    desired_speed: Tensor | float,
    time_gap: Tensor | float,
    constants: IDMConstants,
) -> Tensor:
    """IDM acceleration a(1 − (v/v0)^δ − (s*/s)²), held within physical limits (A3).

    Args:
        speed: speed v of the follower [m/s].
        gap: bumper-to-bumper gap s to the vehicle ahead [m].
        approach_rate: Δv = v − v_ahead, positive when closing [m/s].
        desired_speed: desired speed v0 [m/s].
        time_gap: desired time gap T [s].
        constants: the shared parameters.

    Returns:
        Acceleration [m/s²], broadcast over the arguments.
    """
    free_road = power(speed / desired_speed, constants.exponent)
    ratio = desired_gap(speed, approach_rate, time_gap, constants) / gap.clamp(
        min=constants.gap_floor
    )
    return limit(constants.acceleration * (1.0 - free_road - ratio * ratio), constants)


def power(base: Tensor, exponent: float) -> Tensor:
    """Raise to the exponent δ; the usual 4 by squaring, several times faster."""
    if exponent == 4.0:
        square = base * base
        return square * square
    return base**exponent


def equilibrium_gap(
    speed: Tensor,
    desired_speed: Tensor,
    time_gap: Tensor,
    constants: IDMConstants,
    cap_time_gap: float = 3.0,
) -> Tensor:
    """Gap at which a driver neither brakes nor accelerates behind an equally fast leader.

    (s0 + vT)/√(1 − (v/v0)^δ) diverges as v approaches v0, so it is capped at
    ``2·s0 + cap_time_gap·v``; the papers do not say how a follower starts.

    Args:
        speed: common speed v [m/s].
        desired_speed: desired speed v0 [m/s].
        time_gap: desired time gap T [s].
        constants: the shared parameters.
        cap_time_gap: time gap of the cap [s].

    Returns:
        Gap [m], broadcast over the arguments.
    """
    free_road = power(speed / desired_speed, constants.exponent)
    gap = (constants.min_gap + speed * time_gap) * (1.0 - free_road).clamp(min=1e-6).rsqrt()
    return capped(gap, speed, constants, cap_time_gap)


IDM_LAW = DriverLaw(
    idm_acceleration,
    equilibrium_gap,
    IDMConstants,
    ("desired_speed", "time_gap", "acceleration", "deceleration", "min_gap"),
)


def simulate_follower(
    leader_speed: Tensor,
    speed: Tensor,
    gap: Tensor,
    desired_speed: Tensor,
    time_gap: Tensor,
    constants: DriverConstants,
    time_step: float,
    noise: Callable[[int], Tensor] | None = None,
    law: DriverLaw = IDM_LAW,
) -> tuple[Tensor, Tensor, Tensor]:
    """Drive a follower behind recorded leaders.

    Args:
        leader_speed: speed of the leader, shape ``[time + 1, *batch]`` [m/s].
        speed: initial speed of the follower, shape ``[*batch]`` [m/s].
        gap: initial gap, shape ``[*batch]`` [m].
        desired_speed: desired speed v0, broadcastable to ``[*batch]`` [m/s].
        time_gap: desired time gap T, broadcastable to ``[*batch]`` [s].
        constants: the shared parameters.
        time_step: duration of one step T [s].
        noise: gives the relative error ξ of the executed acceleration at a step (A18), if any.
        law: the follower's driver model.

    Returns:
        Speeds and gaps of shape ``[time + 1, *batch]`` and accelerations ``[time, *batch]``.
    """
    speeds, gaps, accelerations = [speed], [gap], []
    for step in range(leader_speed.shape[0] - 1):
        ahead, ahead_reached = leader_speed[step], leader_speed[step + 1]
        command = law.acceleration(speed, gap, speed - ahead, desired_speed, time_gap, constants)
        if noise is not None:
            command = command * (1.0 + noise(step))
        reached, executed = advance_speed(speed, command, time_step)
        gap = advance_gap(gap, ahead, speed, ahead_reached, reached, time_step)
        speed = reached
        speeds.append(speed)
        gaps.append(gap)
        accelerations.append(executed)
    return torch.stack(speeds), torch.stack(gaps), torch.stack(accelerations)
