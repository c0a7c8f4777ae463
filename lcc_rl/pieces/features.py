"""Features: time-to-collision, time gap, motor power and the scaled observation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Unbounded

from lcc_rl.errors import ConfigError
from lcc_rl.functional.power import motor_power
from lcc_rl.functional.safety import time_gap, time_to_collision
from lcc_rl.pieces.base import Feature, Transition, as_tuple, following


class TimeToCollision(Feature):
    """Writes the time-to-collision ``(vehicle, "ttc")`` [s] (A10).

    Args:
        vehicle: namespace of the vehicle.
        floor: smallest value, which a collision has too [s].
        event_shape: shape of one entry after the batch dimensions.
    """

    def __init__(
        self, vehicle: str = "cav", floor: float = 0.01, event_shape: Sequence[int] = (1,)
    ) -> None:
        reads = [(vehicle, "gap"), (vehicle, "relative_speed")]
        super().__init__(reads, [(vehicle, "ttc")], event_shape)
        self.floor = floor

    def compute(self, gap: Tensor, relative_speed: Tensor) -> Tensor:
        """Return the time-to-collision."""
        return time_to_collision(gap, -relative_speed, self.floor)


class TimeGap(Feature):
    """Writes the time gap to the vehicle ahead, ``(vehicle, "time_gap")`` [s] (A12).

    Args:
        vehicle: namespace of the vehicle.
        speed_floor: speeds below this count as this; 0 is the literal rule [m/s].
        event_shape: shape of one entry after the batch dimensions.
    """

    def __init__(
        self, vehicle: str = "cav", speed_floor: float = 1.0, event_shape: Sequence[int] = (1,)
    ) -> None:
        reads = [(vehicle, "gap"), (vehicle, "speed")]
        super().__init__(reads, [(vehicle, "time_gap")], event_shape)
        self.speed_floor = speed_floor

    def compute(self, gap: Tensor, speed: Tensor) -> Tensor:
        """Return the time gap."""
        return time_gap(gap, speed, self.speed_floor)


class MotorPower(Transition):
    """Writes the motor power of the step just taken [W] (A2): from speed at its start.

    Args:
        vehicle: namespace of the vehicle.
        acceleration: entry that holds the acceleration; ``"predicted_acceleration"`` for what
            the controlled car believes of the follower (A16).
        power: entry written.
        recuperation: count negative (braking) power.
        event_shape: shape of one entry after the batch dimensions.
    """

    def __init__(
        self,
        vehicle: str = "cav",
        acceleration: str = "acceleration",
        power: str = "power",
        recuperation: bool = True,
        event_shape: Sequence[int] = (1,),
    ) -> None:
        reads = [(vehicle, "speed"), following((vehicle, acceleration))]
        super().__init__(reads, [(vehicle, power)], event_shape=event_shape)
        self.recuperation = recuperation

    def compute(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the motor power."""
        return motor_power(speed, acceleration, self.recuperation)


class Observation(Feature):
    """Gathers entries, each times a fixed constant, into ``"observation"``.

    Args:
        scales: constant of each entry, nested by namespace, in the order of the observation, e.g.
            ``{"cav": {"speed": 0.05}}``.
        visible: how many of a string of followers are seen, the nearest first.
        strings: namespaces of strings of followers.
        widths: for namespaces whose entries are wider than one number their width, or a list as
            long as they are wide, e.g. the horizons of a preview.
        relative_to: for namespaces whose entries are seen as differences, from what, dotted:
            ``{"preview": "leader.speed"}``, or one for each of as many equal parts; None: as they
            are. What matters is then not hidden in a small difference of large numbers.
        name: entry written.

    Raises:
        ConfigError: if there is no entry, a scale is zero or a difference is that of no entry.
    """

    constants: Tensor

    def __init__(
        self,
        scales: Mapping[str, Mapping[str, float]],
        visible: int = 1,
        strings: Sequence[str] = ("hdv",),
        widths: Mapping[str, int | Sequence[float]] | None = None,
        relative_to: Mapping[str, str | Sequence[str] | None] | None = None,
        name: str = "observation",
    ) -> None:
        flat = {(space, key): x for space, keys in scales.items() for key, x in keys.items()}
        if not flat or not all(flat.values()):
            raise ConfigError("observation.scales must name at least one entry, none with scale 0")
        if visible < 1:
            raise ConfigError(f"observation.visible must be at least 1, got {visible}")
        wide = {
            space: width if isinstance(width, int) else len(width)
            for space, width in (widths or {}).items()
        }
        counts = [visible if space in strings else wide.get(space, 1) for space, _ in flat]
        bases = _bases(relative_to or {}, flat, counts, strings)
        reads = list(dict.fromkeys([*flat, *(key for keys in bases for key in keys)]))
        super().__init__(reads, [name], (sum(counts),))
        self.bases = [[reads.index(key) for key in keys] for keys in bases]
        self.repeats = [n // max(len(keys), 1) for n, keys in zip(counts, bases, strict=True)]
        self.name, self.visible = name, visible
        self.strings = [space in strings for space, _ in flat]
        values = [x for x, n in zip(flat.values(), counts, strict=True) for _ in range(n)]
        self.register_buffer("constants", torch.tensor(values))

    def compute(self, *entries: Tensor) -> Tensor:
        """Return the scaled observation, shape ``[*batch, entries]``."""
        seen = [
            entry[..., : self.visible, 0] if string else entry
            for entry, string in zip(entries, self.strings, strict=False)
        ]
        for place, (bases, repeat) in enumerate(zip(self.bases, self.repeats, strict=True)):
            if bases:
                base = torch.cat([entries[i] for i in bases], -1)
                seen[place] = seen[place] - base.repeat_interleave(repeat, -1)
        return torch.cat(seen[: len(self.bases)], dim=-1) * self.constants

    def written_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Any, Any]:
        shape = (*batch, *self.event_shape)
        return {(self.name,): Unbounded(shape=shape, device=device)}


def _bases(
    relative_to: Mapping[str, str | Sequence[str] | None],
    flat: Mapping[tuple[str, str], float],
    counts: Sequence[int],
    strings: Sequence[str],
) -> list[list[tuple[str, ...]]]:
    """Return what is subtracted from each entry, in equal parts; nothing from most."""
    for space in relative_to:
        if space in strings or space not in {namespace for namespace, _ in flat}:
            where = f"observation.relative_to.{space}"
            raise ConfigError(f"{where}: expected a namespace of observation.scales, no string")
    found = []
    for (space, _), count in zip(flat, counts, strict=True):
        given = relative_to.get(space) or ()
        keys = [as_tuple(key) for key in ([given] if isinstance(given, str) else given)]
        if keys and count % len(keys):
            raise ConfigError(
                f"observation.relative_to.{space}: {len(keys)} entries do not divide its {count}"
            )
        found.append(keys)
    return found
