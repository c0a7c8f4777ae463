"""Motion of one vehicle and of the gap between two (ALCC A18)."""

from __future__ import annotations

from torch import Tensor


def advance_speed(speed: Tensor, acceleration: Tensor, time_step: float) -> tuple[Tensor, Tensor]:
    """Advance a speed by one step; no vehicle drives backwards (A18).

    Args:
        speed: current speed, any shape [m/s].
        acceleration: commanded acceleration, broadcastable to ``speed`` [m/s²].
        time_step: duration of the step T [s].

    Returns:
        The speed reached [m/s] and the executed acceleration [m/s²], which differs from the command
        only where the vehicle stops within the step.
    """
    reached = (speed + acceleration * time_step).clamp(min=0.0)
    return reached, (reached - speed) / time_step


def advance_gap(
    gap: Tensor,
    speed_ahead: Tensor,
    speed: Tensor,
    speed_ahead_reached: Tensor,
    speed_reached: Tensor,
    time_step: float,
) -> Tensor:
    """Advance the bumper-to-bumper gap by the trapezoidal rule (A18d).

    Args:
        gap: gap before the step [m].
        speed_ahead: speed of the vehicle ahead before the step [m/s].
        speed: speed of the vehicle itself before the step [m/s].
        speed_ahead_reached: speed of the vehicle ahead after the step [m/s].
        speed_reached: speed of the vehicle itself after the step [m/s].
        time_step: duration of the step T [s].

    Returns:
        The gap after the step [m]; zero or less means a collision.
    """
    closing = (speed_ahead - speed) + (speed_ahead_reached - speed_reached)
    return gap + 0.5 * time_step * closing
