"""The string of vehicles: places of the roles, starts and motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Any, ClassVar, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.errors import ConfigError, require
from lcc_rl.functional.layout import join, reverse
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.functional.random import between, stream_id, uniform
from lcc_rl.functional.string import advance_string, entries_ahead, selector
from lcc_rl.pieces.base import SEED, Entry, StepTransform, next_key
from lcc_rl.pieces.features import CLASS, first_speeds, of_role, speed_limits
from lcc_rl.pieces.leader import LEADER_SPEED
from lcc_rl.pieces.views import EPISODE, VEHICLES
from lcc_rl.pieces.world import Part, World
from lcc_rl.settings import Factors, Positive, Speed

RING_GAP = stream_id("string.ring_gap")
WANTED, COMMAND, OBEYED = "wanted", "command", "obeyed"
PLACEMENT = ("leader", "placement")
LONG_AGO = 1e4  # steps since a vehicle ahead changed that has not changed
COMMANDED = Entry("role.command", "m/s²", "acceleration that the role's controller commands")
WISHED = Entry("role.wanted", "m/s²", "acceleration commanded before the safety filter")


class RolePlaces(StepTransform):
    """Writes which vehicles have which role, ``(role, "index")``, ``[*batch, n]``, int64.

    If the places of a string are drawn, they are written for every role and drawn by the seed of
    each episode; else they are written for the automated vehicles. They are constant within an
    episode.
    """

    role = EPISODE
    placed = Entry("role.index", "–", "places of the role's vehicles, 0 at the front", whole=True)
    index: ClassVar[Tensor]

    def setup(self, world: World) -> None:
        """Choose the roles with written places."""
        string = world.string
        roles = string.names if string.drawn else tuple({AUTOMATED} & set(string.names))
        keeps = [self.placed.of(role).wide(string.count(role)) for role in roles]
        self.declare(world, keeps=keeps)
        self.roles = roles
        self.stream = stream_id("string.places")
        self.register_buffer("index", torch.arange(len(string)))

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        if not self.string.drawn:
            for role in self.roles:
                places = torch.tensor(self.string.places(role), device=start.device)
                start.set((role, "index"), places.expand(*start.batch_size, len(places)).clone())
            return
        draw = uniform(start.get(SEED), 0, self.stream + self.index)
        order, first = draw.argsort(-1), 0
        for role in self.roles:
            count = self.string.count(role)
            start.set((role, "index"), order[..., first : first + count].sort(-1).values)
            first += count


class Start(Protocol):
    """Start of the vehicles of one role."""

    def __call__(self, start: TensorDictBase, role: str, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Return speed [m/s] and gap [m] of every vehicle of the role, ``[*batch, n, 1]``.

        Args:
            start: the first state of the episodes.
            speed: the leader's speed, ``[*batch, n, 1]`` [m/s].
        """


class StringMotion(StepTransform):
    """Moves all vehicles by their commands (A18); no other piece contains physics.

    Commands are clamped to the abilities of the vehicle's class, see
    :class:`lcc_rl.energy.VehicleClass`.
    """

    start: Mapping[str, Any] = field(default_factory=dict)  # by role: a :class:`Start`
    circumference: Positive | None = None  # of a ring road [m]
    circumference_range: Factors = (1.0, 1.0)  # factor on it in training; 1 in evaluation
    vehicle_length: Positive = 5.0  # of vehicles without a class, for the gaps on a ring [m]
    # Speed of all vehicles at the start on a ring road, which has no leader [m/s].
    initial_speed: Speed = 0.0

    role = VEHICLES
    writes = (
        Entry("vehicles.speed", "m/s", "speed"),
        Entry("vehicles.gap", "m", "gap to the vehicle ahead, bumper to bumper"),
        Entry("vehicles.relative_speed", "m/s", "speed of the vehicle ahead minus own speed"),
        Entry("vehicles.acceleration", "m/s²", "acceleration executed during the last step"),
        Entry("vehicles.jerk", "m/s³", "change of the executed acceleration per second"),
        Entry("vehicles.command", "m/s²", "acceleration commanded for the last step"),
    )
    followed = Entry("vehicles.followed", "–", "steps since the vehicle ahead was replaced")

    def setup(self, world: World) -> None:
        """Read the commands of all roles, and bind their starts.

        Raises:
            ConfigError: if a role has no start, or the ring is too short for its vehicles.
        """
        self.time_step, string = world.time_step, world.string
        commands = [
            next_key((role, OBEYED if role in world.actuators else COMMAND))
            for role in string.names
        ]
        motion = [(VEHICLES, name) for name in ("speed", "gap", "acceleration")]
        leader = [] if string.ring else [LEADER_SPEED, next_key(LEADER_SPEED)]
        indices = [(role, "index") for role in string.names] if string.drawn else []
        self.fleet = world.energy
        self.limited = self.fleet is not None and self.fleet.limited
        self.replaced = world.replaced
        changes = [next_key(PLACEMENT), (VEHICLES, "followed")] * self.replaced
        sloped = self.limited and world.slope is not None
        self.slope = world.slope.bind(world, VEHICLES) if sloped else None
        place = [(VEHICLES, "place")] * sloped
        of_class = [CLASS] * self.limited
        read = [*motion, *leader, *commands, *indices, *place, *changes, *of_class]
        self.declare(world, read, [*self.writes, *[self.followed] * self.replaced])
        self.starts: dict[str, Any] = {
            role: start.bind(world, role) if isinstance(start, Part) else start
            for role, start in self.start.items()
        }
        self.ring_gaps = self._ring_gaps(world) if string.ring else None
        missing = [role for role in string.names if role not in self.start]
        if missing and not string.ring:
            raise ConfigError(f"scenario.start has no entry for {', '.join(missing)}")
        self._check_starts()
        order = [place for role in string.names for place in string.places(role)]
        self.arrange = selector([order.index(place) for place in range(len(order))], len(order))

    def _check_starts(self) -> None:
        """Refuse settings of starts without effect, unless another role uses the same value."""
        idle = {role: getattr(start, "idle", {}) for role, start in self.starts.items()}
        for role, name in ((role, name) for role, names in idle.items() for name in names):
            value = getattr(self.starts[role], name)
            users = [x for other, x in self.starts.items() if name not in idle[other]]
            text = f"scenario.start.{role}.{name}={value:g} has no effect: {idle[role][name]}"
            require(value in [getattr(x, name, None) for x in users], text)

    def _ring_gaps(self, world: World) -> tuple[float, float]:
        """Return least and largest gap on a ring [m]; :meth:`begin` uses the lengths of classes."""
        if self.circumference is None:
            raise ConfigError("scenario.road=ring needs scenario.circumference [m]")
        count, length = len(self.string), self.vehicle_length
        factors = world.deviations(self.circumference_range)
        least, largest = (self.circumference * factor / count - length for factor in factors)
        longest = [
            length if self.fleet is None else self.fleet.longest(x) for x in self.string.roles
        ]
        if least + length <= sum(longest) / count:
            raise ConfigError(
                f"scenario.circumference={self.circumference} (times {factors[0]:g}) is too short "
                f"for {count} vehicles of {max(longest)} m: it must exceed {sum(longest)} m"
            )
        return least, largest

    def compute(self, speed: Tensor, gap: Tensor, acceleration: Tensor, *more: Tensor) -> Any:
        """Return the motion after the step and the executed commands."""
        leader, reached = (None, None) if self.string.ring else more[:2]
        inputs = more[0 if self.string.ring else 2 :]
        roles = len(self.string.names)
        indices = inputs[roles : 2 * roles] if self.string.drawn else ()
        command = self._assemble(inputs[:roles], indices)
        if self.limited:
            grade = None
            if self.slope is not None:  # of the place that it reaches, as in its energy
                place = inputs[roles + len(indices)]
                grade = self.slope.grade_at(place + self.time_step * speed)
            command = self.fleet.at(grade).within(command, speed, self.time_step, inputs[-1])
        motion = advance_string(speed, gap, acceleration, command, leader, reached, self.time_step)
        if not self.replaced:
            return (*motion, command)
        placement, followed = (x for x in inputs[-2 - self.limited :][:2])
        changed, near, added = placement.unsqueeze(-2).split(1, -1)
        gap = torch.minimum(motion.gap[..., :1, :], near) + added
        count = torch.where(changed > 0.0, 0.0, followed[..., :1, :] + 1.0)
        gap, count = (
            join([first, rest[..., 1:, :]], -2) if rest.shape[-2] > 1 else first
            for first, rest in ((gap, motion.gap), (count, followed))
        )
        return (*motion._replace(gap=gap), command, count)

    def _assemble(self, entries: tuple[Tensor, ...], indices: tuple[Tensor, ...]) -> Tensor:
        """Return an entry of all vehicles, front to back, from those of the roles."""
        joined = entries[0] if len(entries) == 1 else join(entries, -2)
        if indices:
            order = join(indices, -1).unsqueeze(-1)
            places, values = reverse(order.expand_as(joined)), reverse(joined)
            return reverse(torch.zeros_like(values).scatter(1, places, values))
        return self.arrange(joined)

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        shape = (*start.batch_size, len(self.string), 1)
        limits = speed_limits(start, self.fleet)
        if self.ring_gaps is not None:
            speed = torch.full(shape, self.initial_speed, device=start.device)
            gap = between(self.ring_gaps, start.get(SEED).unsqueeze(-2), RING_GAP)
            gap = gap.to(speed.dtype).expand(shape)
            if limits is not None:
                longer = self.fleet.lengths(start.get(CLASS)) - self.vehicle_length
                gap = gap - longer.mean(-2, keepdim=True)
                speed = torch.minimum(speed, limits.amin(-2, keepdim=True))
            relative = torch.zeros_like(speed)
        else:
            leader, roles = start.get(LEADER_SPEED), self.string.names
            ahead = first_speeds(leader, len(self.string), limits)
            placed = [
                self.starts[role](start, role, of_role(ahead, start, self.string, role))
                for role in roles
            ]
            indices = [start.get((role, "index")) for role in roles] if self.string.drawn else []
            speed, gap = (
                self._assemble(tuple(x), tuple(indices)) for x in zip(*placed, strict=True)
            )
            speed = speed if limits is None else torch.minimum(speed, limits)
            relative = entries_ahead(leader, speed) - speed
        still = torch.zeros_like(speed)
        values = [speed, gap, relative, still, still.clone(), still.clone()]
        values += [torch.full_like(still, LONG_AGO)] * self.replaced
        for key, value in zip(self.targets, values, strict=True):
            start.set(key, value)
