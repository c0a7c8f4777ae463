"""Rewards: named, weighted terms, each logged by itself, and their sum.

A new term is a class with the entries it reads and its formula::

    class Comfort(RewardTerm):
        reads = ("cav.jerk",)
        def reward(self, jerk): return -jerk.abs()

and ``+reward.terms.comfort={_target_: mymodule.Comfort, weight: 0.1}`` on the command line.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from lcc_rl.errors import ConfigError
from lcc_rl.functional.safety import time_to_collision
from lcc_rl.pieces.base import RewardPiece

TERMS = "reward_terms"
REWARD = "reward"


class RewardTerm(RewardPiece):
    """Base of all terms: writes ``("reward_terms", name)``, shape ``[*batch, 1]``.

    Args:
        name: name of the term; the key under ``reward.terms`` in the configuration.
        weight: factor of the term; 0 takes it out.
        reads: entries read, where they depend on settings.
        event_shape: shape of the term after the batch dimensions; ``(followers, 1)`` where every
            follower of a platoon earns its own.

    Raises:
        ConfigError: if the weight is not a finite number.
    """

    reads: ClassVar[tuple[NestedKey, ...]] = ()
    # Maps the entries read to the unweighted term, [*batch, 1].
    reward: Callable[..., Tensor]

    def __init__(
        self,
        name: str,
        weight: float = 1.0,
        reads: Sequence[NestedKey] | None = None,
        event_shape: Sequence[int] = (1,),
    ) -> None:
        if not math.isfinite(weight):
            raise ConfigError(f"reward.terms.{name}.weight must be finite, got {weight}")
        super().__init__(self.reads if reads is None else reads, [(TERMS, name)], event_shape)
        self.name, self.weight = name, weight

    def compute(self, *entries: Tensor) -> Tensor:
        """Return the weighted term."""
        return self.weight * self.reward(*entries)


class SafetyReward(RewardTerm):
    """R_safe = log(TTC / threshold) where TTC is below the threshold, else 0 (A10–A11).

    The time is that until the gap has shrunk to the ``margin``. The literal rule, margin 0, says
    nothing against creeping up to a standing leader until the bumpers touch: slowly enough, TTC
    stays large.

    Args:
        name, weight: see :class:`RewardTerm`.
        threshold: time-to-collision that is safe enough [s].
        floor: time-to-collision below which the term no longer falls [s].
        margin: gap that counts as contact [m].
        vehicle: namespace of the vehicle.
    """

    def __init__(
        self,
        name: str = "safety",
        weight: float = 1.0,
        threshold: float = 4.0,
        floor: float = 0.01,
        margin: float = 1.0,
        vehicle: str = "cav",
    ) -> None:
        if not 0 < floor < threshold:
            raise ConfigError(f"reward.terms.{name}: floor {floor} must be below {threshold}")
        if not margin >= 0:
            raise ConfigError(f"reward.terms.{name}.margin must not be negative, got {margin}")
        super().__init__(name, weight, [(vehicle, "gap"), (vehicle, "relative_speed")])
        self.threshold, self.floor, self.margin = threshold, floor, margin

    def reward(self, gap: Tensor, relative_speed: Tensor) -> Tensor:
        """Return the unweighted term."""
        ttc = time_to_collision(gap - self.margin, -relative_speed, self.floor)
        return (ttc.clamp(max=self.threshold) / self.threshold).log()


class EfficiencyReward(RewardTerm):
    """R_eff = −1 where the time gap is at least the threshold, else 0 (A12–A13).

    Args:
        name, weight: see :class:`RewardTerm`.
        threshold: time gap that is too long [s].
        vehicle: namespace of the vehicle.
    """

    def __init__(
        self,
        name: str = "efficiency",
        weight: float = 1.0,
        threshold: float = 2.5,
        vehicle: str = "cav",
    ) -> None:
        super().__init__(name, weight, [(vehicle, "time_gap")])
        self.threshold = threshold

    def reward(self, time_gap: Tensor) -> Tensor:
        """Return the unweighted term."""
        return -(time_gap >= self.threshold).to(time_gap.dtype)


class EnergyReward(RewardTerm):
    """R = −P/scale · T: energy of the step just taken (A14 for the CAV, A16 for the HDV).

    Args:
        time_step: duration of a step [s].
        name, weight: see :class:`RewardTerm`.
        scale: power that costs 1 per second [W].
        vehicle: namespace of the vehicle.
        power: entry that holds the power; ``"predicted_power"`` for the follower as estimated
            (A16), ``"power"`` for the true one.
        followers: the entry belongs to a string of followers, ``[*batch, followers, 1]``, and is
            summed over it.
    """

    def __init__(
        self,
        time_step: float,
        name: str = "energy",
        weight: float = 1.0,
        scale: float = 20000.0,
        vehicle: str = "cav",
        power: str = "power",
        followers: bool = False,
    ) -> None:
        if not scale > 0:
            raise ConfigError(f"reward.terms.{name}.scale must be positive, got {scale}")
        super().__init__(name, weight, [(vehicle, power)])
        self.factor, self.followers = time_step / scale, followers

    def reward(self, power: Tensor) -> Tensor:
        """Return the unweighted term."""
        if self.followers:
            power = power.sum(-2)
        return power * -self.factor


class CollisionPenalty(RewardTerm):
    """Minus the weight in the step that ends in a collision, so that a crash never pays.

    Every other term is at most 0 and ends with the episode; without this one an agent with a long
    horizon learns that crashing early is cheap.

    Args:
        name, weight: see :class:`RewardTerm`; the weight is the penalty.
    """

    reads = ("terminated",)

    def __init__(self, name: str = "collision", weight: float = 100.0) -> None:
        super().__init__(name, weight)

    def reward(self, terminated: Tensor) -> Tensor:
        """Return the unweighted term."""
        return -terminated.to(torch.float32)


class VelocityReward(RewardTerm):
    """−|e_v(i,0)|/v_max of every follower of a platoon, at the state reached (HCFS H4–H5).

    Args:
        name, weight: see :class:`RewardTerm`; ω1.
        speed_scale: v_max [m/s].
        followers: followers of the platoon.
        platoon: its namespace.
    """

    def __init__(
        self,
        name: str = "velocity",
        weight: float = 10.0,
        speed_scale: float = 27.1,
        followers: int = 1,
        platoon: str = "platoon",
    ) -> None:
        if not speed_scale > 0:
            raise ConfigError(
                f"reward.terms.{name}.speed_scale must be positive, got {speed_scale}"
            )
        super().__init__(name, weight, [(platoon, "leader_speed_error")], (followers, 1))
        self.speed_scale = speed_scale

    def reward(self, speed_error: Tensor) -> Tensor:
        """Return the unweighted term, ``[*batch, followers, 1]``."""
        return -speed_error.abs() / self.speed_scale


class JerkReward(RewardTerm):
    """−|jerk|/(2 a_max/T) of every follower of a platoon (HCFS H6).

    Args:
        name, weight: see :class:`RewardTerm`; ω2.
        jerk_scale: 2 a_max/T [m/s³].
        followers: followers of the platoon.
        platoon: its namespace.
    """

    def __init__(
        self,
        name: str = "jerk",
        weight: float = 0.036,
        jerk_scale: float = 30.0,
        followers: int = 1,
        platoon: str = "platoon",
    ) -> None:
        if not jerk_scale > 0:
            raise ConfigError(f"reward.terms.{name}.jerk_scale must be positive, got {jerk_scale}")
        super().__init__(name, weight, [(platoon, "jerk")], (followers, 1))
        self.jerk_scale = jerk_scale

    def reward(self, jerk: Tensor) -> Tensor:
        """Return the unweighted term, ``[*batch, followers, 1]``."""
        return -jerk.abs() / self.jerk_scale


class TotalReward(RewardPiece):
    """Writes ``"reward"``: the sum of all terms (A17, A19).

    Args:
        terms: the terms, by name.
        event_shape: shape of the reward after the batch dimensions; that of the terms.

    Raises:
        ConfigError: if there is no term.
    """

    def __init__(
        self, terms: Sequence[str] | Mapping[str, object], event_shape: Sequence[int] = (1,)
    ) -> None:
        names = list(terms)
        if not names:
            raise ConfigError("reward.terms is empty: an environment needs at least one term")
        super().__init__([(TERMS, name) for name in names], [REWARD], event_shape)

    def compute(self, *entries: Tensor) -> Tensor:
        """Return the sum."""
        return torch.stack(entries).sum(0)
