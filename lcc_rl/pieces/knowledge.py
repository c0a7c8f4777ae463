"""Knowledge beyond the present moment: a vehicle's own memory, and a preview of the leader."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import torch
from pydantic import Field
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from lcc_rl.errors import ConfigError
from lcc_rl.functional.layout import batch_innermost
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.functional.random import normal, stream_id
from lcc_rl.pieces.base import NEXT, SEED, STEP, Feature, Key, StepTransform
from lcc_rl.pieces.views import Views
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative

Seconds = Annotated[float, Field(ge=0.0, le=3600.0)]  # what is remembered or known ahead
Times = Annotated[tuple[Seconds, ...], Field(strict=False, min_length=1)]


class LeaderPreview(Feature):
    """The leader's speed some seconds ahead, as a message from further down the road would give.

    Writes ``("preview", "speed")`` [m/s], ``[*batch, 1, horizons]``: one row for all vehicles.
    Beyond the end of a record its last speed stands; a window cut from a longer record continues
    in it. Reading the record makes this an upper bound: no real message knows this much.
    """

    horizons: Times = (1.0, 2.0, 3.0, 4.0, 5.0)  # how far ahead [s]
    noise: NonNegative = 0.0  # standard deviation of an error drawn anew for each speed [m/s]
    delay: Seconds = 0.0  # age of the message: the speed of that long before is given instead [s]

    speeds: ClassVar[Tensor]
    offsets: ClassVar[Tensor]
    last: ClassVar[Tensor]
    shift: ClassVar[Tensor]
    columns: ClassVar[Tensor]

    def setup(self, world: World) -> None:
        """Take the leader's records."""
        reads, profiles = [("leader", "profile"), ("leader", "start"), SEED, STEP], world.profiles
        self.wire(reads, [("preview", "speed")], (1, len(self.horizons)))
        self.stream = stream_id("preview.noise")
        where = f"scenario.pieces.{self.name}"
        late = world.steps(self.delay, f"{where}.delay")
        steps = [world.steps(ahead, f"{where}.horizons") - late for ahead in self.horizons]
        self.register_buffer("speeds", profiles.speeds)
        self.register_buffer("offsets", profiles.offsets)
        known = profiles.lengths if profiles.reach is None else profiles.reach
        self.register_buffer("last", known - 1)
        self.register_buffer("shift", torch.tensor(steps))
        self.register_buffer("columns", torch.arange(len(steps)))

    def compute(self, profile: Tensor, start: Tensor, seed: Tensor, step: Tensor) -> Tensor:
        """Return the speeds ahead."""
        place = torch.minimum(start + step + self.shift, self.last[profile]).clamp(min=0)
        speed = self.speeds[self.offsets[profile] + place]
        if self.noise:
            error = normal(seed, step, self.stream + self.columns)
            speed = (speed + self.noise * error).clamp(min=0.0)
        return speed.unsqueeze(-2)


class ObservationMemory(StepTransform):
    """What each automated vehicle measured during the last seconds.

    Writes ``("memory", "entries")``, ``[*batch, A, sources × seconds]``, sources slowest: for each
    source and each number in ``seconds`` its exponential average with that time constant
    (``filtered``), or its value of that long ago (``stacked``, which also writes the
    ``("memory", "history")`` that it needs). Before the episode began nothing had changed.
    """

    # What is remembered, views one number wide, dotted: "self.gap".
    sources: Annotated[tuple[str, ...], Field(strict=False, min_length=1)] = ("ahead.speed",)
    seconds: Times = (0.5, 1.0, 2.0, 5.0)  # time constants or ages, at least a step [s]
    kind: Literal["filtered", "stacked"] = "filtered"

    shares: ClassVar[Tensor]
    places: ClassVar[Tensor]

    def setup(self, world: World) -> None:
        """Find what is measured, and how much of it is kept."""
        time_step, string = world.time_step, world.string
        if min(self.seconds) < time_step:
            raise ConfigError(
                f"memory.seconds must be at least a step of {time_step} s, got {min(self.seconds)}"
            )
        self.stacked, self.depth, ages = self.kind == "stacked", 1, [0]
        if self.stacked:
            ages = [world.steps(age, "memory.seconds") for age in self.seconds]
            self.depth = max(ages) + 1
        kept = "history" if self.stacked else "entries"
        known = world.sensed(AUTOMATED, self.sources)
        reached = [f"{NEXT}.{source}" for source in known]
        self.views = Views(string, AUTOMATED, [f"memory.{kept}", *reached])
        # The same entries at reset, where there is no step before.
        self.first = Views(string, AUTOMATED, known)
        writes = [("memory", "entries")] + ([("memory", "history")] if self.stacked else [])
        self.counted, self.repeat = len(self.sources), len(self.seconds)
        shape = (string.count(AUTOMATED), self.counted * self.repeat)
        self.wire(self.views.keys, writes, shape)
        shares = 1.0 - torch.exp(-time_step / torch.tensor(list(self.seconds)))
        self.register_buffer("shares", shares.repeat(self.counted))
        self.register_buffer("places", torch.tensor(ages))

    def compute(self, *entries: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        """Return the entries, and the history where it is kept."""
        kept, *measured = self.views(*entries)
        found, kept = self.remember(kept, torch.cat(measured, -1))
        return (found, kept) if self.stacked else found

    def remember(self, kept: Tensor, now: Tensor) -> tuple[Tensor, Tensor]:
        """Return the entries, and what is kept for the next step.

        Args:
            kept: of the step before, ``[…, sources × seconds]`` or the whole history.
            now: what is measured, ``[…, sources]``.
        """
        if not self.stacked:
            found = torch.lerp(kept, now.repeat_interleave(self.repeat, -1), self.shares)
            return found, found
        past = kept.unflatten(-1, (self.counted, self.depth))
        past = torch.cat([now.unsqueeze(-1), past[..., :-1]], -1)
        seen = past[..., self.places]
        return batch_innermost(seen.flatten(-2)), batch_innermost(past.flatten(-2))

    def written_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Key, Any]:
        vehicles, width = self.event_shape
        widths = (width, self.counted * self.depth)
        return {
            key: Unbounded(shape=(*batch, vehicles, wide), device=device)
            for key, wide in zip(self.targets, widths, strict=False)
        }

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        now = torch.cat(self.first(*(start.get(key) for key in self.first.keys)), -1)
        for key, repeat in zip(self.targets, (self.repeat, self.depth), strict=False):
            start.set(key, now.repeat_interleave(repeat, -1))
