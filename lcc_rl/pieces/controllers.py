"""Controllers: what the vehicles of a role wish to do, one acceleration each.

A controller of your own is a class with its settings (:mod:`lcc_rl.settings`), the names of what
it reads (:mod:`lcc_rl.pieces.views`) and its law::

    class KeepDistance(Controller):
        distance: Positive = 20.0    # gap to be kept [m]
        reads = ("self.gap", "self.relative_speed")
        def command(self, gap, relative_speed):
            return 0.1 * (gap - self.distance) + 0.5 * relative_speed

and ``scenario.controllers.automated._target_=mymodule.KeepDistance`` on the command line. Any
controller drives any role, and is a policy by :class:`lcc_rl.agents.ControllerPolicy`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Protocol, Self

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from lcc_rl.functional.idm import IDMConstants
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, VehicleString
from lcc_rl.pieces.base import StepTransform
from lcc_rl.pieces.string import COMMAND, WANTED
from lcc_rl.pieces.views import ACTION, AHEAD, BEHIND, SELF
from lcc_rl.pieces.world import World
from lcc_rl.settings import Number, Positive, find_target

# The names of the random streams: an episode's seed means the same episode under either.
STREAMS = {AUTOMATED: "cav", HUMAN: "hdv"}
LARGEST = 3.0  # command to automated vehicles, in both directions [m/s²]


def stream_name(role: str) -> str:
    """Return the name under which a role draws random numbers."""
    return STREAMS.get(role, role)


class Population(Protocol):
    """What the pieces need to know of a driver population."""

    @property
    def desired_speed(self) -> Tensor:
        """v0 of each driver, ``[drivers]`` [m/s]."""

    @property
    def time_gap(self) -> Tensor:
        """T of each driver, ``[drivers]`` [s]."""

    @property
    def constants(self) -> IDMConstants:
        """The parameters of the IDM that the drivers share."""


class Controller(StepTransform):
    """Base of all controllers: writes ``("command", role)``, ``[*batch, n, 1]`` [m/s²].

    Where the role has a safety filter, it writes ``("wanted", role)``, which this reads.

    The role that it drives is its name in an environment. Commands to automated vehicles are held
    within ±3 m/s², or, of whatever role, within the controller's setting ``max_acceleration``.
    """

    name: ClassVar[str] = AUTOMATED
    reads: ClassVar[Sequence[str]] = ()
    # Names of what it remembers, each an entry (role, name) of one number per vehicle, 0 at first.
    remembers: ClassVar[Sequence[str]] = ()
    # Maps what is read and remembered, one row per vehicle of the role, to the commands
    # [*batch, n, 1], or to a tuple of them and what is remembered next.
    command: ClassVar[Callable[..., Any]]

    def bind(self, world: World | None = None, name: str | None = None) -> Self:
        """Return the controller of a role; without a world, of one vehicle of that role."""
        role = name or self.name
        return super().bind(world or World(VehicleString((role,))), role)

    def setup(self, world: World) -> None:
        """Derive from a world what depends on it; one that overrides this calls it or drive."""
        own = [(self.name, entry) for entry in self.remembers]
        self.drive(world, [*self.reads, *map(".".join, own)], own)

    def drive(
        self,
        world: World,
        reads: Sequence[str],
        writes: Sequence[NestedKey] = (),
        **more: Sequence[NestedKey],
    ) -> None:
        """Set what is read by name, and what is written besides the command.

        Args:
            world: what the pieces of the environment share.
            reads: names of what it reads.
            writes: entries in the order of the values after the command.
            **more: see :meth:`lcc_rl.pieces.base.StepTransform.wire`.
        """
        self.role, self.string, self.time_step = self.name, world.string, world.time_step
        largest = getattr(self, "max_acceleration", LARGEST if self.role == AUTOMATED else None)
        # Of the commands [m/s²]; None where they are executed as they are.
        self.limits: tuple[float, float] | None = None if largest is None else (-largest, largest)
        self.names = tuple(reads)
        known = world.sensed(self.role, reads)
        wish = WANTED if self.role in world.filtered else COMMAND
        self.see(world, known, [(wish, self.role), *writes], self.role, **more)

    def compute(self, *entries: Tensor) -> Any:
        """Return the commands, and what else is written."""
        return self.limited(*self.views(*entries))

    def limited(self, *read: Tensor) -> Any:
        """Return what :meth:`command` returns, its commands within the limits."""
        found = self.command(*read)
        if self.limits is None:
            return found
        if isinstance(found, Tensor):
            return found.clamp(*self.limits)
        command, *kept = found
        return (command.clamp(*self.limits), *kept)


class Action(Controller):
    """The action of a policy, in [−1, 1], times the largest acceleration.

    Reads ``(role, "action")``, ``[*batch, n, 1]``; like everybody who reads it by its name, it
    sees actions beyond the range as its ends (:mod:`lcc_rl.pieces.views`).
    """

    max_acceleration: Positive = 3.0  # acceleration of action 1, braking of action −1 [m/s²]

    reads = (f"{AUTOMATED}.{ACTION}",)

    def setup(self, world: World) -> None:
        """Read the role's action."""
        self.drive(world, [f"{self.name}.action"])
        self.limits = None  # within ±1 the action is read

    def command(self, action: Tensor) -> Tensor:
        """Return the commands."""
        return action * self.max_acceleration


class ConstantAcceleration(Controller):
    """The same acceleration always; behind a safety filter, the filter alone drives."""

    acceleration: Number = 0.0  # [m/s²]

    reads = ("self.speed",)

    def command(self, speed: Tensor) -> Tensor:
        """Return the commands."""
        return torch.full_like(speed, self.acceleration)


class Law(Controller):
    """The acceleration that a plain function of named entries returns.

    The function's parameters without a default name what it reads: ``gap`` is the vehicle's own
    (``self.gap``), ``ahead_speed`` and ``behind_gap`` are of its neighbours.
    """

    law: str  # dotted path of the function, as in my_pieces.keep_distance

    @property
    def title(self) -> str:
        """The function."""
        return self.law

    def setup(self, world: World) -> None:
        """Find the function, and read what its parameters name."""
        self.function = find_target(self.law, "law")
        parameters = inspect.signature(self.function).parameters.values()
        names = [one.name for one in parameters if one.default is one.empty]
        self.drive(world, [_entry(name) for name in names])

    def command(self, *entries: Tensor) -> Tensor:
        """Return the commands."""
        return self.function(*entries)


def _entry(parameter: str) -> str:
    """Return the entry that a parameter's name means: ``ahead_speed`` is ``ahead.speed``."""
    space, _, entry = parameter.partition("_")
    return f"{space}.{entry}" if space in (AHEAD, BEHIND) else f"{SELF}.{parameter}"
