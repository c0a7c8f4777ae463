"""Rewards: named, weighted terms per automated vehicle, each logged by itself, and their sum.

A term of your own is a class with what it reads (:mod:`lcc_rl.pieces.views`) and its formula::

    class Comfort(RewardTerm):
        reads = ("self.jerk",)
        def reward(self, jerk): return -jerk.abs()

and ``+reward.terms.comfort={_target_: mymodule.Comfort, weight: 0.1}`` on the command line.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

import torch
from torch import Tensor

from lcc_rl.errors import ConfigError, require_in, require_positive
from lcc_rl.functional.pattern import AUTOMATED, VehicleString
from lcc_rl.functional.safety import time_to_collision
from lcc_rl.pieces.base import RewardPiece
from lcc_rl.pieces.sections import Sections
from lcc_rl.pieces.views import VEHICLES, Views

TERMS = (AUTOMATED, "reward_terms")
REWARD = (AUTOMATED, "reward")
TOUCH = 1e-6  # [m]; room that is left within the margin: none, but not a collision


class RewardTerm(RewardPiece):
    """Base of all terms: writes ``("automated", "reward_terms", name)``, ``[*batch, A, 1]``.

    Args:
        name: name of the term; the key under ``reward.terms`` in the configuration.
        weight: factor of the term; 0 takes it out.
        reads: names of what it reads, where they depend on settings.
        string: the string of vehicles; one automated vehicle where not given.

    Raises:
        ConfigError: if the weight is negative or not a finite number.
    """

    reads: ClassVar[tuple[str, ...]] = ()
    # Maps what is read, one row per automated vehicle, to the unweighted term, [*batch, A, 1].
    reward: Callable[..., Tensor]

    def __init__(
        self,
        name: str,
        weight: float = 1.0,
        reads: Sequence[str] | None = None,
        string: VehicleString | None = None,
    ) -> None:
        require_in(f"reward.terms.{name}", "[0, inf)", weight=weight)
        string = VehicleString() if string is None else string
        self.views = Views(string, AUTOMATED, self.reads if reads is None else reads)
        self.string = string
        super().__init__(self.views.keys, [(*TERMS, name)], (string.count(AUTOMATED), 1))
        self.name, self.weight = name, weight

    def compute(self, *entries: Tensor) -> Tensor:
        """Return the weighted term."""
        return self.weight * self.reward(*self.views(*entries))


class SafetyReward(RewardTerm):
    """R_safe = log(TTC / threshold) where TTC is below the threshold, else 0 (A10–A11).

    The time is that until the gap has shrunk to the ``margin``; within it, 0 while the gap closes.
    The literal rule, margin 0, says nothing against creeping up to a standing leader until the
    bumpers touch: slowly enough, TTC stays large. A gap that does not close costs nothing, as in
    A10, unless it is a collision.

    Args:
        name, weight, string: see :class:`RewardTerm`.
        threshold: time-to-collision that is safe enough [s].
        floor: time-to-collision below which the term no longer falls [s].
        margin: gap that counts as contact [m].

    Raises:
        ConfigError: if a setting is out of range.
    """

    reads = ("self.gap", "self.relative_speed")

    def __init__(
        self,
        name: str = "safety",
        weight: float = 1.0,
        threshold: float = 4.0,
        floor: float = 0.01,
        margin: float = 1.0,
        string: VehicleString | None = None,
    ) -> None:
        where = f"reward.terms.{name}"
        require_positive(where, threshold=threshold)
        require_in(where, f"(0, {threshold})", floor=floor)
        require_in(where, "[0, inf)", margin=margin)
        super().__init__(name, weight, string=string)
        self.threshold, self.floor, self.margin = threshold, floor, margin

    def reward(self, gap: Tensor, relative_speed: Tensor) -> Tensor:
        """Return the unweighted term."""
        room = torch.where(gap > 0.0, (gap - self.margin).clamp(min=TOUCH), gap)
        ttc = time_to_collision(room, -relative_speed, self.floor)
        return (ttc.clamp(max=self.threshold) / self.threshold).log()


class EfficiencyReward(RewardTerm):
    """R_eff = −1 where the time gap is at least the threshold, else 0 (A12–A13).

    Args:
        name, weight, string: see :class:`RewardTerm`.
        threshold: time gap that is too long [s].

    Raises:
        ConfigError: if the threshold is not positive.
    """

    reads = ("self.time_gap",)

    def __init__(
        self,
        name: str = "efficiency",
        weight: float = 1.0,
        threshold: float = 2.5,
        string: VehicleString | None = None,
    ) -> None:
        require_positive(f"reward.terms.{name}", threshold=threshold)
        super().__init__(name, weight, string=string)
        self.threshold = threshold

    def reward(self, time_gap: Tensor) -> Tensor:
        """Return the unweighted term."""
        return -(time_gap >= self.threshold).to(time_gap.dtype)


class EnergyReward(RewardTerm):
    """R = −P/scale · T: energy of the step just taken (A14 for the CAV, A16 for the HDV).

    Args:
        time_step: duration of a step [s].
        name, weight, string: see :class:`RewardTerm`.
        scale: power that costs 1 per second [W].
        of: whose energy counts: ``"self"``; ``"behind"``: all vehicles behind, back to the next
            automated one; ``"string"``: all vehicles of the string.
        power: the power [W], dotted: ``"vehicles.power"``, or ``"human.predicted_power"`` for
            that of human drivers as the automated vehicle estimates it (A16).

    Raises:
        ConfigError: if the scale is not positive, or ``of`` is unknown.
    """

    def __init__(
        self,
        time_step: float,
        name: str = "energy",
        weight: float = 1.0,
        scale: float = 20000.0,
        of: str = "self",
        power: str = "vehicles.power",
        string: VehicleString | None = None,
    ) -> None:
        require_positive(f"reward.terms.{name}", scale=scale)
        if of not in ("self", "behind", "string"):
            raise ConfigError(f"reward.terms.{name}.of must be self, behind or string, got {of!r}")
        string = VehicleString() if string is None else string
        space, _, entry = power.partition(".")
        own = f"self.{entry}" if space == VEHICLES else power
        self.sections = Sections(string, space)
        reads = [own if of == "self" else power]
        reads += [".".join(key) for key in self.sections.keys if of == "behind"]
        super().__init__(name, weight, reads, string)
        self.factor, self.of = time_step / scale, of

    def reward(self, power: Tensor, *indices: Tensor) -> Tensor:
        """Return the unweighted term."""
        if self.of == "behind":
            power = self.sections.sum(power, *indices)
        elif self.of == "string":
            power = power.sum(-2, keepdim=True).expand(*power.shape[:-2], *self.event_shape)
        return power * -self.factor


class CollisionPenalty(RewardTerm):
    """Minus the weight in the step that ends in a collision, so that a crash never pays.

    Every other term is at most 0 and ends with the episode; without this one an agent with a long
    horizon learns that crashing early is cheap. It is paid by the automated vehicle that hit the
    one ahead.

    Args:
        name, weight, string: see :class:`RewardTerm`; the weight is the penalty.
        behind: it is also paid for collisions behind, back to the next automated vehicle.
    """

    def __init__(
        self,
        name: str = "collision",
        weight: float = 100.0,
        behind: bool = True,
        string: VehicleString | None = None,
    ) -> None:
        string = VehicleString() if string is None else string
        self.sections, self.behind = Sections(string, VEHICLES), behind
        indices = [".".join(key) for key in self.sections.keys]
        super().__init__(name, weight, ["self.gap", "vehicles.gap", *indices], string)

    def reward(self, gap: Tensor, gaps: Tensor, *indices: Tensor) -> Tensor:
        """Return the unweighted term."""
        hit = gap <= 0.0
        if self.behind:
            hit = hit | (self.sections.sum((gaps <= 0.0).to(gap.dtype), *indices) > 0.0)
        return -hit.to(torch.float32)


class TotalReward(RewardPiece):
    """Writes ``("automated", "reward")``: the sum of all terms (A17, A19), ``[*batch, A, 1]``.

    Args:
        terms: the terms, by name.
        string: the string of vehicles; one automated vehicle where not given.

    Raises:
        ConfigError: if there is no term.
    """

    def __init__(
        self, terms: Sequence[str] | Mapping[str, object], string: VehicleString | None = None
    ) -> None:
        names = list(terms)
        if not names:
            raise ConfigError("reward.terms is empty: an environment needs at least one term")
        string = VehicleString() if string is None else string
        super().__init__([(*TERMS, name) for name in names], [REWARD], (string.count(AUTOMATED), 1))
        self.terms, self.string = names, string

    def compute(self, *entries: Tensor) -> Tensor:
        """Return the sum."""
        return torch.stack(entries).sum(0)
