"""Hybrid strategies, such as HCFS: a rule or the action of a policy, step by step."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import torch
from pydantic import InstanceOf
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.errors import ConfigError, require
from lcc_rl.functional.braking import Braking, safe_acceleration
from lcc_rl.functional.cacc import next_leader_speed
from lcc_rl.functional.hcfs import (
    Choice,
    Decision,
    PlatoonPlace,
    PlatoonReward,
    hybrid_decision,
    jerk_interval,
)
from lcc_rl.functional.pattern import MAX_ACCELERATION
from lcc_rl.pieces.base import Entry, Piece
from lcc_rl.pieces.connected import (
    Communication,
    Lookahead,
    check_leader,
    check_platoon,
    leader_names,
)
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.rewards import JerkReward, RewardTerm, SpacingReward, VelocityReward
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Positive, values

WINNER = ("hybrid", "winner")
COUNTERS = SWITCHES, CLAMPS, CAPS = tuple(
    ("hybrid", name) for name in ("switches", "clamps", "cap_interventions")
)
DRIVEN = ("speed", "acceleration", "received_gap", "speed_error", "leader_gap_error")
HYBRID_READS = (".".join(WINNER), *(f"self.{name}" for name in DRIVEN))
COMPARED = (VelocityReward, JerkReward, SpacingReward)  # terms of PlatoonReward
SPARE = 2.0  # headway beyond the gap that the cap needs, for deviations [m]


class Hybrid(Controller):
    """Base of hybrid strategies: in each step the command of a rule or the action of a policy.

    A subclass names entries in ``reads`` and defines :meth:`choose`.
    """

    rule: InstanceOf[Controller]  # without memory; its command is one candidate
    max_acceleration: Positive | None = None  # None: the limits of the vehicles [m/s²]
    # Acceleration of action 1; None: that of the policy's training, without a configuration 3.
    action_scale: Positive | None = None

    takes_action = True
    option = "deployed"  # its place in a configuration
    remembers = (
        Entry(WINNER, "–", "candidate chosen: 0 rule, 1 policy, −1 at reset", whole=True),
        Entry(SWITCHES, "–", "changes of the winner since the start", whole=True),
        Entry(CLAMPS, "–", "steps in which the jerk bound cut a candidate", whole=True),
        Entry(CAPS, "–", "steps in which the safe cap cut a candidate", whole=True),
    )
    # Maps both commands [m/s²] and the entries of ``reads``, each [*batch, n, 1], to true where the
    # policy drives, or to a Decision.
    choose: ClassVar[Callable[..., Tensor | Decision]]

    def declare(self, world: World, reads: Any = None, *others: Any, **named: Any) -> None:
        """Read the action, the entries of the choice and those of the rule."""
        self.rule = self.rule.bind(world, self.name)
        kept = ", ".join(".".join(key) for key in self.rule.targets[1:])
        require(not kept, f"{self.title}.rule: {self.rule.title} remembers {kept}; it must not")
        own = self.reads if reads is None else reads
        self.weighed = len(own)
        super().declare(world, [f"{self.name}.action", *own, *self.rule.names], *others, **named)

    @property
    def scale(self) -> float:
        """Acceleration of action 1 [m/s²]."""
        return self.action_scale or MAX_ACCELERATION

    def command(self, action: Tensor, *entries: Tensor) -> tuple[Tensor, ...]:
        """Return the commands, the winners and the counters."""
        read, (before, *counts) = entries[: -len(self.remembers)], entries[-len(self.remembers) :]
        rule = self.rule.command(*read[self.weighed :])
        learned = action * self.scale
        chosen: Any = self.choose(rule, learned, *read[: self.weighed])
        if isinstance(chosen, Tensor) and chosen.dtype == torch.bool:
            winner, no = chosen.to(before.dtype), torch.zeros_like(chosen)
            switched = (before >= 0) & (winner != before)
            chosen = Decision(torch.where(chosen, learned, rule), winner, switched, no, no)
        if not isinstance(chosen, Decision):
            raise ConfigError(f"{self.title}.choose must return a tensor of bool, got {chosen!r}")
        counted = [count + flag for count, flag in zip(counts, chosen[2:], strict=True)]
        return (chosen.acceleration, chosen.winner, *counted)

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        super().begin(given, start)
        start.set(WINNER, torch.full_like(start.get(WINNER), -1))


class HCFS(Hybrid):
    """The hybrid car-following strategy: the better of a rule and an action in each step.

    The two candidates are the command of a rule and the action of a policy (H12–H14), see
    :func:`lcc_rl.functional.hcfs.hybrid_decision`.
    """

    jerk_bound: Positive = 30.0  # J; the paper's 2 a_max/T = 30 never binds [m/s³]
    lookahead: Lookahead = "causal"
    clamp: bool = True  # hold the candidates within the jerk bound; false: the literal rule
    # Keep the result below the safe cap; full braking if a measurement, the action or the rule's
    # command is not finite. false: the literal rule, which collides in long runs, because the
    # paper's reward has no spacing term.
    safe_cap: bool = True
    # The better candidate (the paper); the point between both that is nearest to the rule and earns
    # no less than either; or, for a string that is one platoon, every vehicle's rule plus the
    # first vehicle's correction of its rule.
    choice: Choice = "better"
    braking: Positive | None = None  # b of the safe cap; None: the brakes of the vehicles [m/s²]
    margin: NonNegative = 0.5  # gap that the cap keeps at standstill [m]
    # Settings of lcc_rl.functional.hcfs.PlatoonReward, by which candidates are compared. With
    # spacing_weight 0, as in the paper, gap_scale and spacing_time have no effect.
    velocity_weight: NonNegative = PlatoonReward.velocity_weight
    speed_scale: Positive = PlatoonReward.speed_scale  # [m/s]
    jerk_weight: NonNegative = PlatoonReward.jerk_weight
    jerk_scale: Positive = PlatoonReward.jerk_scale  # [m/s³]
    spacing_weight: NonNegative = PlatoonReward.spacing_weight
    gap_scale: Positive = PlatoonReward.gap_scale  # [m]
    spacing_time: NonNegative = PlatoonReward.spacing_time  # time until e_x counts [s]

    steady = True
    reads = (*HYBRID_READS, *leader_names("causal"))

    def setup(self, world: World) -> None:
        """Read the entries of both candidates and of the decision."""
        self.declare(world, [*HYBRID_READS, *leader_names(self.lookahead)])
        check_leader(self.lookahead, self)
        if self.choice == "first":
            check_platoon(self, "choice=first", "needs a string that is one platoon", "between")
        self.reward = PlatoonReward(**values(self, PlatoonReward))
        assert self.limits is not None
        self.bounds, hardest = self.limits, -self.limits[0]
        braking = self.braking or hardest
        require(
            braking <= hardest,
            f"{self.option}.braking={braking:g} exceeds the brakes of the vehicles, {hardest:g} "
            f"m/s² (scenario.max_braking, {self.option}.max_acceleration): the safe cap needs them",
        )
        self.both_brake = Braking(braking, braking, time_to_collision=0.0)

    def choose(self, rule: Tensor, learned: Tensor, *entries: Tensor) -> Decision:
        before, speed, last, gap, speed_error, leader_gap, *leader = entries
        interval = jerk_interval(last, self.jerk_bound, self.time_step, self.bounds)
        ahead, time_step = speed + speed_error, self.time_step
        cap = safe_acceleration(speed, gap - self.margin, ahead, self.both_brake, time_step)
        return hybrid_decision(
            rule,
            learned,
            speed,
            last,
            before,
            next_leader_speed(leader, self.lookahead, self.time_step),
            interval if self.clamp else None,
            cap if self.safe_cap else None,
            self.reward,
            self.time_step,
            self.bounds,
            PlatoonPlace(leader_gap, leader[0]),
            self.choice,
        )


def check_rewards(pieces: Sequence[Piece]) -> None:
    """Check that HCFS, which compares its candidates by three terms, has no reward with others.

    Raises:
        ConfigError: naming the terms.
    """
    terms = [x for x in pieces if isinstance(x, RewardTerm) and not isinstance(x, COMPARED)]
    named = ", ".join(f"reward.terms.{x.name}" for x in terms if x.weight)
    require(
        not named or not any(isinstance(piece, HCFS) for piece in pieces),
        f"HCFS compares its candidates by velocity, jerk and spacing only, not by {named}: train "
        "variant=ddpg with it, and evaluate variant=hcfs policy=<run>",
    )


def check_spacing(pieces: Sequence[Piece], profiles: Any) -> None:
    """Check that a platoon keeps the gap that the safe cap of its hybrid controller needs.

    At a speed v shared with the vehicle ahead the cap needs a received gap of T·v + margin; the
    received position is delay·v behind the true one. With a shorter constant headway the
    controller and its cap would permanently conflict.

    Args:
        pieces: the pieces of an environment.
        profiles: the speeds of its leader, :class:`lcc_rl.data.profiles.Profiles`.

    Raises:
        ConfigError: naming the fastest leader, both gaps and the option.
    """
    hybrids = [piece for piece in pieces if isinstance(piece, HCFS) and piece.safe_cap]
    for heard in (piece for piece in pieces if isinstance(piece, Communication)):
        for hybrid in hybrids:
            fastest = max(range(len(profiles)), key=lambda i: float(profiles.record(i).max()))
            speed = float(profiles.record(fastest).max())
            reach = hybrid.time_step + heard.delay
            needed = hybrid.margin + reach * speed
            if needed > heard.headway:
                raise ConfigError(
                    f"the leader drives {speed:.1f} m/s ({profiles.names[fastest]}): the safe cap "
                    f"of HCFS then needs a gap of {needed:.2f} m, the platoon keeps a headway of "
                    f"{heard.headway:g} m, enough up to "
                    f"{(heard.headway - hybrid.margin) / reach:.1f} m/s; use "
                    f"scenario.start.automated.headway={math.ceil(needed + SPARE)}"
                )
