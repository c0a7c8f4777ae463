"""Adaptive cruise control by rules with constants: what a learned controller has to beat."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from torch import Tensor

from lcc_rl.functional.rules import idm_acc, linear_acc
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.world import MAX_ACCELERATION
from lcc_rl.settings import Positive


class Cruise(Controller):
    """A rule of own speed, gap and relative speed, held within the largest acceleration."""

    max_acceleration: Positive = MAX_ACCELERATION  # in both directions [m/s²]

    reads = ("self.speed", "self.gap", "self.relative_speed")
    law: ClassVar[Callable[..., Tensor]]
    constants_of_rule: ClassVar[tuple[str, ...]]  # settings that the law takes, in its order

    def command(self, speed: Tensor, gap: Tensor, relative_speed: Tensor) -> Tensor:
        """Return the commands."""
        constants = (getattr(self, name) for name in self.constants_of_rule)
        return type(self).law(speed, gap, relative_speed, *constants)


class IDMACC(Cruise):
    """Cruise control by the Intelligent Driver Model, :func:`lcc_rl.functional.rules.idm_acc`."""

    desired_speed: Positive = 25.0  # v0 [m/s]
    time_gap: Positive = 1.2  # T [s]
    acceleration: Positive = 1.0  # a [m/s²]
    deceleration: Positive = 1.5  # b [m/s²]
    min_gap: Positive = 2.0  # s0 [m]

    law = staticmethod(idm_acc)
    constants_of_rule = ("desired_speed", "time_gap", "acceleration", "deceleration", "min_gap")


class LinearACC(Cruise):
    """Cruise control with a constant time gap, :func:`lcc_rl.functional.rules.linear_acc`."""

    desired_speed: Positive = 25.0  # v_d [m/s]
    time_gap: Positive = 1.5  # T [s]
    min_gap: Positive = 2.0  # s0 [m]
    gap_gain: Positive = 0.1  # k_d [1/s²]
    speed_gain: Positive = 0.5  # k_v [1/s]

    law = staticmethod(linear_acc)
    constants_of_rule = ("desired_speed", "time_gap", "min_gap", "gap_gain", "speed_gain")
