"""The hybrid car-following strategy: a rule or the action of a policy, step by step (HCFS)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from lcc_rl.data.profiles import Profiles
from lcc_rl.errors import ConfigError, require_in, require_positive
from lcc_rl.functional.cacc import next_leader_speed
from lcc_rl.functional.hcfs import (
    Decision,
    Place,
    PlatoonReward,
    hybrid_decision,
    jerk_interval,
    safe_acceleration,
)
from lcc_rl.functional.pattern import AUTOMATED, VehicleString
from lcc_rl.pieces.base import Key, Piece
from lcc_rl.pieces.connected import Communication, check_leader, leader_names
from lcc_rl.pieces.controllers import Controller

HYBRID, COUNTERS = "hybrid", ("switches", "clamps", "cap_interventions")
OWN = ("speed", "acceleration", "received_gap", "speed_error", "leader_gap_error")
SPARE = 2.0  # beyond the gap that the cap needs, for what vehicles deviate from it [m]


class HCFS(Controller):
    """The hybrid car-following strategy: a rule or the action, the better of both each step.

    Composes two candidates by H12–H14, see :func:`lcc_rl.functional.hcfs.hybrid_decision`: the
    command of a rule and the action of a policy. Writes under ``"hybrid"``, ``[*batch, n, 1]``,
    int64: ``winner`` (0 rule, 1 policy; −1 at reset) and since the start of the episode the
    numbers of ``switches``, ``clamps`` (the jerk bound cut a candidate) and
    ``cap_interventions``.

    Args:
        rule: the controller whose command is one candidate; of the same role.
        time_step: duration of a step T [s].
        max_acceleration: acceleration of action 1 [m/s²].
        jerk_bound: J [m/s³]; the paper's 2 a_max/T = 30 never binds.
        lookahead: how the leader's next speed is predicted: ``"causal"`` by v0 + a0 T, ``"hold"``
            by v0; ``"oracle"`` knows it and serves as an upper bound only.
        clamp: hold the candidates within the jerk bound; false is the literal rule, which
            violates it.
        safe_cap: hold the result below what braking allows; false is the literal rule, which in
            long runs drives through the vehicle ahead: the paper's reward has no spacing term. It
            brakes fully where a measurement, the action or the rule's command is no finite number.
        braking: b of the safe cap [m/s²].
        margin: gap that it keeps at standstill [m].
        velocity_weight, speed_scale, jerk_weight, jerk_scale: of the reward compared, see
            :class:`lcc_rl.functional.hcfs.PlatoonReward`.
        spacing_weight, gap_scale, spacing_time: of its spacing term, likewise; with
            weight 0 they have no effect, which is the paper's rule.
        string, role: see :class:`lcc_rl.pieces.controllers.Controller`.

    Raises:
        ConfigError: if a setting is unknown or out of range.
    """

    def __init__(
        self,
        rule: Controller,
        time_step: float,
        max_acceleration: float = 3.0,
        jerk_bound: float = 30.0,
        lookahead: str = "causal",
        clamp: bool = True,
        safe_cap: bool = True,
        braking: float = 3.0,
        margin: float = 0.5,
        velocity_weight: float = 10.0,
        speed_scale: float = 27.1,
        jerk_weight: float = 0.036,
        jerk_scale: float = 30.0,
        spacing_weight: float = 0.0,
        gap_scale: float = 1.0,
        spacing_time: float = 0.0,
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        where = f"scenario.controllers.{role}"
        require_positive(where, max_acceleration=max_acceleration, jerk_bound=jerk_bound)
        # More than the vehicles can brake would be no safe cap.
        require_in(where, f"(0, {max_acceleration}]", braking=braking)
        weights = {"velocity_weight": velocity_weight, "jerk_weight": jerk_weight}
        weights |= {"spacing_weight": spacing_weight, "spacing_time": spacing_time}
        require_in(where, "[0, inf)", margin=margin, **weights)
        scales = {"speed_scale": speed_scale, "jerk_scale": jerk_scale, "gap_scale": gap_scale}
        require_positive(where, **scales)
        state = [(HYBRID, name) for name in ("winner", *COUNTERS)]
        super().__init__(
            string,
            role,
            [
                f"{role}.action",
                *(f"self.{name}" for name in OWN),
                *leader_names(lookahead),
                *(".".join(key) for key in state),
                *rule.names,
            ],
            state,
        )
        self.rule, self.lookahead = rule, check_leader(lookahead, self)
        self.time_step, self.max_acceleration = time_step, max_acceleration
        self.jerk_bound, self.clamp, self.safe_cap = jerk_bound, clamp, safe_cap
        self.braking, self.margin = braking, margin
        self.reward = PlatoonReward(**weights, **scales)

    def command(self, action: Tensor, *entries: Tensor) -> tuple[Tensor, ...]:
        """Return the commands, the winners and the counters."""
        own, leader, (winner, *counts), rule = (
            entries[:5],
            entries[5:8],
            entries[8:12],
            entries[12:],
        )
        decision = self.decide(action, own, leader, winner, self.rule.command(*rule))
        flags = (decision.switched, decision.clamped, decision.capped)
        counted = [count + flag for count, flag in zip(counts, flags, strict=True)]
        return (decision.acceleration, decision.winner, *counted)

    def decide(
        self,
        action: Tensor,
        own: tuple[Tensor, ...],
        leader: tuple[Tensor, ...],
        last_winner: Tensor,
        rule: Tensor,
    ) -> Decision:
        """Return the decision and what led to it."""
        speed, last, gap, speed_error, leader_gap = own
        interval = jerk_interval(last, self.jerk_bound, self.time_step, self.max_acceleration)
        cap = safe_acceleration(
            gap, speed, speed + speed_error, self.time_step, self.braking, self.margin
        )
        return hybrid_decision(
            rule,
            action * self.max_acceleration,
            speed,
            last,
            last_winner,
            next_leader_speed(leader, self.lookahead, self.time_step),
            interval if self.clamp else None,
            cap if self.safe_cap else None,
            self.reward,
            self.time_step,
            self.max_acceleration,
            Place(leader_gap, leader[0]),
        )

    def written_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Key, Any]:
        specs = super().written_specs(batch, device)
        shape = (*batch, *self.event_shape)
        for key in self.targets[1:]:
            specs[key] = Unbounded(shape=shape, dtype=torch.int64, device=device)
        return specs

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        super().begin(given, start)
        winner = start.get((HYBRID, "winner"))
        start.set((HYBRID, "winner"), torch.full_like(winner, -1))


def check_spacing(pieces: Sequence[Piece], profiles: Profiles) -> None:
    """Check that a platoon keeps the gap that the safe cap of its hybrid controller needs.

    At a speed v shared with the vehicle ahead the cap lets a vehicle be T·v + margin behind it, by
    the position received, which is delay·v behind the true one. A constant headway below that
    would set the controller and its cap against each other for ever.

    Args:
        pieces: the pieces of an environment.
        profiles: the speeds of its leader.

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
                    f"{(heard.headway - hybrid.margin) / reach:.1f} m/s; say "
                    f"scenario.start.automated.headway={math.ceil(needed + SPARE)}"
                )
