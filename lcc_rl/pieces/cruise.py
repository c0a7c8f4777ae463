"""Adaptive cruise control by rules with constants: what a learned controller has to beat."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from torch import Tensor

from lcc_rl.errors import require_positive
from lcc_rl.functional.pattern import AUTOMATED, VehicleString
from lcc_rl.functional.rules import idm_acc, linear_acc
from lcc_rl.pieces.controllers import Controller


class Cruise(Controller):
    """A rule of own speed, gap and relative speed, held within the largest acceleration.

    Args:
        constants: of the rule, in its order; all positive.
        max_acceleration: limit in both directions [m/s²].
        string, role: see :class:`lcc_rl.pieces.controllers.Controller`.

    Raises:
        ConfigError: if a constant or the limit is not positive.
    """

    reads = ("self.speed", "self.gap", "self.relative_speed")
    law: ClassVar[Callable[..., Tensor]]

    def __init__(
        self,
        constants: dict[str, float],
        max_acceleration: float,
        string: VehicleString | None,
        role: str,
    ) -> None:
        limits = {**constants, "max_acceleration": max_acceleration}
        require_positive(f"scenario.controllers.{role}", **limits)
        super().__init__(string, role)
        self.constants_of_rule = tuple(constants.values())
        self.max_acceleration = max_acceleration

    def command(self, speed: Tensor, gap: Tensor, relative_speed: Tensor) -> Tensor:
        """Return the commands."""
        wanted = type(self).law(speed, gap, relative_speed, *self.constants_of_rule)
        return wanted.clamp(-self.max_acceleration, self.max_acceleration)


class IDMACC(Cruise):
    """Cruise control by the Intelligent Driver Model, :func:`lcc_rl.functional.rules.idm_acc`.

    Args:
        desired_speed: v0 [m/s].
        time_gap: T [s].
        acceleration: a [m/s²].
        deceleration: b [m/s²].
        min_gap: s0 [m].
        max_acceleration, string, role: see :class:`Cruise`.

    Raises:
        ConfigError: if a setting is not positive.
    """

    law = staticmethod(idm_acc)

    def __init__(
        self,
        desired_speed: float = 25.0,
        time_gap: float = 1.2,
        acceleration: float = 1.0,
        deceleration: float = 1.5,
        min_gap: float = 2.0,
        max_acceleration: float = 3.0,
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        constants = {
            "desired_speed": desired_speed,
            "time_gap": time_gap,
            "acceleration": acceleration,
            "deceleration": deceleration,
            "min_gap": min_gap,
        }
        super().__init__(constants, max_acceleration, string, role)


class LinearACC(Cruise):
    """Cruise control with a constant time gap, :func:`lcc_rl.functional.rules.linear_acc`.

    Args:
        desired_speed: v_d [m/s].
        time_gap: T [s].
        min_gap: s0 [m].
        gap_gain: k_d [1/s²].
        speed_gain: k_v [1/s].
        max_acceleration, string, role: see :class:`Cruise`.

    Raises:
        ConfigError: if a setting is not positive.
    """

    law = staticmethod(linear_acc)

    def __init__(
        self,
        desired_speed: float = 25.0,
        time_gap: float = 1.5,
        min_gap: float = 2.0,
        gap_gain: float = 0.1,
        speed_gain: float = 0.5,
        max_acceleration: float = 3.0,
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        constants = {
            "desired_speed": desired_speed,
            "time_gap": time_gap,
            "min_gap": min_gap,
            "gap_gain": gap_gain,
            "speed_gain": speed_gain,
        }
        super().__init__(constants, max_acceleration, string, role)
