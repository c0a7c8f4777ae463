"""The estimator: what the controlled car believes of the human driver behind it."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from lcc_rl.errors import ConfigError
from lcc_rl.functional.estimation import Belief, PopulationMean, predict_and_update, prior
from lcc_rl.pieces.base import STEP, Transition, following
from lcc_rl.pieces.vehicles import Population


class DriverEstimator(Transition):
    """Predicts the follower's acceleration from what on-board sensors measure (A15).

    During the first ``learning_time`` the prediction is the mean over the calibrated drivers;
    afterwards it is the IDM with the (v0, T) fitted to this episode so far. Only speeds and gaps
    up to now are used; the follower's acceleration is the difference of its speeds.

    Writes under ``name``: ``"predicted_acceleration"`` of the step just taken, as predicted at
    its start, shape ``[*batch, followers, 1]`` [m/s²], and the belief ``"estimate"``
    ``[*batch, followers, 2]`` and ``"covariance"`` ``[*batch, followers, 3]`` (see
    :mod:`lcc_rl.functional.estimation`).

    Args:
        population: the calibrated drivers.
        time_step: duration of a step [s].
        followers: human drivers observed.
        learning_time: time before the online fit is trusted [s]; infinite for the population
            mean throughout.
        measurement_error: standard deviation of the measured acceleration [m/s²].
        name: namespace of the followers.

    Raises:
        ConfigError: if ``measurement_error`` is not positive or ``learning_time`` negative.
    """

    prior_estimate: Tensor
    prior_covariance: Tensor

    def __init__(
        self,
        population: Population,
        time_step: float,
        followers: int = 1,
        learning_time: float = 5.0,
        measurement_error: float = 0.05,
        name: str = "hdv",
    ) -> None:
        if not measurement_error > 0:
            raise ConfigError(f"measurement_error must be positive, got {measurement_error}")
        if not learning_time >= 0:
            raise ConfigError(f"learning_time must not be negative, got {learning_time}")
        belief = [(name, "estimate"), (name, "covariance")]
        super().__init__(
            reads=[
                (name, "speed"),
                (name, "gap"),
                (name, "relative_speed"),
                *belief,
                STEP,
                following((name, "speed")),
            ],
            writes=[(name, "predicted_acceleration"), *belief],
            event_shape=(followers, 1),
        )
        self.time_step, self.measurement_error = time_step, measurement_error
        self.learning_steps = learning_time / time_step
        self.drivers = population.constants
        self.mean = PopulationMean(
            population.desired_speed, population.time_gap, population.constants
        )
        start = prior(population.desired_speed, population.time_gap, self.drivers.exponent)
        self.register_buffer("prior_estimate", start.estimate)
        self.register_buffer("prior_covariance", start.covariance)

    def compute(
        self,
        speed: Tensor,
        gap: Tensor,
        relative_speed: Tensor,
        estimate: Tensor,
        covariance: Tensor,
        step: Tensor,
        speed_reached: Tensor,
    ) -> tuple[Tensor, ...]:
        """Return the predicted acceleration of the step and the belief after it."""
        predicted, belief = predict_and_update(
            speed,
            gap,
            -relative_speed,
            speed_reached,
            Belief(estimate, covariance),
            self.drivers,
            self.time_step,
            self.measurement_error,
        )
        early = step.unsqueeze(-2) < self.learning_steps
        predicted = torch.where(early, self.mean(speed, gap, -relative_speed), predicted)
        return predicted, belief.estimate, belief.covariance

    def written_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Any, Any]:
        followers = self.event_shape[0]
        return {
            key: Unbounded(shape=(*batch, followers, width), device=device)
            for key, width in zip(self._arrival_keys, (1, 2, 3), strict=True)
        }

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        super().begin(given, start)
        for key, value in zip(
            self._arrival_keys[1:], (self.prior_estimate, self.prior_covariance), strict=True
        ):
            start.set(key, value.expand_as(start.get(key)).clone())
