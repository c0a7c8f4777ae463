"""What the pieces of an environment share, and how a piece is put into it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

from tensordict.utils import NestedKey

from lcc_rl.errors import require
from lcc_rl.functional.pattern import VehicleString
from lcc_rl.settings import Settings, values

MAX_ACCELERATION = 3.0  # of vehicles by default, in both directions [m/s²]
MOST_LATE = 1000  # steps that a sensor, an actuator or a driver may be late; each is kept
# Views that a role with sensors has from them, and the entries of the role that hold them.
SENSED = {
    "self.gap": "sensed_gap",
    "self.speed": "sensed_speed",
    "self.relative_speed": "sensed_relative_speed",
    "ahead.speed": "sensed_ahead_speed",
    "ahead.acceleration": "sensed_ahead_acceleration",
}


@dataclass(frozen=True)
class World:
    """What the pieces of an environment share; by default one automated vehicle at 10 Hz.

    Args:
        string: the string of vehicles.
        time_step: duration of a step [s].
        horizon: steps of an episode.
        profiles: speed profiles of the leader.
        population: the human drivers.
        energy: the classes of the vehicles, :class:`lcc_rl.energy.Fleet`.
        nominal: leaders and starts as in an evaluation, without the deviations of training.
        actuators: settings of the :class:`lcc_rl.pieces.Actuation` of roles that have one.
        sensors: settings of the :class:`lcc_rl.pieces.Sensors` of roles that have some.
        filtered: roles whose commands a safety filter changes.
    """

    string: VehicleString = field(default_factory=VehicleString)
    time_step: float = 0.1
    horizon: int = 300
    profiles: Any = None
    population: Any = None
    energy: Any = None
    nominal: bool = False
    actuators: Mapping[str, Any] = field(default_factory=dict)
    sensors: Mapping[str, Any] = field(default_factory=dict)
    filtered: Collection[str] = ()

    def given(self, what: str, where: str) -> Any:
        """Return profiles, population or energy.

        Raises:
            ConfigError: if the world has none.
        """
        found = getattr(self, what)
        require(found is not None, f"{where} needs a World({what}=…) to be bound to")
        return found

    def deviations(self, factors: tuple[float, float]) -> tuple[float, float]:
        """Return the range of a factor from which episodes draw: 1 in an evaluation."""
        return (1.0, 1.0) if self.nominal else factors

    def steps(self, seconds: float, what: str) -> int:
        """Return a duration in steps.

        Raises:
            ConfigError: if it is no number of steps.
        """
        count = seconds / self.time_step
        require(
            abs(count - round(count)) < 1e-6,
            f"{what} must be a multiple of the time step, {self.time_step:g} s, got {seconds:g} s",
        )
        return round(count)

    def late(self, seconds: float, what: str) -> int:
        """Return a delay in steps.

        Raises:
            ConfigError: if it is no number of steps, or above :data:`MOST_LATE`.
        """
        most = MOST_LATE * self.time_step
        require(seconds < 1.001 * most, f"{what} must be at most {most:g} s, got {seconds:g} s")
        return self.steps(seconds, what)

    def sensed(self, role: str, names: Sequence[NestedKey]) -> list[NestedKey]:
        """Return names of views of a role, those that its sensors measure as measured."""
        if role not in self.sensors:
            return list(names)
        return [_sensed(role, name) if isinstance(name, str) else name for name in names]


def _sensed(role: str, name: str) -> str:
    plain = name.removeprefix("next.")
    prefix = name.removesuffix(plain)
    return f"{prefix}{role}.{SENSED[plain]}" if plain in SENSED else name


class Part(Settings):
    """Settings of a part of an environment, bound to a world."""

    name: ClassVar[str] = ""  # by default; that of a part in an environment is its own

    def bind(self, world: World | None = None, name: str | None = None) -> Self:
        """Return the part with what depends on a world.

        Args:
            world: what the pieces of the environment share.
            name: the role that it drives, or its key in the configuration.
        """
        bound = type(self)(**values(self))
        bound.name = name or self.name  # type: ignore[misc]
        bound.setup(world or World())
        return bound

    def setup(self, world: World) -> None:
        """Derive from a world what depends on it.

        Args:
            world: what the pieces of the environment share.
        """
