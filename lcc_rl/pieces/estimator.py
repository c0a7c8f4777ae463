"""The estimator: what an automated vehicle believes of the human drivers behind it."""

from __future__ import annotations

from math import inf
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from lcc_rl.errors import require_in, require_positive
from lcc_rl.functional.estimation import Belief, PopulationMean, predict_and_update, prior
from lcc_rl.functional.pattern import HUMAN, VehicleString
from lcc_rl.pieces.base import Key, StepTransform
from lcc_rl.pieces.controllers import Population
from lcc_rl.pieces.views import Views


class DriverEstimator(StepTransform):
    """Predicts the acceleration of human drivers from what on-board sensors measure (A15).

    During the first ``learning_time`` the prediction is the mean over the calibrated drivers;
    afterwards it is the IDM with the (v0, T) fitted to this episode so far. Only speeds and gaps
    up to now are used; a driver's acceleration is the difference of its speeds.

    Writes under the role: ``"predicted_acceleration"`` of the step just taken, as predicted at
    its start, ``[*batch, n, 1]`` [m/s²], and the belief ``"estimate"`` ``[*batch, n, 2]`` and
    ``"covariance"`` ``[*batch, n, 3]`` (see
    :mod:`lcc_rl.functional.estimation`).

    Args:
        population: the calibrated drivers; what they share beside (v0, T) is taken as its mean.
        time_step: duration of a step [s].
        learning_time: time before the online fit is trusted [s]; None for the population mean
            throughout.
        measurement_error: standard deviation of the measured acceleration [m/s²].
        string: the string of vehicles; one human driver where not given.
        role: whose acceleration is predicted.

    Raises:
        ConfigError: if ``measurement_error`` is not positive or ``learning_time`` negative.
    """

    prior_estimate: Tensor
    prior_covariance: Tensor

    def __init__(
        self,
        population: Population,
        time_step: float,
        learning_time: float | None = 5.0,
        measurement_error: float = 0.05,
        string: VehicleString | None = None,
        role: str = HUMAN,
    ) -> None:
        where = "scenario.pieces.estimator"
        require_positive(where, measurement_error=measurement_error)
        if learning_time is not None:
            require_in(where, "[0, inf)", learning_time=learning_time)
        string = VehicleString((role,)) if string is None else string
        belief = [(role, "estimate"), (role, "covariance")]
        motion = [f"self.{name}" for name in ("speed", "gap", "relative_speed")]
        names = [*motion, *(".".join(key) for key in belief), "episode.step", "next.self.speed"]
        self.views = Views(string, role, names)
        super().__init__(
            self.views.keys,
            [(role, "predicted_acceleration"), *belief],
            event_shape=(string.count(role), 1),
        )
        self.time_step, self.measurement_error = time_step, measurement_error
        self.learning_steps = inf if learning_time is None else learning_time / time_step
        self.drivers = population.constants.shared()
        self.mean = PopulationMean(population.desired_speed, population.time_gap, self.drivers)
        start = prior(population.desired_speed, population.time_gap, self.drivers.exponent)
        self.register_buffer("prior_estimate", start.estimate)
        self.register_buffer("prior_covariance", start.covariance)

    def compute(self, *entries: Tensor) -> tuple[Tensor, ...]:
        """Return the predicted acceleration of the step and the belief after it."""
        speed, gap, relative_speed, estimate, covariance, step, reached = self.views(*entries)
        predicted, belief = predict_and_update(
            speed,
            gap,
            -relative_speed,
            reached,
            Belief(estimate, covariance),
            self.drivers,
            self.time_step,
            self.measurement_error,
        )
        early = step < self.learning_steps
        predicted = torch.where(early, self.mean(speed, gap, -relative_speed), predicted)
        return predicted, belief.estimate, belief.covariance

    def written_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Key, Any]:
        return {
            key: Unbounded(shape=(*batch, self.event_shape[0], width), device=device)
            for key, width in zip(self.targets, (1, 2, 3), strict=True)
        }

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        super().begin(given, start)
        for key, value in zip(
            self.targets[1:], (self.prior_estimate, self.prior_covariance), strict=True
        ):
            start.set(key, value.expand_as(start.get(key)).clone())
