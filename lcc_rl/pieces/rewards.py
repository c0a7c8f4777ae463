"""Rewards: named, weighted terms per automated vehicle, each logged separately, and their sum.

Your own term is a class with its settings (:mod:`lcc_rl.settings`), the names of the entries that
it reads (:mod:`lcc_rl.pieces.views`) and its formula::

    class Comfort(RewardTerm):
        limit: Positive = 2.0    # jerk below notice [m/s³]
        reads = ("self.jerk",)
        def reward(self, jerk): return -(jerk.abs() - self.limit).clamp(min=0.0)

and ``+reward.terms.comfort={_target_: mymodule.Comfort, weight: 0.1}`` on the command line.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor
from torchrl.data import Composite

from lcc_rl.errors import require
from lcc_rl.functional.hcfs import PlatoonReward
from lcc_rl.functional.layout import total
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.functional.safety import time_to_collision
from lcc_rl.pieces.base import REWARD, AfterStep, Entry, RewardPiece, add_specs, returned
from lcc_rl.pieces.sections import Sections
from lcc_rl.pieces.views import VEHICLES
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Positive

TERMS = (AUTOMATED, "reward_terms")
TOUCH = 1e-6  # gap that counts within the margin: positive, so no collision [m]


class RewardTerm(RewardPiece):
    """Base of all terms: writes ``("automated", "reward_terms", name)``, ``[*batch, A, 1]``.

    The name is the key under ``reward.terms``; by default it follows from that of the class.
    """

    weight: NonNegative = 1.0  # factor of the term; 0 removes it

    writes = (Entry("automated.reward_terms.name", "–", "weighted term of the reward"),)
    graded: ClassVar[bool] = True  # whether the gradient learner can follow the term
    # Maps the entries read, one row per automated vehicle, to the unweighted term, [*batch, A, 1].
    reward: ClassVar[Callable[..., Tensor]]

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        cls.name = re.sub("(Reward|Penalty)$", "", cls.__name__).lower()

    def compute(self, *entries: Tensor) -> Tensor:
        (term,) = returned(self.reward(*entries))
        return self.weight * term


class SafetyReward(RewardTerm):
    """R_safe = log(TTC / threshold) where TTC is below the threshold, else 0 (A10–A11).

    TTC is the time until the gap equals ``margin``; within the margin it is 0 while the gap closes.
    The literal rule, margin 0, does not penalise creeping up to a standing leader until the bumpers
    touch, because TTC stays large at low speed. A gap that does not close costs nothing, as in A10,
    unless it is a collision.
    """

    threshold: Positive = 4.0  # time-to-collision above which the term is 0 [s]
    floor: Positive = 0.01  # time-to-collision below which the term is constant [s]
    margin: NonNegative = 1.0  # gap that counts as contact [m]

    reads = ("self.gap", "self.relative_speed")

    def validate(self) -> None:
        if self.floor >= self.threshold:
            raise ValueError(f"floor={self.floor} must be below threshold={self.threshold}")

    def reward(self, gap: Tensor, relative_speed: Tensor) -> Tensor:
        room = torch.where(gap > 0.0, (gap - self.margin).clamp(min=TOUCH), gap)
        ttc = time_to_collision(room, -relative_speed, self.floor)
        return (ttc.clamp(max=self.threshold) / self.threshold).log()


class EfficiencyReward(RewardTerm):
    """R_eff = −1 where the time gap is at least the threshold, else 0 (A12–A13)."""

    threshold: Positive = 2.5  # time gap that is too long [s]

    reads = ("self.time_gap",)

    def reward(self, time_gap: Tensor) -> Tensor:
        return -(time_gap >= self.threshold).to(time_gap.dtype)


class EnergyReward(RewardTerm):
    """R = −P/scale · T: energy of the step just taken (A14 for the CAV, A16 for the HDV)."""

    scale: Positive = 20000.0  # power that costs 1 per second [W]
    # Vehicle whose energy counts; of those behind, all back to the next automated one.
    of: Literal["self", "behind", "string"] = "self"
    # "human.predicted_power": as the automated vehicle estimates it (A16).
    power: str = "vehicles.power"

    def setup(self, world: World) -> None:
        """Choose the entries for ``of``."""
        space, _, entry = self.power.partition(".")
        own = f"self.{entry}" if space == VEHICLES else self.power
        self.sections = Sections(world.string, space)
        indices = self.sections.keys if self.of == "behind" else []
        self.factor = world.time_step / self.scale
        self.declare(world, [own if self.of == "self" else self.power, *indices])

    def reward(self, power: Tensor, *indices: Tensor) -> Tensor:
        if self.of == "behind":
            power = self.sections.sum(power, *indices)
        elif self.of == "string":
            power = total(power, -2).expand(*power.shape[:-2], *self.event_shape)
        return power * -self.factor


class CollisionPenalty(RewardTerm):
    """Minus the weight in the step that ends in a collision, so that a collision never pays off.

    All other terms are at most 0 and end with the episode. Without this term an agent with a long
    horizon learns to collide early. It is the term of the automated vehicle that hit the vehicle
    ahead.
    """

    weight: NonNegative = 100.0  # must exceed the worst discounted objective that remains
    behind: bool = True  # count collisions behind, back to the next automated vehicle, too

    graded = False

    def setup(self, world: World) -> None:
        """Find which vehicles are behind."""
        self.sections = Sections(world.string, VEHICLES)
        self.declare(world, ["self.gap", "vehicles.gap", *self.sections.keys])

    def reward(self, gap: Tensor, gaps: Tensor, *indices: Tensor) -> Tensor:
        hit = gap <= 0.0
        if self.behind:
            hit = hit | (self.sections.sum((gaps <= 0.0).to(gap.dtype), *indices) > 0.0)
        return -hit.to(gap.dtype)


class VelocityReward(RewardTerm):
    """−|e_v(i,0)|/v_max, at the state reached (HCFS H4–H5)."""

    weight: NonNegative = PlatoonReward.velocity_weight  # ω1; Table IV determines ω1/v_max only
    speed_scale: Positive = PlatoonReward.speed_scale  # v_max [m/s]

    reads = ("self.leader_speed_error",)

    def reward(self, speed_error: Tensor) -> Tensor:
        return -speed_error.abs() / self.speed_scale


class JerkReward(RewardTerm):
    """−|jerk|/(2 a_max/T) (HCFS H6)."""

    weight: NonNegative = PlatoonReward.jerk_weight  # ω2
    jerk_scale: Positive = PlatoonReward.jerk_scale  # 2 a_max/T [m/s³]

    reads = ("self.jerk",)

    def reward(self, jerk: Tensor) -> Tensor:
        return -jerk.abs() / self.jerk_scale


class SpacingReward(RewardTerm):
    """−(e_x(i,0)/gap_scale)²: the position behind the leader; not in the reward of the HCFS paper.

    e_x(i,0) is the sum of the gap errors up to the leader. If it is zero for all vehicles of a
    platoon, all gaps equal the headway. With the gap to the vehicle ahead instead, vehicles learn
    to repeat its motion, and errors grow along the platoon.
    """

    weight: NonNegative = 0.02  # ω3
    gap_scale: Positive = 1.0  # deviation that costs ω3 [m]

    reads = ("self.leader_gap_error",)

    def reward(self, gap_error: Tensor) -> Tensor:
        return -(gap_error / self.gap_scale).square()


class TotalReward(AfterStep, RewardPiece):
    """Writes ``("automated", "reward")``: the sum of all terms (A17, A19), ``[*batch, A, 1]``.

    It is the only entry of the environment's reward spec. It exists after a step, not at reset.
    """

    terms: Sequence[str]  # their names

    writes = (Entry(REWARD, "–", "sum of the terms"),)

    def setup(self, world: World) -> None:
        require(self.terms, "reward.terms is empty: an environment needs at least one term")
        self.declare(world, [(*TERMS, name) for name in self.terms])

    def compute(self, *entries: Tensor) -> Tensor:
        return torch.stack(entries).sum(0)

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        return add_specs(self, reward_spec)
