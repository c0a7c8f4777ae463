"""What the car can know beyond the present moment: its own memory, and a preview of the leader."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from lcc_rl.data.profiles import Profiles
from lcc_rl.errors import ConfigError
from lcc_rl.functional.random import normal, stream_id
from lcc_rl.pieces.base import SEED, STEP, Feature, Transition, arrived, as_tuple, following

KINDS = ("filtered", "stacked")


class LeaderPreview(Feature):
    """The leader's speed some seconds ahead, as a message from further down the road would give.

    Writes ``(name, "speed")`` [m/s], shape ``[*batch, horizons]``. Beyond the end of a record its
    last speed stands; a window cut from a longer record goes on in it. Reading the record is what
    makes it an upper bound: no real message knows this much.

    Args:
        profiles: the leader's records.
        time_step: duration of a step [s].
        horizons: how far ahead, one or more [s].
        noise: standard deviation of an error drawn anew for each step and horizon [m/s].
        delay: age of the message: the speed of that long before is given instead [s].
        leader: namespace of the leader.
        name: namespace of what is written.

    Raises:
        ConfigError: if there is no horizon, or a setting is negative.
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
        leader: str = "leader",
        name: str = "preview",
    ) -> None:
        _check_numbers(f"{name}.horizons", horizons)
        if not horizons or min(horizons) < 0 or noise < 0 or delay < 0:
            raise ConfigError(
                f"{name}: horizons {list(horizons)} must be given, and horizons, noise {noise} "
                f"and delay {delay} must not be negative"
            )
        reads = [(leader, "profile"), (leader, "start"), SEED, STEP]
        super().__init__(reads, [(name, "speed")], (len(horizons),))
        self.noise, self.stream = noise, stream_id(f"{name}.noise")
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
        return speed


class ObservationMemory(Transition):
    """What the car measured during the last seconds.

    Writes ``(name, "entries")``, shape ``[*batch, sources × seconds]``, sources slowest: for each
    source and each number in ``seconds`` its exponential average with that time constant
    (``filtered``), or its value of that long ago (``stacked``, which also writes the
    ``(name, "history")`` that it needs). Before the episode began nothing had changed.

    Args:
        time_step: duration of a step [s].
        sources: entries remembered, each one number wide, dotted: ``"cav.gap"``.
        seconds: time constants or ages, one or more, positive [s].
        kind: ``"filtered"`` or ``"stacked"``.
        name: namespace of what is written.

    Raises:
        ConfigError: if a setting is unknown, missing or not positive.
    """

    shares: Tensor
    places: Tensor

    def __init__(
        self,
        time_step: float,
        sources: Sequence[str] = ("leader.speed",),
        seconds: Sequence[float] = (1.0, 5.0),
        kind: str = "filtered",
        name: str = "memory",
    ) -> None:
        if kind not in KINDS:
            raise ConfigError(f"{name}.kind must be one of {', '.join(KINDS)}, got {kind!r}")
        _check_numbers(f"{name}.seconds", seconds)
        if not sources or not seconds or min(seconds) < time_step:
            raise ConfigError(
                f"{name}: sources {list(sources)} and seconds {list(seconds)} must be given, and "
                f"no second be shorter than a step ({time_step})"
            )
        ages = [round(age / time_step) for age in seconds]
        self.stacked, self.depth = kind == "stacked", max(ages) + 1
        kept = "history" if kind == "stacked" else "entries"
        writes = [(name, "entries")] + ([(name, "history")] if self.stacked else [])
        reads = [(name, kept), *(following(as_tuple(source)) for source in sources)]
        super().__init__(reads, writes, event_shape=(len(sources) * len(seconds),))
        self.sources = [as_tuple(source) for source in sources]
        shares = 1.0 - torch.exp(-time_step / torch.tensor(list(seconds)))
        self.register_buffer("shares", shares.repeat(len(sources)))
        self.register_buffer("places", torch.tensor(ages))
        self.repeat = len(seconds)

    def compute(self, kept: Tensor, *measured: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        """Return the entries, and the history where it is kept."""
        now = torch.cat(measured, -1)
        if not self.stacked:
            return torch.lerp(kept, now.repeat_interleave(self.repeat, -1), self.shares)
        past = kept.unflatten(-1, (len(self.sources), self.depth))
        past = torch.cat([now.unsqueeze(-1), past[..., :-1]], -1)
        return past[..., self.places].flatten(-2), past.flatten(-2)

    def written_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Any, Any]:
        widths = (self.event_shape[0], len(self.sources) * self.depth)
        return {
            arrived(key): Unbounded(shape=(*batch, width), device=device)
            for key, width in zip(self.out_keys, widths, strict=False)
        }

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        now = torch.cat([start.get(source) for source in self.sources], -1)
        for key, repeat in zip(self._arrival_keys, (self.repeat, self.depth), strict=False):
            start.set(key, now.repeat_interleave(repeat, -1))


def _check_numbers(where: str, values: Sequence[float]) -> None:
    if not all(isinstance(value, (int, float)) for value in values):
        raise ConfigError(f"{where} must be numbers, got {list(values)}")
