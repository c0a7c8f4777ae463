"""Observations beyond a vehicle's present: its memory, a preview, the traffic further ahead."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import torch
from pydantic import Field
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.errors import ConfigError, require
from lcc_rl.functional.layout import batch_innermost, join
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.functional.random import normal, stream_id
from lcc_rl.functional.string import entries_ahead, gather
from lcc_rl.pieces.base import (
    ACTION,
    OBSERVATION,
    SEED,
    STEP,
    Entry,
    Feature,
    Piece,
    StepTransform,
    as_key,
    next_key,
)
from lcc_rl.pieces.cbf import CBFFilter
from lcc_rl.pieces.connected import MESSAGES, Communication
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.leader import NEXT_SPEED, PROFILE, PROFILE_START, NGSIMLeader, perturbed
from lcc_rl.pieces.sensors import Sensors
from lcc_rl.pieces.views import EPISODE, LEADER, NEXT, VEHICLES, Key, Views
from lcc_rl.pieces.world import World
from lcc_rl.settings import Count, NonNegative

Seconds = Annotated[float, Field(ge=0.0, le=3600.0)]  # ages of memories, horizons of previews
Times = Annotated[tuple[Seconds, ...], Field(min_length=1)]


def with_errors(speed: Tensor, size: float, seed: Tensor, step: Tensor, streams: Tensor) -> Tensor:
    """Return speeds with normal errors of this size [m/s], at least 0; none for 0."""
    return (speed + size * normal(seed, step, streams)).clamp(min=0.0) if size else speed


class LeaderPreview(Feature):
    """The leader's future speed, as a message from further down the road would contain it.

    Writes ``("preview", "speed")`` [m/s], ``[*batch, 1, horizons]``: one row for all vehicles.
    Beyond the end of a record it is the last speed; a window of a longer record continues in the
    record. The preview is an upper bound, because it is read from the record.
    """

    horizons: Times = (1.0, 2.0, 3.0, 4.0, 5.0)  # how far ahead [s]
    noise: NonNegative = 0.0  # standard deviation of an error drawn anew for each speed [m/s]
    delay: Seconds = 0.0  # age of the message, by which the horizons are shorter [s]

    conditions = ("noise", "delay")
    role = EPISODE
    reads = (PROFILE, PROFILE_START, SEED, STEP)
    known = Entry("preview.speed", "m/s", "speed of the leader at each horizon ahead")
    speeds: ClassVar[Tensor]
    offsets: ClassVar[Tensor]
    last: ClassVar[Tensor]
    shift: ClassVar[Tensor]
    columns: ClassVar[Tensor]

    def setup(self, world: World) -> None:
        profiles = world.profiles
        require(not world.replaced, "a preview reads the record of a leader that is replaced")
        self.declare(world, writes=[self.known.wide((1, len(self.horizons)))])
        self.stream = stream_id("preview.noise")
        self.perturbation, self.time_step = world.deviation(world.perturbation), world.time_step
        where = f"scenario.pieces.{self.name}"
        late = world.steps(self.delay, f"{where}.delay")
        steps = [world.steps(ahead, f"{where}.horizons") - late for ahead in self.horizons]
        self.register_buffer("speeds", profiles.speeds)
        self.register_buffer("offsets", profiles.offsets)
        self.register_buffer("last", profiles.reach - 1)
        self.register_buffer("shift", torch.tensor(steps))
        self.register_buffer("columns", torch.arange(len(steps)))

    def compute(self, profile: Tensor, start: Tensor, seed: Tensor, step: Tensor) -> Tensor:
        index = torch.minimum(start + step + self.shift, self.last[profile]).clamp(min=0)
        speed = self.speeds[self.offsets[profile] + index]
        if self.perturbation:
            seconds = (step + self.shift).clamp(min=0) * self.time_step
            speed = perturbed(speed, seconds, seed, self.perturbation)
        speed = with_errors(speed, self.noise, seed, step, self.stream + self.columns)
        return speed.unsqueeze(-2)


class TrafficAhead(StepTransform):
    """Speeds of vehicles further ahead, as they or sensors at the road report them by radio.

    Writes ``("traffic", "speed")`` [m/s], ``[*batch, A, places]``; reports of the last steps, if
    they are late, as ``("traffic", "reports")``. Ahead of the string no vehicle is known but the
    leader, whose speed stands for theirs and is all that a car behind it reads. On a ring the count
    continues. Before the episode speeds are those of its start.
    """

    places: Annotated[tuple[Count, ...], Field(min_length=1)] = (5, 10, 20, 40)  # 1: the next one
    noise: NonNegative = 0.0  # standard deviation of an error drawn anew for each speed [m/s]
    delay: Seconds = 0.0  # age of the reports [s]

    conditions = ("noise", "delay")
    of_traffic = True  # of no use to a vehicle directly behind the leader
    reported = Entry("traffic.speed", "m/s", "speed of the vehicle at each number of places ahead")
    kept = Entry("traffic.reports", "m/s", "reports of the last steps, latest first")
    own: ClassVar[Tensor]
    far: ClassVar[Tensor]

    def setup(self, world: World) -> None:
        string, count = world.string, len(self.places)
        self.late = world.late(self.delay, f"scenario.pieces.{self.name}.delay")
        self.now: list[Key] = [(VEHICLES, "speed")]  # read at reset and after every step
        self.now += [] if string.ring else [(LEADER, "speed")]
        self.now += [(AUTOMATED, "index")] if string.drawn else []
        self.now += [SEED, STEP] if self.noise else []
        kept = [self.kept.wide(count * (self.late + 1))] if self.late else []
        reads = [*(as_key(entry.key) for entry in kept), *map(next_key, self.now)]
        self.declare(world, reads, [self.reported.wide(count), *kept])
        own = torch.tensor(string.places(AUTOMATED))
        self.register_buffer("own", own)
        self.register_buffer("far", torch.tensor(self.places))
        streams = stream_id("traffic.noise") + torch.arange(len(own) * count)
        self.register_buffer("streams", streams.view(-1, count))

    def compute(self, *read: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        """Return the reports received, and those of the last steps if they are late."""
        reports = self._sent(read[1:] if self.late else read)
        if not self.late:
            return self._received(reports, read)
        kept = join([reports, read[0][..., : -len(self.places)]], -1)
        return self._received(kept[..., -len(self.places) :], read), kept

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        read = [start.get(key) for key in self.now]
        reports = self._sent(read)
        start.set(self.targets[0], self._received(reports, read))
        for key in self.targets[1:]:
            start.set(key, join([reports] * (self.late + 1), -1))

    def _sent(self, now: Sequence[Tensor]) -> Tensor:
        """Return the present speeds at the places."""
        speed, *more = now
        ring = self.string.ring
        ahead = entries_ahead(None if ring else more[0], speed)
        drawn = more[0 if ring else 1] if self.string.drawn else None
        own = self.own.expand(*speed.shape[:-2], -1) if drawn is None else drawn
        place = own.unsqueeze(-1) - self.far + 1  # of the vehicle behind
        place = place % ahead.shape[-2] if ring else place.clamp(min=0)
        return gather(ahead, place.flatten(-2)).view(*place.shape)

    def _received(self, reports: Tensor, read: Sequence[Tensor]) -> Tensor:
        """Return reports with their errors; seed and step are the last entries read."""
        if not self.noise:
            return reports
        seed, step = (entry.unsqueeze(-1) for entry in read[-2:])
        return with_errors(reports, self.noise, seed, step, self.streams)


def driving_reads(pieces: Sequence[Piece]) -> set[Key]:
    """Return the entries that controllers and filters of the automated vehicles read.

    A policy reads what is observed.

    Args:
        pieces: the pieces of an environment in the order in which they act.
    """
    reads: set[Key] = set()
    for piece in pieces:
        drives = isinstance(piece, Controller | CBFFilter) and piece.role == AUTOMATED
        if drives or (OBSERVATION in piece.targets and ACTION in reads):
            reads |= {key for _, key in piece.needs}
    return reads


def foreseen(pieces: Sequence[Piece]) -> list[str]:
    """Return the entries of the leader's future that drive the automated vehicles, by name.

    These are its next speed, the record that it plays, and what other pieces compute from them.
    """
    future: set[Key] = {PROFILE, PROFILE_START, NEXT_SPEED}
    for piece in pieces:
        own = isinstance(piece, Controller | CBFFilter | NGSIMLeader)
        if not own and any(key in future for _, key in piece.needs):
            future |= {*piece.targets}
    return sorted(".".join(key) for key in driving_reads(pieces) & future)


def hears(pieces: Sequence[Piece]) -> bool:
    """Whether automated vehicles with sensors are driven by messages, which have no faults."""
    sensed = any(isinstance(piece, Sensors) and piece.role == AUTOMATED for piece in pieces)
    radio = (Communication, TrafficAhead)
    heard = {x for piece in pieces if isinstance(piece, radio) for x in piece.targets}
    return sensed and not heard.isdisjoint(driving_reads(pieces))


def unconnected(pieces: Sequence[Piece]) -> set[str]:
    """Return the roles whose controllers read messages but are not connected."""
    connected = {role for x in pieces if isinstance(x, Communication) for role in x.connected}
    controllers = (piece for piece in pieces if isinstance(piece, Controller))
    return {x.role for x in controllers if not MESSAGES.isdisjoint(x.names)} - connected


class ObservationMemory(StepTransform):
    """Measurements of each automated vehicle during the last seconds.

    Writes ``("memory", "entries")``, ``[*batch, A, sources × seconds]``, ordered by source: for
    each source and each number in ``seconds`` the exponential average with this time constant
    (``filtered``), or the value of this age (``stacked``, which also writes ``("memory",
    "history")``). Values before the episode are those of its start; it starts anew behind another
    vehicle that replaces the one ahead. ``spread`` writes ``("spread", "entries")`` instead: the
    exponential average of the distance from the exponential average (``("spread", "averages")``),
    which tells waves from free flow; 0 at the start.
    """

    # Remembered entries: dotted names of views with one number, "self.gap".
    sources: Annotated[tuple[str, ...], Field(min_length=1)] = ("ahead.speed",)
    seconds: Times = (0.5, 1.0, 2.0, 5.0)  # time constants or ages, at least a step [s]
    kind: Literal["filtered", "stacked", "spread"] = "filtered"

    measures = True
    found = Entry("memory.entries", "of source", "averages or past values of each source")
    history = Entry("memory.history", "of source", "values of each source in the last steps")
    spread = Entry("spread.entries", "of source", "mean distances of each source from its average")
    averages = Entry("spread.averages", "of source", "averages of each source")
    shares: ClassVar[Tensor]
    places: ClassVar[Tensor]

    @property
    def view(self) -> str:
        """The view of its entries."""
        return "spread" if self.kind == "spread" else "memory"

    def setup(self, world: World) -> None:
        """Find the sources and the length of the history."""
        time_step = world.time_step
        if min(self.seconds) < time_step:
            raise ConfigError(
                f"memory.seconds must be at least a step of {time_step} s, got {min(self.seconds)}"
            )
        self.stacked, self.depth, ages = self.kind == "stacked", 1, [0]
        if self.stacked:
            ages = [world.steps(age, "memory.seconds") for age in self.seconds]
            self.depth = max(ages) + 1
        self.counted, self.repeat = len(self.sources), len(self.seconds)
        wide = self.counted * self.repeat
        writes = [self.found.wide(wide)]
        if self.kind == "spread":
            writes = [self.spread.wide(wide), self.averages.wide(wide)]
        elif self.stacked:
            writes.append(self.history.wide(self.counted * self.depth))
        history = [str(entry.key) for entry in writes[self.stacked :]]
        reached = [f"{NEXT}.{source}" for source in self.sources]
        self.replaced = world.replaced
        reached += [f"{NEXT}.self.followed"] * self.replaced
        self.declare(world, [*history, *reached], writes)
        # The same entries at reset, which has no previous step.
        self.first = Views(world.string, AUTOMATED, world.sensed(AUTOMATED, self.sources))
        shares = 1.0 - torch.exp(-time_step / torch.tensor(list(self.seconds)))
        self.register_buffer("shares", shares.repeat(self.counted))
        self.register_buffer("places", torch.tensor(ages))

    def compute(self, memory: Tensor, *measured: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        """Return the entries, and the history or the averages if they are kept."""
        inputs, spread = list(measured), self.kind == "spread"
        same_leader = inputs.pop() > 0.0 if self.replaced else None  # behind the same vehicle
        average = inputs.pop(0) if spread else None
        now = torch.cat(inputs, -1)
        if same_leader is not None:
            fresh = now.repeat_interleave(memory.shape[-1] // self.counted, -1)
            memory = torch.where(same_leader, memory, 0.0 * fresh if spread else fresh)
            average = None if average is None else torch.where(same_leader, average, fresh)
        if average is not None:
            now = now.repeat_interleave(self.repeat, -1)
            away = (now - average).abs()
            return torch.lerp(memory, away, self.shares), torch.lerp(average, now, self.shares)
        if not self.stacked:
            return torch.lerp(memory, now.repeat_interleave(self.repeat, -1), self.shares)
        past = memory.unflatten(-1, (self.counted, self.depth))
        past = torch.cat([now.unsqueeze(-1), past[..., :-1]], -1)
        samples = past[..., self.places]
        return batch_innermost(samples.flatten(-2)), batch_innermost(past.flatten(-2))

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        now = torch.cat(self.first.of(start), -1)
        for key, repeat in zip(self.targets, (self.repeat, self.depth), strict=False):
            start.set(key, now.repeat_interleave(repeat, -1))
        if self.kind == "spread":
            start.set(self.targets[1], start.get(self.targets[0]))
            start.set(self.targets[0], torch.zeros_like(start.get(self.targets[0])))
