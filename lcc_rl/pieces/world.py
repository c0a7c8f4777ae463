"""Properties of an environment that its pieces share, and the binding of pieces to it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

from tensordict.utils import NestedKey

from lcc_rl.errors import naming, require
from lcc_rl.functional.pattern import AUTOMATED, MAX_ACCELERATION, VehicleString
from lcc_rl.settings import Settings, values

MOST_LATE = 1000  # longest delay of sensors, actuators and drivers in steps, all of which are kept
# Views that sensors measure, and the entries of the role with their measurements.
SENSED = {
    "self.gap": "sensed_gap",
    "self.speed": "sensed_speed",
    "self.relative_speed": "sensed_relative_speed",
    "ahead.speed": "sensed_ahead_speed",
    "ahead.acceleration": "sensed_ahead_acceleration",
    "self.target_age": "target_age",
}


@dataclass(frozen=True)
class World:
    """Properties that all pieces share; by default one automated vehicle at 10 Hz.

    Args:
        time_step: duration of a step [s].
        horizon: steps of an episode.
        profiles: speed profiles of the leader.
        population: the human drivers.
        energy: the classes of the vehicles, :class:`lcc_rl.energy.Fleet`.
        nominal: whether leaders and starts are as in an evaluation, without training's deviations.
        actuators: settings of :class:`lcc_rl.pieces.Actuation` by role.
        sensors: settings of :class:`lcc_rl.pieces.Sensors` by role.
        filtered: roles with a safety filter.
        max_braking: hardest braking of automated vehicles [m/s²].
        max_acceleration: largest acceleration of automated vehicles [m/s²].
        replaced: whether the leader is replaced during episodes.
        perturbation: of the leader's speed, see :class:`lcc_rl.pieces.NGSIMLeader`.
        slope: the grade of the road, :class:`lcc_rl.pieces.Slope`; None: a level road.
        limited_by: section of the limits, for messages.
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
    max_braking: float = MAX_ACCELERATION
    max_acceleration: float = MAX_ACCELERATION
    replaced: bool = False
    perturbation: float = 0.0
    slope: Any = None
    limited_by: str = "scenario"

    def given(self, what: str, where: str) -> Any:
        """Return profiles, population or energy.

        Raises:
            ConfigError: if the world has none.
        """
        value = getattr(self, what)
        require(value is not None, f"{where} needs a World({what}=…) to be bound to")
        return value

    def deviations(self, factors: tuple[float, float]) -> tuple[float, float]:
        """Return the range from which episodes draw a factor: 1 to 1 in an evaluation."""
        return (1.0, 1.0) if self.nominal else factors

    def deviation(self, size: float) -> float:
        """Return the size of a deviation that episodes draw: 0 in an evaluation."""
        return 0.0 if self.nominal else size

    def steps(self, seconds: float, what: str) -> int:
        """Return a duration in steps.

        Raises:
            ConfigError: if it is no multiple of the time step.
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
            ConfigError: if it is no multiple of the time step, or above :data:`MOST_LATE` steps.
        """
        most = MOST_LATE * self.time_step
        require(seconds < 1.001 * most, f"{what} must be at most {most:g} s, got {seconds:g} s")
        return self.steps(seconds, what)

    def limits(self, role: str, own: Any = None) -> tuple[float, float] | None:
        """Return the least and the largest command to the vehicles of a role [m/s²].

        Args:
            role: vehicles that are not automated have only the limits of their controller.
            own: a controller or filter, whose ``max_acceleration`` and, in its place for brakes,
                ``max_deceleration`` lower them unless None. Where ``of_limits`` is true,
                :data:`MAX_ACCELERATION` does not.

        Raises:
            ConfigError: if a setting exceeds the limits of automated vehicles.
        """
        automated, separate = role == AUTOMATED, hasattr(own, "max_deceleration")
        if not automated and not hasattr(own, "max_acceleration"):
            return None
        names = ("max_deceleration" if separate else "max_acceleration", "max_acceleration")
        most = (self.max_braking, self.max_acceleration) if automated else (MAX_ACCELERATION,) * 2
        ends, where = [], getattr(own, "option", type(own).__name__)
        for name, vehicle in zip(names, most, strict=True):
            value = getattr(own, name, None)
            if value is None or (value == MAX_ACCELERATION and getattr(own, "of_limits", False)):
                value = vehicle
            require(
                not automated or value <= (vehicle if separate else max(most)),
                f"{where}.{name}={value:g} exceeds the limits of "
                f"automated vehicles, which brake by at most {most[0]:g} m/s² "
                f"({self.limited_by}.max_braking) and accelerate by at most {most[1]:g} m/s² "
                f"({self.limited_by}.max_acceleration)",
            )
            ends.append(min(value, vehicle) if automated else value)
        return -ends[0], ends[1]

    def sensed(self, role: str, names: Sequence[NestedKey]) -> list[NestedKey]:
        """Return names of views of a role, with its measurements where it has sensors."""
        if role not in self.sensors:
            return list(names)
        return [_sensed(role, name) if isinstance(name, str) else name for name in names]


def _sensed(role: str, name: str) -> str:
    plain = name.removeprefix("next.")
    prefix = name.removesuffix(plain)
    return f"{prefix}{role}.{SENSED[plain]}" if plain in SENSED else name


class Part(Settings):
    """Settings of a part of an environment, bound to a world."""

    of_training: ClassVar[Sequence[str]] = ()  # settings without effect in an evaluation
    name: ClassVar[str] = ""  # default; a part in an environment has its own name
    # Whether this class, not those derived from it, draws nothing in an evaluation and reads no
    # drivers; of human drivers, whether these have no noise.
    steady = False

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        cls.steady = vars(cls).get("steady", False)

    def bind(self, world: World | None = None, name: str | None = None) -> Self:
        """Return a copy that is bound to a world.

        Args:
            world: properties that all pieces share; None: those of ``World()``.
            name: its role, or its key in the configuration.
        """
        bound = type(self)(**values(self))
        bound.name = name or self.name  # type: ignore[misc]
        with naming(type(self).__name__):
            bound.setup(world or World())
        return bound

    def setup(self, world: World) -> None:
        """Derive everything that depends on a world."""
