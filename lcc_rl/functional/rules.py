"""Published rules for smoothing traffic, as functions of what a vehicle measures."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def follower_stopper_speed(
    speed: Tensor,
    gap: Tensor,
    ahead: Tensor,
    desired_speed: Tensor,
    gaps: Sequence[float],
    time_gaps: Sequence[float],
    decelerations: Sequence[float],
) -> Tensor:
    """Return the speed that FollowerStopper commands (Stern et al. 2018, arXiv 1705.01693).

    Three gaps Δx_k = max(Δx⁰_k, h_k v) + Δv₋²/(2 d_k), Δv₋ = min(v_ahead − v, 0), bound regions of
    the gap: below Δx₁ stop, then rise to ṽ = min(max(v_ahead, 0), v_d) at Δx₂, then to v_d at Δx₃.
    The original form has h = 0.

    Args:
        speed: own speed v [m/s].
        gap: bumper-to-bumper gap Δx [m].
        ahead: speed of the vehicle ahead [m/s].
        desired_speed: v_d [m/s].
        gaps: Δx⁰_k, three [m].
        time_gaps: h_k, three [s].
        decelerations: d_k, three [m/s²].

    Returns:
        The speed [m/s], of the arguments' shape.
    """
    closing = (ahead - speed).clamp(max=0.0).square()
    near, middle, far = (
        (time_gap * speed).clamp(min=least) + closing / (2.0 * deceleration)
        for least, time_gap, deceleration in zip(gaps, time_gaps, decelerations, strict=True)
    )
    safe = torch.minimum(ahead.clamp(min=0.0), desired_speed)
    rising = safe * (gap - near) / (middle - near)
    freeing = safe + (desired_speed - safe) * (gap - middle) / (far - middle)
    commanded = torch.where(gap < far, freeing, desired_speed)
    commanded = torch.where(gap < middle, rising, commanded)
    return torch.where(gap < near, torch.zeros_like(commanded), commanded)
