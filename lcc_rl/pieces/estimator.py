"""The estimator: what an automated vehicle believes of the human drivers behind it."""

from __future__ import annotations

from math import inf
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from lcc_rl.functional.estimation import Belief, PopulationMean, predict_and_update, prior
from lcc_rl.functional.pattern import HUMAN
from lcc_rl.pieces.base import Key, StepTransform
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Positive


class DriverEstimator(StepTransform):
    """Predicts the acceleration of human drivers from what on-board sensors measure (A15).

    During the first ``learning_time`` the prediction is the mean over the calibrated drivers;
    afterwards it is the IDM with the (v0, T) fitted to this episode so far. Only speeds and gaps
    up to now are used; a driver's acceleration is the difference of its speeds.

    Writes under the role: ``"predicted_acceleration"`` of the step just taken, as predicted at
    its start, ``[*batch, n, 1]`` [m/s²], and the belief ``"estimate"`` ``[*batch, n, 2]`` and
    ``"covariance"`` ``[*batch, n, 3]`` (see
    :mod:`lcc_rl.functional.estimation`).
    """

    learning_time: NonNegative | None = 5.0  # until the fit is trusted; None: never [s]
    measurement_error: Positive = 0.05  # standard deviation of the acceleration [m/s²]
    role: str = HUMAN  # whose acceleration is predicted

    prior_estimate: ClassVar[Tensor]
    prior_covariance: ClassVar[Tensor]

    def setup(self, world: World) -> None:
        """Take what the drivers of the population have in common; what they share, as its mean."""
        role, population, time_step = self.role, world.population, world.time_step
        belief = [(role, "estimate"), (role, "covariance")]
        motion = [f"self.{name}" for name in ("speed", "gap", "relative_speed")]
        names = [*motion, *(".".join(key) for key in belief), "episode.step", "next.self.speed"]
        self.see(world, names, [(role, "predicted_acceleration"), *belief], role)
        self.time_step = time_step
        self.learning_steps = inf if self.learning_time is None else self.learning_time / time_step
        self.drivers = population.constants.mean()
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
