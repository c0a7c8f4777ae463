"""Vehicles that talk to each other: what they hear, and the controllers that use it (HCFS)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from lcc_rl.errors import ConfigError, require_positive
from lcc_rl.functional.cacc import (
    Chain,
    Errors,
    Gains,
    cacc_acceleration,
    check_lookahead,
    dead_beat_acceleration,
    find_chains,
    next_leader_speed,
    platoon_errors,
)
from lcc_rl.functional.hcfs import (
    Decision,
    PlatoonReward,
    hybrid_decision,
    jerk_interval,
    safe_acceleration,
)
from lcc_rl.functional.pattern import AUTOMATED, VehicleString
from lcc_rl.functional.string import entries_ahead, gather
from lcc_rl.pieces.base import Feature, Key
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.views import LEADER, VEHICLES

ERRORS = ("gap_error", "speed_error", "leader_gap_error", "leader_speed_error")
HEARD = (*ERRORS, "received_gap", "leader_speed", "leader_acceleration")
HYBRID, COUNTERS = "hybrid", ("switches", "clamps", "cap_interventions")


class Communication(Feature):
    """Writes what vehicles know of their platoon by radio (HCFS H1–H2).

    Under ``"vehicles"``, ``[*batch, N, 1]``: ``gap_error`` e_x(i,i−1) and ``leader_gap_error``
    e_x(i,0) [m], ``speed_error`` e_v(i,i−1) and ``leader_speed_error`` e_v(i,0) [m/s], positive
    where the vehicle is too far behind or too slow; ``received_gap``, the gap as the message says
    [m]; speed [m/s] and acceleration [m/s²] of its leader.

    A connected vehicle hears the connected vehicles ahead of it without a gap in the chain. The
    vehicle ahead of the first of them is the chain's leader; where it is not connected, the first
    one sees it by its own sensors, without delay. Of a vehicle that is not connected the errors
    refer to the vehicle ahead.

    Args:
        string: the string of vehicles.
        connected: the roles that send and hear.
        leader_sends: the vehicle ahead of the whole string sends, too.
        headway: h, the gap to be kept [m].
        delay: of messages; it acts on the positions received [s].

    Raises:
        ConfigError: if a setting is negative, or a chain goes all the way round a ring.
    """

    connected: Tensor

    def __init__(
        self,
        string: VehicleString,
        connected: Sequence[str] = (AUTOMATED,),
        leader_sends: bool = True,
        headway: float = 5.0,
        delay: float = 0.005,
    ) -> None:
        if not (headway >= 0 and delay >= 0):
            raise ConfigError(
                f"communication: headway {headway} and delay {delay} must not be negative"
            )
        own = ("speed", "gap", "acceleration")
        leader = [] if string.ring else [(LEADER, "speed"), (LEADER, "acceleration")]
        roles = [role for role in string.names if role in connected]
        super().__init__(
            [
                *((VEHICLES, name) for name in own),
                *leader,
                *((role, "index") for role in roles if string.drawn),
            ],
            [(VEHICLES, name) for name in HEARD],
            (len(string), 1),
        )
        if string.ring and (string.drawn or string.roles[0] in connected):
            raise ConfigError(
                "communication: on a ring road the first vehicle of scenario.string must not be "
                f"connected, or a chain would have no leader; {', '.join(connected)} are"
            )
        self.string, self.headway, self.delay, self.leader_sends = (
            string,
            headway,
            delay,
            leader_sends,
        )
        flags = torch.tensor([role in connected for role in string.roles])
        self.uniform = bool(flags.all()) and leader_sends and not string.ring
        self.register_buffer("connected", flags)

    def compute(
        self, speed: Tensor, gap: Tensor, acceleration: Tensor, *more: Tensor
    ) -> tuple[Tensor, ...]:
        """Return the entries of :data:`HEARD`."""
        leader, leading = (None, None) if self.string.ring else more[:2]
        indices = more[0 if self.string.ring else 2 :]
        ahead, accelerating = entries_ahead(leader, speed), entries_ahead(leading, acceleration)
        if self.uniform:
            assert leader is not None
            assert leading is not None
            chain, lead = None, leader.unsqueeze(-2).expand_as(speed)
            lead_acceleration = leading.unsqueeze(-2).expand_as(speed)
        else:
            chain = self._chain(speed, indices)
            lead, lead_acceleration = gather(ahead, chain.first), gather(accelerating, chain.first)
        errors = platoon_errors(ahead, lead, speed, gap, self.headway, self.delay, chain)
        return (*errors, errors.gap + self.headway, lead, lead_acceleration)

    def _chain(self, speed: Tensor, indices: tuple[Tensor, ...]) -> Chain:
        connected = self.connected.expand(speed.shape[:-1])
        if indices:
            connected = torch.zeros_like(connected)
            for index in indices:
                connected = connected.scatter(-1, index, True)
        return find_chains(connected, self.leader_sends and not self.string.ring)


class CACC(Controller):
    """Cooperative adaptive cruise control (HCFS H11).

    Args:
        time_step: duration of a step T [s].
        max_acceleration: bound of the acceleration in both directions [m/s²].
        k1: gain of e_x(i,i−1) [1/s].
        k2: gain of e_v(i,i−1).
        k3: gain of e_x(i,0) [1/s].
        k4: gain of e_v(i,0).
        string, role: see :class:`lcc_rl.pieces.controllers.Controller`.

    Raises:
        ConfigError: if the closed loop is unstable, naming the condition that fails.
    """

    reads = tuple(f"self.{name}" for name in ERRORS)

    def __init__(
        self,
        time_step: float,
        max_acceleration: float = 3.0,
        k1: float = 0.04,
        k2: float = 0.12,
        k3: float = 1.4,
        k4: float = 1.3,
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        super().__init__(string, role)
        require_positive(f"scenario.controllers.{role}", max_acceleration=max_acceleration)
        self.gains = Gains(k1, k2, k3, k4)
        self.gains.check_stable(time_step)
        self.time_step, self.max_acceleration = time_step, max_acceleration

    def command(self, *errors: Tensor) -> Tensor:
        """Return the commands."""
        return cacc_acceleration(Errors(*errors), self.gains, self.time_step, self.max_acceleration)


class DeadBeat(Controller):
    """Dead-beat control: (v̂0 − v)/T, within ±max_acceleration, v̂0 the leader's predicted speed.

    With ``lookahead="oracle"`` it knows the leader's next speed and bounds what any controller
    can reach; ``"causal"`` takes v0 + a0 T, ``"hold"`` v0. It keeps no gap: errors of the past
    stay, so it is a baseline, not a controller to drive with.

    Args:
        time_step: duration of a step T [s].
        max_acceleration: bound of the acceleration in both directions [m/s²].
        lookahead: ``"causal"``, ``"hold"`` or ``"oracle"``.
        string, role: see :class:`lcc_rl.pieces.controllers.Controller`.

    Raises:
        ConfigError: if the look-ahead is unknown.
    """

    def __init__(
        self,
        time_step: float,
        max_acceleration: float = 3.0,
        lookahead: str = "causal",
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        super().__init__(string, role, ["self.speed", *leader_names(lookahead)])
        self.lookahead = check_leader(lookahead, self)
        self.time_step, self.max_acceleration = time_step, max_acceleration

    def command(self, speed: Tensor, *leader: Tensor) -> Tensor:
        """Return the commands."""
        target = next_leader_speed(leader, self.lookahead, self.time_step)
        return dead_beat_acceleration(speed, target, self.time_step, self.max_acceleration)


def leader_names(lookahead: str) -> list[str]:
    """Return what a controller reads of its leader to predict its next speed."""
    true_next = "leader.next_speed" if lookahead == "oracle" else "self.leader_speed"
    return ["self.leader_speed", "self.leader_acceleration", true_next]


def check_leader(lookahead: str, controller: Controller) -> str:
    """Return the name of a look-ahead that a controller can have.

    Raises:
        ConfigError: if there is none of that name, or the leader of some of its vehicles is
            another than the recorded one, of which alone an oracle knows the future.
    """
    where = f"scenario.controllers.{controller.role}"
    if lookahead == "oracle" and controller.string.names != (controller.role,):
        raise ConfigError(
            f"{where}.lookahead=oracle knows the recorded leader only, but the string has "
            f"{', '.join(controller.string.names)}; say causal or hold"
        )
    return check_lookahead(lookahead, where)


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
            long runs drives through the vehicle ahead: the reward has no spacing term.
        braking: b of the safe cap [m/s²].
        margin: gap that it keeps at standstill [m].
        velocity_weight, speed_scale, jerk_weight, jerk_scale: of the reward compared, see
            :class:`lcc_rl.functional.hcfs.PlatoonReward`.
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
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        where = f"scenario.controllers.{role}"
        require_positive(where, max_acceleration=max_acceleration, jerk_bound=jerk_bound)
        if not 0 < braking <= max_acceleration:
            raise ConfigError(
                f"{where}.braking must lie in (0, {max_acceleration}], which is what the vehicles "
                f"can do, got {braking}"
            )
        if not margin >= 0:
            raise ConfigError(f"{where}.margin must not be negative, got {margin}")
        own = [f"self.{name}" for name in ("speed", "acceleration", "received_gap", "speed_error")]
        state = [(HYBRID, name) for name in ("winner", *COUNTERS)]
        super().__init__(
            string,
            role,
            [
                f"{role}.action",
                *own,
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
        self.reward = PlatoonReward(velocity_weight, speed_scale, jerk_weight, jerk_scale)

    def command(self, action: Tensor, *entries: Tensor) -> tuple[Tensor, ...]:
        """Return the commands, the winners and the counters."""
        own, leader, (winner, *counts), rule = (
            entries[:4],
            entries[4:7],
            entries[7:11],
            entries[11:],
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
        speed, last, gap, speed_error = own
        interval = jerk_interval(last, self.jerk_bound, self.time_step, self.max_acceleration)
        cap = safe_acceleration(
            gap, speed, speed + speed_error, self.time_step, self.braking, self.margin
        )
        return hybrid_decision(
            rule,
            action.clamp(-1.0, 1.0) * self.max_acceleration,
            speed,
            last,
            last_winner,
            next_leader_speed(leader, self.lookahead, self.time_step),
            interval if self.clamp else None,
            cap if self.safe_cap else None,
            self.reward,
            self.time_step,
            self.max_acceleration,
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
