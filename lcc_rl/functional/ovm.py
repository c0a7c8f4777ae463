"""Optimal velocity model and full velocity difference model.

Bando, Hasebe, Nakayama, Shibata, Sugiyama, "Dynamical model of traffic congestion and numerical
simulation", Physical Review E 51 (1995); Jiang, Wu, Zhu, "Full velocity difference model for a
car-following theory", Physical Review E 64 (2001).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lcc_rl.functional.driver_models import DriverConstants, DriverLaw, capped, limit


@dataclass(frozen=True)
class OVMConstants(DriverConstants):
    """The parameters that drivers of the optimal velocity model share.

    Args:
        sensitivity: κ, how fast the speed adapts to the optimal one [1/s].
        form: β, at which share of the transition the optimal speed rises most; 0: at s0.
        min_gap: gap s0 at which the optimal speed is zero [m].
        braking_limit: largest physical deceleration, positive [m/s²].
        acceleration_limit: largest physical acceleration [m/s²].

    Raises:
        ConfigError: if a parameter is not positive.
    """

    sensitivity: float = 1.0
    form: float = 1.5
    min_gap: float = 2.0
    braking_limit: float = 8.0
    acceleration_limit: float = 5.0


@dataclass(frozen=True)
class FVDMConstants(OVMConstants):
    """The parameters that drivers of the full velocity difference model share.

    Args:
        speed_gain: λ, the weight of the speed difference [1/s].
        sensitivity, form, min_gap, braking_limit, acceleration_limit: see :class:`OVMConstants`.

    Raises:
        ConfigError: if a parameter is not positive.
    """

    sensitivity: float = 0.41
    speed_gain: float = 0.5


def optimal_speed(
    gap: Tensor, desired_speed: Tensor | float, time_gap: Tensor | float, constants: OVMConstants
) -> Tensor:
    """Optimal speed V(s) = A (tanh((s − s0)/(A T) − β) + tanh β), A = v0/(1 + tanh β).

    Bando's function by quantities that other models have, too: it is 0 at s0 and v0 far ahead,
    and its steepest slope is 1/T. Bando's own, 16.8 m/s (tanh(0.086 (Δx − 25 m)) + 0.913), has
    v0 32.1 m/s, T 0.69 s and β 1.54.

    Args:
        gap: bumper-to-bumper gap s [m].
        desired_speed: v0 [m/s].
        time_gap: T [s].
        constants: the shared parameters.

    Returns:
        Speed, negative below s0 [m/s], broadcast over the arguments.
    """
    scale, offset = _scale(desired_speed, constants, gap)
    shift = (gap - constants.min_gap) / (scale * time_gap) - constants.form
    return scale * (shift.tanh() + offset)


def _scale(
    desired_speed: Tensor | float, constants: OVMConstants, like: Tensor
) -> tuple[Tensor, Tensor]:
    """Return A and tanh β."""
    offset = torch.as_tensor(constants.form, dtype=like.dtype, device=like.device).tanh()
    return desired_speed / (1.0 + offset), offset


def ovm_acceleration(
    speed: Tensor,
    gap: Tensor,
    approach_rate: Tensor,
    desired_speed: Tensor | float,
    time_gap: Tensor | float,
    constants: OVMConstants,
) -> Tensor:
    """Acceleration κ (V(s) − v) of the optimal velocity model, held within physical limits.

    Args:
        speed: speed v of the follower [m/s].
        gap: bumper-to-bumper gap s to the vehicle ahead [m].
        approach_rate: Δv = v − v_ahead; this model does not regard it [m/s].
        desired_speed: desired speed v0 [m/s].
        time_gap: T, see :func:`optimal_speed` [s].
        constants: the shared parameters.

    Returns:
        Acceleration [m/s²], broadcast over the arguments.
    """
    optimal = optimal_speed(gap, desired_speed, time_gap, constants)
    return limit(constants.sensitivity * (optimal - speed), constants)


def fvdm_acceleration(
    speed: Tensor,
    gap: Tensor,
    approach_rate: Tensor,
    desired_speed: Tensor | float,
    time_gap: Tensor | float,
    constants: FVDMConstants,
) -> Tensor:
    """Acceleration κ (V(s) − v) − λ Δv of the full velocity difference model.

    λ is the same at all gaps; the paper lets it be 0 beyond 100 m. Arguments and result as of
    :func:`ovm_acceleration`.
    """
    optimal = optimal_speed(gap, desired_speed, time_gap, constants)
    wanted = constants.sensitivity * (optimal - speed) - constants.speed_gain * approach_rate
    return limit(wanted, constants)


def ovm_equilibrium_gap(
    speed: Tensor,
    desired_speed: Tensor,
    time_gap: Tensor,
    constants: OVMConstants,
    cap_time_gap: float = 3.0,
) -> Tensor:
    """Gap with V(s) = v, of both models, capped as :func:`lcc_rl.functional.idm.equilibrium_gap`.

    Args:
        speed: common speed v [m/s].
        desired_speed: desired speed v0 [m/s].
        time_gap: T [s].
        constants: the shared parameters.
        cap_time_gap: time gap of the cap [s].

    Returns:
        Gap [m], broadcast over the arguments.
    """
    scale, offset = _scale(desired_speed, constants, speed)
    level = (speed / scale - offset).clamp(max=1.0 - 1e-6)
    gap = constants.min_gap + scale * time_gap * (level.atanh() + constants.form)
    return capped(gap, speed, constants, cap_time_gap)


_OWN = ("desired_speed", "time_gap", "min_gap", "sensitivity", "form")
OVM_LAW = DriverLaw(ovm_acceleration, ovm_equilibrium_gap, OVMConstants, _OWN)
FVDM_LAW = DriverLaw(fvdm_acceleration, ovm_equilibrium_gap, FVDMConstants, (*_OWN, "speed_gain"))
