"""Controllers: the commanded acceleration of each vehicle of a role.

Your own controller is a class with its settings (:mod:`lcc_rl.settings`), the names of the entries
that it reads (:mod:`lcc_rl.pieces.views`) and its law::

    class KeepDistance(Controller):
        distance: Positive = 20.0    # gap to be kept [m]
        reads = ("self.gap", "self.relative_speed")
        def command(self, gap, relative_speed):
            return 0.1 * (gap - self.distance) + 0.5 * relative_speed

and ``scenario.controllers.automated._target_=mymodule.KeepDistance`` on the command line. Any
controller drives any role, and is a policy by :class:`lcc_rl.agents.controller.ControllerPolicy`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Protocol, Self

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from lcc_rl.errors import is_ours
from lcc_rl.functional.idm import IDMConstants
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, MAX_ACCELERATION, VehicleString
from lcc_rl.pieces.base import ACTION, ROLE, Entry, RoleTransform, as_key, returned
from lcc_rl.pieces.string import COMMANDED, WISHED
from lcc_rl.pieces.views import AHEAD, BEHIND, SELF
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Number, Positive, find_target

# Names of the random streams; a seed gives the same episode under either name.
STREAMS = {AUTOMATED: "cav", HUMAN: "hdv"}


def stream_name(role: str) -> str:
    """Return the name under which a role draws random numbers."""
    return STREAMS.get(role, role)


class Population(Protocol):
    """Parameters of a driver population that pieces read."""

    @property
    def desired_speed(self) -> Tensor:
        """v0 of each driver, ``[drivers]`` [m/s]."""

    @property
    def time_gap(self) -> Tensor:
        """T of each driver, ``[drivers]`` [s]."""

    @property
    def constants(self) -> IDMConstants:
        """The parameters of the IDM that the drivers share."""


class Controller(RoleTransform):
    """Base of all controllers: writes ``(role, "command")``, ``[*batch, n, 1]`` [m/s²].

    Where the role has a safety filter, it writes ``(role, "wanted")``, which the filter reads.

    Its name in an environment is the role. Commands to automated vehicles are clamped to the limits
    of their brakes and drive (``scenario.max_braking``, ``scenario.max_acceleration``). A setting
    ``max_acceleration`` or ``max_deceleration`` of the controller lowers them, see
    :meth:`lcc_rl.pieces.world.World.limits`.
    """

    # Entries of its memory, 0 at first, or names of entries (role, name) with one number.
    remembers: ClassVar[Sequence[str | Entry]] = ()
    # Maps the entries read and the memory, one row per vehicle of the role, to the commands
    # [*batch, n, 1], or to a tuple of the commands, the next memory and further entries.
    command: ClassVar[Callable[..., Any]]

    measures = True
    orders = (COMMANDED, WISHED)

    def bind(self, world: World | None = None, name: str | None = None) -> Self:
        """Return the controller of a role; without a world, of one vehicle of that role.

        A class of another package gets a world without the records of the leaders.
        """
        role = name or self.name
        world = world or World(VehicleString((role,)))
        known = world if is_ours(type(self).__module__) else replace(world, profiles=None)
        return super().bind(known, role)

    def declare(
        self,
        world: World,
        reads: Any = None,
        writes: Sequence[Entry | NestedKey] | None = None,
        keeps: Sequence[Entry] | None = None,
        remembers: Sequence[str | Entry] | None = None,
    ) -> None:
        """Set the entries read and written, by default those of the class.

        Args:
            world, keeps: see :meth:`lcc_rl.pieces.base.Piece.declare`.
            reads: names of the arguments of :meth:`command` before the memory.
            writes: entries that :meth:`command` returns after the command and the memory.
            remembers: entries of the memory.
        """
        self.time_step = world.time_step
        # Limits of the commands [m/s²]; None: not clamped.
        self.limits: tuple[float, float] | None = world.limits(self.role, self)
        memory = self.remembers if remembers is None else remembers
        entries = [Entry((ROLE, x)) if isinstance(x, str) else x for x in memory]
        names = [".".join(as_key(entry.of(self.role).key)) for entry in entries]
        self.names = (*(self.reads if reads is None else reads), *names)
        order = self.orders[self.role in world.filtered]
        outputs = self.writes if writes is None else writes
        super().declare(world, self.names, [order, *entries, *outputs], keeps)

    def compute(self, *entries: Tensor) -> Any:
        """Return the results of :meth:`command` with clamped commands."""
        results = self.command(*entries)
        if self.limits is None:
            return results
        if isinstance(results, Tensor):
            return results.clamp(*self.limits)
        command, *rest = returned(results)
        return (command.clamp(*self.limits), *rest)


class Action(Controller):
    """The action of a policy, in [−1, 1], times the largest acceleration.

    It reads ``(role, "action")``, ``[*batch, n, 1]``, clamped to this range as for every piece
    (:mod:`lcc_rl.pieces.views`).
    """

    max_acceleration: Positive = MAX_ACCELERATION  # of action 1, in both directions [m/s²]
    hold: NonNegative = 0.0  # time for which an action is executed [s]; 0: one step

    steady = of_limits = True
    reads = (".".join(ACTION),)
    held = Entry("role.held", "–", "action of a policy that is executed since its last decision")

    def setup(self, world: World) -> None:
        self.every = max(world.steps(self.hold, f"scenario.controllers.{self.name}.hold"), 1)
        reads, holds = [f"{self.name}.action"], self.every > 1
        self.declare(world, reads + ["episode.step"] * holds, remembers=[self.held] * holds)
        assert self.limits is not None
        if max(self.limits[0], -self.limits[1]) <= -self.max_acceleration:
            self.limits = None  # the action is clamped when it is read

    def command(self, action: Tensor, *memory: Tensor) -> Any:
        """Return the commands, and the action if it is held; the memory is step and action."""
        if not memory:
            return action * self.max_acceleration
        step, last = memory
        action = torch.where(step % self.every == 0, action, last)
        return action * self.max_acceleration, action


class ConstantAcceleration(Controller):
    """A constant acceleration, the input of a safety filter that drives alone."""

    acceleration: Number = 0.0  # [m/s²]

    reads = ("self.speed",)

    def command(self, speed: Tensor) -> Tensor:
        return torch.full_like(speed, self.acceleration)


class Law(Controller):
    """The acceleration that a plain function of named entries returns.

    The function's parameters without a default name the entries that it reads: ``gap`` is the
    vehicle's own (``self.gap``), ``ahead_speed`` and ``behind_gap`` belong to its neighbours.
    """

    law: str  # dotted path of the function, as in my_pieces.keep_distance

    @property
    def title(self) -> str:
        """The path of the function."""
        return self.law

    def setup(self, world: World) -> None:
        """Find the function and the entries that its parameters name."""
        self.function = find_target(self.law, "law")
        parameters = inspect.signature(self.function).parameters.values()
        names = [x.name for x in parameters if x.default is x.empty]
        self.declare(world, [_entry(name) for name in names])

    def command(self, *entries: Tensor) -> Tensor:
        return self.function(*entries)


def _entry(parameter: str) -> str:
    """Return the entry of a parameter's name: ``ahead_speed`` is ``ahead.speed``."""
    space, _, entry = parameter.partition("_")
    return f"{space}.{entry}" if space in (AHEAD, BEHIND) else f"{SELF}.{parameter}"
