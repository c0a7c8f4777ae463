"""Reward terms of platoons: speed, jerk and place (HCFS H4–H6)."""

from __future__ import annotations

from torch import Tensor

from lcc_rl.errors import require_positive
from lcc_rl.functional.pattern import VehicleString
from lcc_rl.pieces.rewards import RewardTerm


class VelocityReward(RewardTerm):
    """−|e_v(i,0)|/v_max, at the state reached (HCFS H4–H5).

    Args:
        name, weight, string: see :class:`RewardTerm`; ω1.
        speed_scale: v_max [m/s].

    Raises:
        ConfigError: if the scale is not positive.
    """

    reads = ("self.leader_speed_error",)

    def __init__(
        self,
        name: str = "velocity",
        weight: float = 10.0,
        speed_scale: float = 27.1,
        string: VehicleString | None = None,
    ) -> None:
        require_positive(f"reward.terms.{name}", speed_scale=speed_scale)
        super().__init__(name, weight, string=string)
        self.speed_scale = speed_scale

    def reward(self, speed_error: Tensor) -> Tensor:
        """Return the unweighted term."""
        return -speed_error.abs() / self.speed_scale


class JerkReward(RewardTerm):
    """−|jerk|/(2 a_max/T) (HCFS H6).

    Args:
        name, weight, string: see :class:`RewardTerm`; ω2.
        jerk_scale: 2 a_max/T [m/s³].

    Raises:
        ConfigError: if the scale is not positive.
    """

    reads = ("self.jerk",)

    def __init__(
        self,
        name: str = "jerk",
        weight: float = 0.036,
        jerk_scale: float = 30.0,
        string: VehicleString | None = None,
    ) -> None:
        require_positive(f"reward.terms.{name}", jerk_scale=jerk_scale)
        super().__init__(name, weight, string=string)
        self.jerk_scale = jerk_scale

    def reward(self, jerk: Tensor) -> Tensor:
        """Return the unweighted term."""
        return -jerk.abs() / self.jerk_scale


class SpacingReward(RewardTerm):
    """−(e_x(i,0)/gap_scale)²: the place behind the leader, which the HCFS paper's reward lacks.

    e_x(i,0) is the sum of the gap errors up to the leader: where it is zero for all vehicles of a
    platoon, all gaps equal the headway. The gap to the vehicle ahead alone would teach a vehicle
    to repeat what that one does, and errors to grow along the platoon.

    Args:
        name, weight, string: see :class:`RewardTerm`; ω3.
        gap_scale: deviation that costs ω3 [m].

    Raises:
        ConfigError: if the scale is not positive.
    """

    reads = ("self.leader_gap_error",)

    def __init__(
        self,
        name: str = "spacing",
        weight: float = 0.02,
        gap_scale: float = 1.0,
        string: VehicleString | None = None,
    ) -> None:
        require_positive(f"reward.terms.{name}", gap_scale=gap_scale)
        super().__init__(name, weight, string=string)
        self.gap_scale = gap_scale

    def reward(self, gap_error: Tensor) -> Tensor:
        """Return the unweighted term."""
        return -(gap_error / self.gap_scale).square()
