"""Motor power of the controlled car (A2)."""

from __future__ import annotations

import torch
from torch import Tensor

# Rows: power of v; columns: power of a; the fit of A2 [W].
POWER_COEFFICIENTS = (
    (110.3, 1213.0, 2911.0),
    (422.9, 2484.0, 25.19),
    (-0.0279, 1.374, 0.0),
    (0.3557, 0.0, 0.0),
)


def motor_power(speed: Tensor, acceleration: Tensor, recuperation: bool = True) -> Tensor:
    """Electric power drawn by the motor, Σ p_ij v^i a^j (A2).

    Args:
        speed: speed at the start of the step, any shape [m/s].
        acceleration: executed acceleration, same shape [m/s²].
        recuperation: count negative (braking) power; otherwise negative power is zero.

    Returns:
        Power [W], same shape; negative where braking feeds the battery.
    """
    (p00, p01, p02), (p10, p11, p12), (p20, p21, _), (p30, _, _) = POWER_COEFFICIENTS
    constant = p00 + speed * (p10 + speed * (p20 + speed * p30))
    linear = p01 + speed * (p11 + speed * p21)
    quadratic = p02 + speed * p12
    result = constant + acceleration * (linear + acceleration * quadratic)
    return result if recuperation else result.clamp(min=0.0)


def steady_power(speed: Tensor) -> Tensor:
    """Power at a constant speed [W], same shape: A2 without acceleration."""
    return motor_power(speed, torch.zeros_like(speed))


def acceleration_loss(speed: Tensor, acceleration: Tensor) -> Tensor:
    """Power that accelerating and braking dissipate, the part of A2 with a².

    Over a trip A2 is a sum of three parts: the :func:`steady_power` of the speeds driven; the
    kinetic energy at the end minus that at the start (the part with a, the derivative of a function
    of the speed); and this loss. A controller that follows the same leader over the same distance
    can change the loss only.

    Args:
        speed: speed at the start of the step, any shape [m/s].
        acceleration: executed acceleration, same shape [m/s²].

    Returns:
        Power [W], same shape, at least zero.
    """
    (_, _, p02), (_, _, p12), _, _ = POWER_COEFFICIENTS
    return (p02 + p12 * speed) * acceleration * acceleration


def path_power(speed: Tensor, acceleration: Tensor) -> Tensor:
    """Power of a path: :func:`steady_power` plus :func:`acceleration_loss`.

    Args:
        speed, acceleration: see :func:`acceleration_loss`.

    Returns:
        Power [W], same shape: A2 without the change of kinetic energy.
    """
    return steady_power(speed) + acceleration_loss(speed, acceleration)
