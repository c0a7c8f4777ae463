"""Adaptive cruise control by rules with constants, the baselines of learned controllers."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor

from lcc_rl.functional.driver_models import Each
from lcc_rl.functional.idm import IDMConstants
from lcc_rl.pieces.controllers import Controller
from lcc_rl.settings import Positive, defaults


class Cruise(Controller):
    """A rule of own speed, gap and relative speed, clamped to the largest acceleration.

    The other settings of a class are the constants of its law, in this order.
    """

    max_acceleration: Positive | None = None  # None: the limits of the vehicles [m/s²]

    reads = ("self.speed", "self.gap", "self.relative_speed")
    observed = tuple((name,) for name in reads)  # as columns of an observation

    @classmethod
    def constants_of_rule(cls) -> dict[str, float]:
        """Return the constants of the law with their defaults."""
        return {name: x for name, x in defaults(cls).items() if name != "max_acceleration"}

    @staticmethod
    @abstractmethod
    def law(speed: Tensor, gap: Tensor, relative_speed: Tensor, *constants: Each) -> Tensor:
        """Return the acceleration [m/s²].

        Args:
            speed: own speed v [m/s].
            gap: bumper-to-bumper gap [m].
            relative_speed: v_ahead − v [m/s].
            *constants: see :meth:`constants_of_rule`.
        """

    def command(self, speed: Tensor, gap: Tensor, relative_speed: Tensor) -> Tensor:
        constants = (getattr(self, name) for name in self.constants_of_rule())
        return self.law(speed, gap, relative_speed, *constants)


class IDMACC(Cruise):
    """Cruise control by the Intelligent Driver Model (A3–A4)."""

    desired_speed: Positive = 25.0  # v0 [m/s]
    time_gap: Positive = 1.2  # T [s]
    acceleration: Positive = 1.0  # a [m/s²]
    deceleration: Positive = 1.5  # b [m/s²]
    min_gap: Positive = 2.0  # s0 [m]

    @staticmethod
    def law(speed: Tensor, gap: Tensor, relative_speed: Tensor, *constants: Each) -> Tensor:
        """Return the acceleration of the model [m/s²]."""
        desired_speed, time_gap, *shared = constants
        model = IDMConstants(*shared)  # type: ignore[arg-type]
        return model(speed, gap, -relative_speed, desired_speed, time_gap)


class LinearACC(Cruise):
    """Cruise control with a constant time gap.

    The lesser of k_d (gap − s0 − T v) + k_v (v_ahead − v) and k_v (v_d − v). The form is common,
    e.g. Milanés and Shladover, "Modeling cooperative and autonomous adaptive cruise control
    dynamic responses using experimental data", Transportation Research C 48 (2014).
    """

    desired_speed: Positive = 25.0  # v_d [m/s]
    time_gap: Positive = 1.5  # T [s]
    min_gap: Positive = 2.0  # s0 [m]
    gap_gain: Positive = 0.1  # k_d [1/s²]
    speed_gain: Positive = 0.5  # k_v [1/s]

    @staticmethod
    def law(speed: Tensor, gap: Tensor, relative_speed: Tensor, *constants: Each) -> Tensor:
        """Return the acceleration of the formula [m/s²]."""
        desired_speed, time_gap, min_gap, gap_gain, speed_gain = constants
        following = gap_gain * (gap - min_gap - time_gap * speed) + speed_gain * relative_speed
        return torch.minimum(following, speed_gain * (desired_speed - speed))
