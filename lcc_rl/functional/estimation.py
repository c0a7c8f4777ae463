"""Online estimation of a human driver's desired speed and time gap (A15).

With a, b and s0 known, A3 is linear in q = (v_ref/v0)^δ and quadratic in T. Each step therefore
allows one recursive update of (q, T) from a single scalar measurement, the follower's
acceleration by differencing; its memory is the estimate with its 2×2 covariance. Because the model
is exactly quadratic in T, the update accounts for the curvature, too (a second-order filter).
Without it, the first measurements move a wide belief about T too far. The calibrated population
is the prior. It keeps parameters plausible that a drive does not reveal, such as v0 in congestion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from lcc_rl.errors import require
from lcc_rl.functional.idm import IDMConstants, power
from lcc_rl.functional.layout import join, reverse

REFERENCE_SPEED = 15.0  # v_ref [m/s]; only scales q so that it is of order one


@dataclass(frozen=True)
class Belief:
    """Estimate of a driver: (q, T) and the upper triangle of their covariance.

    Args:
        estimate: (q, T), shape ``[*, 2]``.
        covariance: (C_qq, C_qT, C_TT), shape ``[*, 3]``.
    """

    estimate: Tensor
    covariance: Tensor


def prior(desired_speed: Tensor, time_gap: Tensor, exponent: float = 4.0) -> Belief:
    """Build the prior from a population of drivers.

    Args:
        desired_speed: v0 of each driver, shape ``[drivers]`` [m/s].
        time_gap: T of each driver, shape ``[drivers]`` [s].
        exponent: acceleration exponent δ.

    Returns:
        A belief of shapes ``[2]`` and ``[3]``; for one driver its variance is small and positive.
    """
    sample = torch.stack([(REFERENCE_SPEED / desired_speed) ** exponent, time_gap])
    centred = sample - sample.mean(1, keepdim=True)
    covariance = centred @ centred.T / max(sample.shape[1] - 1, 1)
    floor = torch.tensor([1e-4, 1e-4])
    variances = covariance.diagonal() + floor
    return Belief(sample.mean(1), torch.stack([variances[0], covariance[0, 1], variances[1]]))


def predict_and_update(
    speed: Tensor,
    gap: Tensor,
    approach_rate: Tensor,
    speed_reached: Tensor,
    belief: Belief,
    constants: IDMConstants,
    time_step: float,
    measurement_error: float,
) -> tuple[Tensor, Belief]:
    """Predict the acceleration of this step, then update the belief by the measured one (A15).

    The prediction uses the belief before the measurement. A step in which the follower stands or
    its acceleration is at its physical limit carries no information on (v0, T) and leaves the
    belief unchanged.

    Args:
        speed: the follower's speed at the start of the step, shape ``[*, 1]`` [m/s].
        gap: its gap, same shape [m].
        approach_rate: v − v_ahead, same shape [m/s].
        speed_reached: its speed at the end of the step, same shape [m/s].
        belief: the belief before the step.
        constants: the parameters assumed to be known.
        time_step: duration of the step [s].
        measurement_error: standard deviation of the measured acceleration about the model [m/s²].

    Returns:
        Predicted acceleration, shape ``[*, 1]`` [m/s²], and the new belief.
    """
    model = _linearised(speed, gap, approach_rate, belief.estimate, constants)
    measured = (speed_reached - speed) / time_step
    informative = (speed_reached > 0.0) & (measured.abs() < constants.acceleration_limit)
    return model.predicted, _updated(belief, model, measured, informative, measurement_error)


class _Linear(NamedTuple):
    """The IDM linearised at a belief: predicted acceleration and its slopes by q and T."""

    predicted: Tensor
    slope_q: Tensor
    slope_t: Tensor
    curvature: Tensor


def _linearised(
    speed: Tensor, gap: Tensor, approach_rate: Tensor, estimate: Tensor, constants: IDMConstants
) -> _Linear:
    q, time_gap = estimate[..., :1], estimate[..., 1:]
    root = 2.0 * (constants.acceleration * constants.deceleration) ** 0.5
    inverse_gap = gap.clamp(min=constants.gap_floor).reciprocal()
    dynamic = (speed * (time_gap + approach_rate / root)).clamp(min=0.0)
    ratio = (constants.min_gap + dynamic) * inverse_gap
    free = power(speed / REFERENCE_SPEED, constants.exponent)
    predicted = constants.limited(constants.acceleration * (1.0 - free * q - ratio * ratio))
    # The slope by T is zero where T does not matter.
    slope_t = (-2.0 * constants.acceleration) * ratio * (speed * inverse_gap) * (dynamic > 0.0)
    curvature = constants.acceleration * (speed * inverse_gap).square()
    return _Linear(predicted, -constants.acceleration * free, slope_t, curvature)


def _updated(
    belief: Belief, model: _Linear, measured: Tensor, informative: Tensor, measurement_error: float
) -> Belief:
    """Return the belief after one measured acceleration."""
    q, time_gap = belief.estimate[..., :1], belief.estimate[..., 1:]
    variance_q, covariance, variance_t = belief.covariance.split(1, dim=-1)
    slope_q, slope_t = model.slope_q, model.slope_t
    spread_q = variance_q * slope_q + covariance * slope_t
    spread_t = covariance * slope_q + variance_t * slope_t
    # The term in T² adds this to mean and variance of the model; exact for a Gaussian belief.
    curvature = model.curvature * variance_t
    total = slope_q * spread_q + slope_t * spread_t + 2.0 * curvature.square()
    weight = informative / (total + measurement_error**2)
    surprise = (measured - model.predicted + curvature) * weight
    variance_q = variance_q - spread_q * spread_q * weight
    covariance = covariance - spread_q * spread_t * weight
    variance_t = variance_t - spread_t * spread_t * weight
    q, time_gap = q + spread_q * surprise, time_gap + spread_t * surprise
    # A negative q has no meaning (q = 0 is an infinite v0). T is corrected along the covariance,
    # so that the pair stays on the ridge that the measurements allow.
    bounded = q.clamp(min=0.0)
    time_gap = time_gap + covariance / variance_q * (bounded - q)
    estimate = join([bounded, time_gap.clamp(0.05, 10.0)], -1)
    learned = join([variance_q, covariance, variance_t], -1)
    return Belief(estimate, learned)


class PopulationMean(torch.nn.Module):
    """Mean over the calibrated drivers of their IDM acceleration, at the cost of one driver (A15).

    The mean of (s0 + max(0, v(T_i + c)))² over the drivers is a quadratic in v and c with
    coefficients that depend only on which T_i exceed −c; they are tabulated once over the sorted
    T. The physical limits are applied to the mean rather than to each driver.

    Args:
        desired_speed: v0 of each driver, shape ``[drivers]`` [m/s].
        time_gap: T of each driver, shape ``[drivers]`` [s].
        constants: the shared parameters.

    Raises:
        ConfigError: if there is no driver.
    """

    thresholds: Tensor
    sums: Tensor

    def __init__(self, desired_speed: Tensor, time_gap: Tensor, constants: IDMConstants) -> None:
        super().__init__()
        require(len(time_gap) > 0, "the driver population is empty")
        ordered = time_gap.double().sort().values
        moments = torch.stack([torch.ones_like(ordered), ordered, ordered**2], dim=-1)
        above = moments.flip(0).cumsum(0).flip(0) / len(ordered)
        self.constants = constants
        self.inverse_power = float((desired_speed.double() ** -constants.exponent).mean())
        self.register_buffer("thresholds", ordered.float())
        self.register_buffer("sums", torch.cat([above, torch.zeros(1, 3)]).float())

    def forward(self, speed: Tensor, gap: Tensor, approach_rate: Tensor) -> Tensor:
        """Return the mean acceleration [m/s²]; arguments as for :class:`IDMConstants`."""
        known = self.constants
        shift = approach_rate * (0.5 / (known.acceleration * known.deceleration) ** 0.5)
        index = reverse(torch.searchsorted(self.thresholds, reverse(-shift.detach()).contiguous()))
        share, first, second = self.sums[index].unbind(-1)
        # Mean of max(0, T + c) and of its square.
        linear = first + shift * share
        squared = second + shift * (2.0 * first + shift * share)
        s0 = known.min_gap
        gap_squared = s0 * s0 + speed * (2.0 * s0 * linear + speed * squared)
        inverse_gap = gap.clamp(min=known.gap_floor).reciprocal()
        free = power(speed, known.exponent) * self.inverse_power
        square = gap_squared * (inverse_gap * inverse_gap)
        return known.limited(known.acceleration * (1.0 - free - square))
