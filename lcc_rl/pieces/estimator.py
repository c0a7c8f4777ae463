"""The estimator of the human drivers behind an automated vehicle."""

from __future__ import annotations

from math import inf
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.functional.estimation import Belief, PopulationMean, predict_and_update, prior
from lcc_rl.functional.pattern import HUMAN
from lcc_rl.pieces.base import Entry, StepTransform
from lcc_rl.pieces.views import MOTION_READS
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Positive


class DriverEstimator(StepTransform):
    """Predicts the acceleration of human drivers from what on-board sensors measure (A15).

    During the first ``learning_time`` the prediction is the mean over the calibrated drivers;
    afterwards it is the IDM with the (v0, T) fitted to this episode so far. Only speeds and gaps
    up to now are used; a driver's acceleration is the difference of its speeds. See
    :mod:`lcc_rl.functional.estimation`.
    """

    learning_time: NonNegative | None = 5.0  # until the fit is trusted; None: never [s]
    measurement_error: Positive = 0.05  # standard deviation of the acceleration [m/s²]
    role: str = HUMAN  # role of the predicted drivers

    writes = (
        Entry("role.predicted_acceleration", "m/s²", "acceleration of the last step as predicted"),
        Entry("role.estimate", "–, s", "estimated (q, T), q = (15 m/s / v0)^δ", 2),
        Entry("role.covariance", "–, s, s²", "its covariance (C_qq, C_qT, C_TT)", 3),
    )
    reads_drivers = True
    prior_estimate: ClassVar[Tensor]
    prior_covariance: ClassVar[Tensor]

    def setup(self, world: World) -> None:
        """Read the population: mean of parameters that differ by driver, and the prior."""
        role, time_step = self.role, world.time_step
        population = world.given("population", self.title)
        belief = (f"{role}.estimate", f"{role}.covariance")
        self.declare(world, [*MOTION_READS, *belief, "episode.step", "next.self.speed"])
        self.time_step = time_step
        self.learning_steps = inf if self.learning_time is None else self.learning_time / time_step
        self.drivers = population.constants.mean()
        self.mean = PopulationMean(population.desired_speed, population.time_gap, self.drivers)
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
        reached: Tensor,
    ) -> tuple[Tensor, ...]:
        """Return the predicted acceleration of the step and the belief after it."""
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

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        super().begin(given, start)
        priors = (self.prior_estimate, self.prior_covariance)
        for key, value in zip(self.targets[1:], priors, strict=True):
            start.set(key, value.expand_as(start.get(key)).clone())
