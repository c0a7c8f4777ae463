"""Reward terms of platoons: speed, jerk and place (HCFS H4–H6)."""

from __future__ import annotations

from torch import Tensor

from lcc_rl.pieces.rewards import RewardTerm
from lcc_rl.settings import NonNegative, Positive


class VelocityReward(RewardTerm):
    """−|e_v(i,0)|/v_max, at the state reached (HCFS H4–H5)."""

    weight: NonNegative = 10.0  # ω1; Table IV determines ω1/v_max only
    speed_scale: Positive = 27.1  # v_max [m/s]

    reads = ("self.leader_speed_error",)

    def reward(self, speed_error: Tensor) -> Tensor:
        """Return the unweighted term."""
        return -speed_error.abs() / self.speed_scale


class JerkReward(RewardTerm):
    """−|jerk|/(2 a_max/T) (HCFS H6)."""

    weight: NonNegative = 0.036  # ω2
    jerk_scale: Positive = 30.0  # 2 a_max/T [m/s³]

    reads = ("self.jerk",)

    def reward(self, jerk: Tensor) -> Tensor:
        """Return the unweighted term."""
        return -jerk.abs() / self.jerk_scale


class SpacingReward(RewardTerm):
    """−(e_x(i,0)/gap_scale)²: the place behind the leader, which the HCFS paper's reward lacks.

    e_x(i,0) is the sum of the gap errors up to the leader: where it is zero for all vehicles of a
    platoon, all gaps equal the headway. The gap to the vehicle ahead alone would teach a vehicle
    to repeat what that one does, and errors to grow along the platoon.
    """

    weight: NonNegative = 0.02  # ω3
    gap_scale: Positive = 1.0  # deviation that costs ω3 [m]

    reads = ("self.leader_gap_error",)

    def reward(self, gap_error: Tensor) -> Tensor:
        """Return the unweighted term."""
        return -(gap_error / self.gap_scale).square()
