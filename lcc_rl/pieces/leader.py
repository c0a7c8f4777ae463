"""The leader: plays back a recorded speed profile chosen at reset."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from lcc_rl.data.profiles import Profiles
from lcc_rl.errors import ConfigError
from lcc_rl.functional.random import choose, stream_id
from lcc_rl.pieces.base import SEED, STEP, Transition, following


class NGSIMLeader(Transition):
    """Draws a window of a speed profile at reset and plays it back (scenario's PV).

    The profile is random by the episode's seed, or given to ``env.reset`` as ``("leader",
    "profile")`` and ``("leader", "start")``, one per episode: an id, or a list paired with
    drivers.

    Writes ``(name, "speed")`` [m/s] and ``(name, "acceleration")`` [m/s²], shape ``[*batch, 1]``.

    Args:
        profiles: the records to play; each must hold at least ``horizon`` steps.
        horizon: steps per episode.
        time_step: duration of a step [s].
        start: ``"random"`` draws where in the record the window begins, ``"first"`` begins at
            its first sample.
        profile: the record to play in every episode; None draws one for each.
        name: namespace of the written entries.

    Raises:
        ConfigError: if ``start`` or ``profile`` is unknown.
        DataError: if no record is as long as the horizon.
    """

    speeds: Tensor
    offsets: Tensor
    starts: Tensor

    def __init__(
        self,
        profiles: Profiles,
        horizon: int,
        time_step: float,
        start: str = "random",
        profile: int | None = None,
        name: str = "leader",
    ) -> None:
        if start not in ("random", "first"):
            raise ConfigError(f"leader start must be 'random' or 'first', got {start!r}")
        chosen = [(name, "profile"), (name, "start")]
        super().__init__(
            reads=[*chosen, (name, "speed"), following(STEP)],
            writes=[(name, "speed"), (name, "acceleration")],
            constants=chosen,
            choices=chosen,
        )
        profiles = profiles.at_least(horizon)
        if profile is not None and not 0 <= profile < len(profiles):
            raise ConfigError(f"{name}.profile must lie in 0…{len(profiles) - 1}, got {profile}")
        self.name, self.start, self.time_step = name, start, time_step
        self.profile = profile
        self.profile_stream = stream_id(f"{name}.profile")
        self.start_stream = stream_id(f"{name}.start")
        self.register_buffer("speeds", profiles.speeds)
        self.register_buffer("offsets", profiles.offsets)
        self.register_buffer("starts", profiles.lengths - horizon)

    def compute(
        self, profile: Tensor, start: Tensor, speed: Tensor, step: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return speed and acceleration at the moment reached."""
        reached = self.speeds[self.offsets[profile] + start + step]
        return reached, (reached - speed) / self.time_step

    def constant_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Any, Any]:
        spec = Unbounded(shape=(*batch, 1), dtype=torch.int64, device=device)
        return {key: spec.clone() for key in self.constants}

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        seed = start.get(SEED)
        profile, first = given.get(self.choices[0], None), given.get(self.choices[1], None)
        if profile is None and self.profile is not None:
            profile = torch.full_like(seed, self.profile)
        elif profile is None:
            profile = choose(seed, len(self.offsets), self.profile_stream)
        elif bool(((profile < 0) | (profile >= len(self.offsets))).any()):
            raise ConfigError(f"profile ids must lie in 0…{len(self.offsets) - 1}, got {profile}")
        if first is None:
            first = torch.zeros_like(profile)
            if self.start == "random":
                first = choose(seed, self.starts[profile], self.start_stream)
        speed = self.speeds[self.offsets[profile] + first]
        start.set(self.choices[0], profile)
        start.set(self.choices[1], first)
        start.set((self.name, "speed"), speed)
        start.set((self.name, "acceleration"), torch.zeros_like(speed))
