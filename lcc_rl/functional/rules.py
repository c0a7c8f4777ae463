"""Published rules for smoothing traffic, as functions of what a vehicle measures."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lcc_rl.functional.idm import IDMConstants, idm_acceleration


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


def pi_saturation_speed(
    speed: Tensor,
    gap: Tensor,
    ahead: Tensor,
    desired_speed: Tensor,
    commanded: Tensor,
    gaps: Sequence[float] = (7.0, 30.0),
    catch_up: float = 1.0,
    least_gap: float = 4.0,
    closing_time: float = 2.0,
    transition: float = 2.0,
) -> Tensor:
    """Return the speed that PI with saturation commands (Stern et al. 2018, arXiv 1705.01693).

    v_target = v_d + c·min(max((Δx − g_l)/(g_u − g_l), 0), 1); Δx_s = max(2 s·(v − v_ahead), 4 m);
    α = min(max((Δx − Δx_s)/γ, 0), 1), β = 1 − α/2; the command becomes
    β(α v_target + (1 − α) v_ahead) + (1 − β) times the command before.

    Args:
        speed: own speed v [m/s].
        gap: bumper-to-bumper gap Δx [m].
        ahead: speed of the vehicle ahead [m/s].
        desired_speed: v_d, the mean of the own speed [m/s].
        commanded: the command before [m/s].
        gaps: g_l and g_u, between which catching up sets in [m].
        catch_up: c, by how much the target may exceed the mean [m/s].
        least_gap: least Δx_s [m].
        closing_time: how long closing in may take [s].
        transition: γ [m].

    Returns:
        The speed [m/s], of the arguments' shape.
    """
    lower, upper = gaps
    target = desired_speed + catch_up * ((gap - lower) / (upper - lower)).clamp(0.0, 1.0)
    safe = (closing_time * (speed - ahead)).clamp(min=least_gap)
    share = ((gap - safe) / transition).clamp(0.0, 1.0)
    weight = 1.0 - 0.5 * share
    return weight * (share * target + (1.0 - share) * ahead) + (1.0 - weight) * commanded


def idm_acc(
    speed: Tensor,
    gap: Tensor,
    relative_speed: Tensor,
    desired_speed: Tensor | float,
    time_gap: Tensor | float,
    acceleration: Tensor | float,
    deceleration: Tensor | float,
    min_gap: Tensor | float,
) -> Tensor:
    """Return the acceleration of a cruise control by the Intelligent Driver Model (A3–A4).

    Args:
        speed: own speed v [m/s].
        gap: bumper-to-bumper gap [m].
        relative_speed: v_ahead − v [m/s].
        desired_speed: v0 [m/s].
        time_gap: T [s].
        acceleration: a [m/s²].
        deceleration: b [m/s²].
        min_gap: s0 [m].

    Returns:
        Acceleration [m/s²], of the arguments' shape.
    """
    shared = IDMConstants().with_(
        acceleration=acceleration, deceleration=deceleration, min_gap=min_gap
    )
    return idm_acceleration(speed, gap, -relative_speed, desired_speed, time_gap, shared)


def linear_acc(
    speed: Tensor,
    gap: Tensor,
    relative_speed: Tensor,
    desired_speed: Tensor | float,
    time_gap: Tensor | float,
    min_gap: Tensor | float,
    gap_gain: Tensor | float,
    speed_gain: Tensor | float,
) -> Tensor:
    """Return the acceleration of linear adaptive cruise control (constant time gap policy).

    k_d (gap − s0 − T v) + k_v (v_ahead − v), or k_v (v_d − v) where that is less: the usual form,
    e.g. Milanés and Shladover, "Modeling cooperative and autonomous adaptive cruise control
    dynamic responses using experimental data", Transportation Research C 48 (2014).

    Args:
        speed: own speed v [m/s].
        gap: bumper-to-bumper gap [m].
        relative_speed: v_ahead − v [m/s].
        desired_speed: v_d [m/s].
        time_gap: T [s].
        min_gap: gap s0 at standstill [m].
        gap_gain: k_d [1/s²].
        speed_gain: k_v [1/s].

    Returns:
        Acceleration [m/s²], of the arguments' shape.
    """
    following = gap_gain * (gap - min_gap - time_gap * speed) + speed_gain * relative_speed
    return torch.minimum(following, speed_gain * (desired_speed - speed))
