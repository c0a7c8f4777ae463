"""Vehicles that talk to each other: what they hear, and the controllers that use it (HCFS)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lcc_rl.errors import ConfigError, require_in, require_positive
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
from lcc_rl.functional.pattern import AUTOMATED, VehicleString
from lcc_rl.functional.string import entries_ahead, gather
from lcc_rl.pieces.base import Feature
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.views import LEADER, VEHICLES

ERRORS = ("gap_error", "speed_error", "leader_gap_error", "leader_speed_error")
HEARD = (*ERRORS, "received_gap", "leader_speed", "leader_acceleration")


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
        require_in("scenario.pieces.communication", "[0, inf)", headway=headway, delay=delay)
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
        literal: take H11 as printed, where v_i + … is the acceleration. v_i feeds back positively:
            unstable unless k2 + k4 > 1 + T (k1 + k3)/2, and then the first vehicle of a chain
            settles v_0/(k1 + k3) too close to its leader. Stability is not checked.
        string, role: see :class:`lcc_rl.pieces.controllers.Controller`.

    Raises:
        ConfigError: if a setting is out of range, or the closed loop unstable, naming the
            condition that fails.
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
        literal: bool = False,
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        super().__init__(string, role, (*self.reads, "self.speed") if literal else None)
        require_positive(f"scenario.controllers.{role}", max_acceleration=max_acceleration)
        require_in(f"scenario.controllers.{role}", "(-inf, inf)", k1=k1, k2=k2, k3=k3, k4=k4)
        self.gains = Gains(k1, k2, k3, k4)
        if not literal:
            self.gains.check_stable(time_step)
        self.time_step, self.max_acceleration = time_step, max_acceleration

    def command(self, *read: Tensor) -> Tensor:
        """Return the commands."""
        errors, speed = Errors(*read[: len(ERRORS)]), read[len(ERRORS) :]
        limits = self.time_step, self.max_acceleration
        return cacc_acceleration(errors, self.gains, *limits, *speed)


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
        ConfigError: if the look-ahead is unknown or ``max_acceleration`` not positive.
    """

    def __init__(
        self,
        time_step: float,
        max_acceleration: float = 3.0,
        lookahead: str = "causal",
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        require_positive(f"scenario.controllers.{role}", max_acceleration=max_acceleration)
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
