"""Surrogate safety and efficiency measures: time-to-collision and time gap (A10, A12)."""

from __future__ import annotations

import torch
from torch import Tensor

NEVER = 1e3  # "no contact ahead": a finite input for learners, not a measured time [s]


def time_to_collision(gap: Tensor, approach_rate: Tensor, floor: float = 0.01) -> Tensor:
    """Time until contact at constant speeds (A10).

    Args:
        gap: bumper-to-bumper gap [m].
        approach_rate: v − v_ahead, positive when closing [m/s].
        floor: smallest value returned, also after a collision [s].

    Returns:
        Time-to-collision [s], at most 1000 s, also where the gap does not close; always positive,
        so that its logarithm is finite.
    """
    closing = approach_rate > 0.0
    # where() on both sides of the division keeps the gradient free of 0·inf.
    time = (gap / torch.where(closing, approach_rate, 1.0)).clamp(floor, NEVER)
    return torch.where(gap <= 0.0, floor, torch.where(closing, time, NEVER))


def time_gap(gap: Tensor, speed: Tensor, speed_floor: float = 1.0) -> Tensor:
    """Time gap d/v to the vehicle ahead (A12).

    Args:
        gap: bumper-to-bumper gap [m].
        speed: speed of the follower [m/s].
        speed_floor: lower speeds count as this, so that standing in a jam costs nothing. 0 is the
            literal rule, in which the time gap at standstill is infinite [m/s].

    Returns:
        Time gap [s], at most 1000 s.
    """
    return (gap / speed.clamp(min=max(speed_floor, 1e-6))).clamp(max=NEVER)
