"""Vehicle-to-vehicle communication and the controllers that use it (HCFS)."""

from __future__ import annotations

from typing import ClassVar, Literal

import torch
from torch import Tensor

from lcc_rl.errors import ConfigError, require_known
from lcc_rl.functional import cacc
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.functional.string import entries_ahead, gather
from lcc_rl.pieces.base import Entry, Feature, as_key
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.views import LEADER, VEHICLES
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Number, Positive

# Prediction of the leader's next speed: v0 + a0 T, v0, or the true one, as an upper bound only.
Lookahead = Literal["causal", "hold", "oracle"]
PLATOON_ERRORS = ("gap_error", "speed_error", "leader_gap_error", "leader_speed_error")


class Communication(Feature):
    """Writes the errors that vehicles receive from their platoon by radio (HCFS H1–H2).

    A connected vehicle receives messages of the connected vehicles directly ahead of it. The
    vehicle ahead of the first of them is the chain's leader. If it is not connected, the first
    vehicle measures it by its own sensors, without delay. The errors of a vehicle that is not
    connected refer to the vehicle ahead.
    """

    connected: tuple[str, ...] = (AUTOMATED,)  # roles that send and receive
    leader_sends: bool = True  # whether the vehicle ahead of the string sends, too
    headway: NonNegative = 5.0  # h, the gap to be kept [m]
    delay: NonNegative = 0.005  # of messages; it acts on the positions received [s]

    steady = True
    role = VEHICLES
    writes = (
        Entry("vehicles.gap_error", "m", "e_x(i,i−1), positive where too far behind"),
        Entry("vehicles.speed_error", "m/s", "e_v(i,i−1), positive where too slow"),
        Entry("vehicles.leader_gap_error", "m", "e_x(i,0), to the leader of its chain"),
        Entry("vehicles.leader_speed_error", "m/s", "e_v(i,0), to the leader of its chain"),
        Entry("vehicles.received_gap", "m", "gap by the position received"),
        Entry("vehicles.leader_speed", "m/s", "speed of the leader of its chain"),
        Entry("vehicles.leader_acceleration", "m/s²", "acceleration of the leader of its chain"),
    )
    hearing: ClassVar[Tensor]

    def setup(self, world: World) -> None:
        """Find which vehicle receives messages from which.

        Raises:
            ConfigError: if a role is unknown, or a chain goes all the way round a ring.
        """
        string = world.string
        where = f"role (scenario.pieces.{self.name or 'communication'}.connected)"
        require_known(where, {*self.connected} - {AUTOMATED}, string.names)
        leader = [] if string.ring else [(LEADER, "speed"), (LEADER, "acceleration")]
        roles = [role for role in string.names if role in self.connected and string.drawn]
        motion = [(VEHICLES, name) for name in ("speed", "gap", "acceleration")]
        self.declare(world, [*motion, *leader, *((role, "index") for role in roles)])
        if string.ring and (string.drawn or string.roles[0] in self.connected):
            raise ConfigError(
                "communication: on a ring road the first vehicle of scenario.string must not be "
                f"connected, or a chain would have no leader; {', '.join(self.connected)} are"
            )
        flags = torch.tensor([role in self.connected for role in string.roles])
        self.uniform = bool(flags.all()) and self.leader_sends and not string.ring
        self.register_buffer("hearing", flags)

    def compute(
        self, speed: Tensor, gap: Tensor, acceleration: Tensor, *more: Tensor
    ) -> tuple[Tensor, ...]:
        """Return the errors and received values, in the order of ``writes``."""
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
        errors = cacc.platoon_errors(ahead, lead, speed, gap, self.headway, self.delay, chain)
        return (*errors, errors.gap + self.headway, lead, lead_acceleration)

    def _chain(self, speed: Tensor, indices: tuple[Tensor, ...]) -> cacc.Chain:
        connected = self.hearing.expand(speed.shape[:-1])
        if indices:
            connected = torch.zeros_like(connected)
            for index in indices:
                connected = connected.scatter(-1, index, True)
        return cacc.find_chains(connected, self.leader_sends and not self.string.ring)


# Names of the entries that only vehicles in a platoon have.
MESSAGES = frozenset(f"self.{as_key(entry.key)[-1]}" for entry in Communication.writes)


def leader_names(lookahead: str) -> list[str]:
    """Return the entries from which a controller predicts its leader's next speed."""
    true_next = "leader.next_speed" if lookahead == "oracle" else "self.leader_speed"
    return ["self.leader_speed", "self.leader_acceleration", true_next]


class CACC(Controller):
    """Cooperative adaptive cruise control (HCFS H11)."""

    max_acceleration: Positive | None = None  # None: the limits of the vehicles [m/s²]
    k1: Number = 0.04  # gain of e_x(i,i−1) [1/s]
    k2: Number = 0.12  # gain of e_v(i,i−1)
    k3: Number = 1.4  # gain of e_x(i,0) [1/s]
    k4: Number = 1.3  # gain of e_v(i,0)
    # H11 as printed, where v_i + … is the acceleration. Its feedback of v_i is positive: unstable
    # unless k2 + k4 > 1 + T (k1 + k3)/2, and then a chain's first vehicle settles v_0/(k1 + k3) too
    # close to its leader. Stability is not checked.
    literal: bool = False

    steady = True
    reads = tuple(f"self.{name}" for name in PLATOON_ERRORS)

    def setup(self, world: World) -> None:
        """Refuse gains at which the closed loop is unstable, naming the condition that fails."""
        self.declare(world, (*self.reads, "self.speed") if self.literal else self.reads)
        self.gains = cacc.Gains(self.k1, self.k2, self.k3, self.k4)
        if not self.literal:
            self.gains.check_stable(world.time_step)

    def command(self, *read: Tensor) -> Tensor:
        errors, speed = cacc.Errors(*read[: len(PLATOON_ERRORS)]), read[len(PLATOON_ERRORS) :]
        # A hybrid controller uses the command without these limits.
        return cacc.cacc_acceleration(errors, self.gains, self.time_step, *speed)


class DeadBeat(Controller):
    """Dead-beat control: (v̂0 − v)/T, within ±max_acceleration, v̂0 the leader's predicted speed.

    With ``lookahead="oracle"`` it reads the leader's true next speed and is an upper bound for all
    controllers; ``"causal"`` uses v0 + a0 T, ``"hold"`` v0. It does not control the gap, so past
    errors remain: it is a baseline only.
    """

    max_acceleration: Positive | None = None  # None: the limits of the vehicles [m/s²]
    lookahead: Lookahead = "causal"

    steady = True
    reads = ("self.speed", *leader_names("causal"))

    def setup(self, world: World) -> None:
        self.declare(world, ["self.speed", *leader_names(self.lookahead)])
        check_leader(self.lookahead, self)

    def command(self, speed: Tensor, *leader: Tensor) -> Tensor:
        target = cacc.next_leader_speed(leader, self.lookahead, self.time_step)
        return (target - speed) / self.time_step


def check_leader(lookahead: str, controller: Controller) -> None:
    """Check that an oracle's leader is the recorded one: only its next speed is known."""
    if lookahead == "oracle":
        check_platoon(
            controller, "lookahead=oracle", "knows the recorded leader only", "causal or hold"
        )


def check_platoon(controller: Controller, option: str, fact: str, remedy: str) -> None:
    """Check that a controller drives all vehicles of its string.

    Args:
        controller: a bound controller.
        option: the option that needs this, with its value.
        fact: effect or need of the option, as a predicate.
        remedy: values that can be used instead.

    Raises:
        ConfigError: if the string has vehicles of other roles.
    """
    names = controller.string.names
    if names != (controller.role,):
        where = getattr(controller, "option", f"scenario.controllers.{controller.role}")
        raise ConfigError(
            f"{where}.{option} {fact}, but the string has {', '.join(names)}; use {remedy}"
        )
