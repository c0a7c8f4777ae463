"""Knowledge beyond the present moment: a vehicle's own memory, and a preview of the leader."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from lcc_rl.data.profiles import Profiles
from lcc_rl.errors import ConfigError, require_in
from lcc_rl.functional.pattern import AUTOMATED, VehicleString
from lcc_rl.functional.random import normal, stream_id
from lcc_rl.pieces.base import NEXT, SEED, STEP, Feature, Key, StepTransform
from lcc_rl.pieces.views import Views

KINDS = ("filtered", "stacked")
LONGEST = 3600  # what is remembered or known ahead [s]


class LeaderPreview(Feature):
    """The leader's speed some seconds ahead, as a message from further down the road would give.

    Writes ``("preview", "speed")`` [m/s], ``[*batch, 1, horizons]``: one row for all vehicles.
    Beyond the end of a record its last speed stands; a window cut from a longer record continues
    in it. Reading the record makes this an upper bound: no real message knows this much.

    Args:
        profiles: the leader's records.
        time_step: duration of a step [s].
        horizons: how far ahead, one or more [s].
        noise: standard deviation of an error drawn anew for each step and horizon [m/s].
        delay: age of the message: the speed of that long before is given instead [s].

    Raises:
        ConfigError: if there is no horizon, or a setting is out of range.
    """

    speeds: Tensor
    offsets: Tensor
    last: Tensor
    shift: Tensor
    columns: Tensor

    def __init__(
        self,
        profiles: Profiles,
        time_step: float,
        horizons: Sequence[float] = (1.0, 2.0, 3.0, 4.0, 5.0),
        noise: float = 0.0,
        delay: float = 0.0,
    ) -> None:
        _check_seconds("preview.horizons", horizons, 0)
        require_in("preview", "[0, inf)", noise=noise)
        require_in("preview", f"[0, {LONGEST}]", delay=delay)
        reads = [("leader", "profile"), ("leader", "start"), SEED, STEP]
        super().__init__(reads, [("preview", "speed")], (1, len(horizons)))
        self.noise, self.stream = noise, stream_id("preview.noise")
        steps = [round((horizon - delay) / time_step) for horizon in horizons]
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

    Args:
        time_step: duration of a step [s].
        sources: what is remembered, views one number wide, dotted: ``"self.gap"``.
        seconds: time constants or ages, one or more, positive [s].
        kind: ``"filtered"`` or ``"stacked"``.
        string: the string of vehicles; one automated vehicle where not given.

    Raises:
        ConfigError: if a setting is unknown, missing or out of range.
    """

    shares: Tensor
    places: Tensor

    def __init__(
        self,
        time_step: float,
        sources: Sequence[str] = ("ahead.speed",),
        seconds: Sequence[float] = (0.5, 1.0, 2.0, 5.0),
        kind: str = "filtered",
        string: VehicleString | None = None,
    ) -> None:
        if kind not in KINDS:
            raise ConfigError(f"memory.kind must be one of {', '.join(KINDS)}, got {kind!r}")
        _check_seconds("memory.seconds", seconds, time_step)
        if not sources:
            raise ConfigError("memory.sources must name at least one entry, got none")
        string = VehicleString() if string is None else string
        ages = [round(age / time_step) for age in seconds]
        self.stacked, self.depth = kind == "stacked", max(ages) + 1
        kept = "history" if kind == "stacked" else "entries"
        self.views = Views(
            string, AUTOMATED, [f"memory.{kept}", *(f"{NEXT}.{source}" for source in sources)]
        )
        # The same entries at reset, where there is no step before.
        self.first = Views(string, AUTOMATED, sources)
        writes = [("memory", "entries")] + ([("memory", "history")] if self.stacked else [])
        self.sources_count, self.repeat = len(sources), len(seconds)
        super().__init__(
            self.views.keys,
            writes,
            event_shape=(string.count(AUTOMATED), len(sources) * len(seconds)),
        )
        shares = 1.0 - torch.exp(-time_step / torch.tensor(list(seconds)))
        self.register_buffer("shares", shares.repeat(len(sources)))
        self.register_buffer("places", torch.tensor(ages))

    def compute(self, *entries: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        """Return the entries, and the history where it is kept."""
        kept, *measured = self.views(*entries)
        now = torch.cat(measured, -1)
        if not self.stacked:
            return torch.lerp(kept, now.repeat_interleave(self.repeat, -1), self.shares)
        past = kept.unflatten(-1, (self.sources_count, self.depth))
        past = torch.cat([now.unsqueeze(-1), past[..., :-1]], -1)
        return past[..., self.places].flatten(-2), past.flatten(-2)

    def written_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Key, Any]:
        vehicles, width = self.event_shape
        widths = (width, self.sources_count * self.depth)
        return {
            key: Unbounded(shape=(*batch, vehicles, wide), device=device)
            for key, wide in zip(self.targets, widths, strict=False)
        }

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        now = torch.cat(self.first(*(start.get(key) for key in self.first.keys)), -1)
        for key, repeat in zip(self.targets, (self.repeat, self.depth), strict=False):
            start.set(key, now.repeat_interleave(repeat, -1))


def _check_seconds(where: str, values: Sequence[float], least: float) -> None:
    """Check that there are times, none below the least or too long to be kept [s]."""
    if not values:
        raise ConfigError(f"{where} must name at least one time, got none")
    for value in values:
        parent, _, name = where.rpartition(".")
        require_in(parent, f"[{least}, {LONGEST}]", **{name: value})
