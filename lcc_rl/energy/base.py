"""What an energy model is: power from speed and acceleration, and what a motion stores."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor

from lcc_rl.errors import require_in, require_positive

STEEPEST = 0.3  # [rad]


class EnergyModel(ABC):
    """Base of all energy models: power [W] that a vehicle draws from its battery or tank.

    A model of your own is a class with :meth:`power`; what a trip takes net of what the last speed
    stores follows from ``mass`` and ``efficiency``.

    Args:
        mass: of the vehicle, rotating parts included [kg].
        efficiency: share of what is drawn that becomes kinetic energy; what the speed of the
            vehicle stores counts as kinetic energy over efficiency.
        grade: of the road [rad].
        heating_value: of the fuel [J/g]; None for a vehicle without fuel.
        density: of the fuel [kg/L].

    Raises:
        ConfigError: if a setting is out of range.
    """

    def __init__(
        self,
        mass: float,
        efficiency: float = 1.0,
        grade: float = 0.0,
        heating_value: float | None = None,
        density: float | None = None,
    ) -> None:
        require_positive("energy", mass=mass)
        require_in("energy", "(0, 1]", efficiency=efficiency)
        require_in("energy", f"[{-STEEPEST}, {STEEPEST}]", grade=grade)
        for name, value in (("heating_value", heating_value), ("density", density)):
            if value is not None:
                require_positive("energy", **{name: value})
        self.mass, self.efficiency, self.grade = mass, efficiency, grade
        self.heating_value, self.density = heating_value, density

    @abstractmethod
    def power(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the power drawn [W], negative where something is returned; same shape.

        Args:
            speed: speed at the start of a step, any shape [m/s].
            acceleration: executed acceleration, same shape [m/s²].
        """

    def smooth_power(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return :meth:`power` without its jumps, for objectives that a gradient follows."""
        return self.power(speed, acceleration)

    def path_power(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the power that a path takes [W]: without what the motion stores; smooth."""
        stored = self.mass / self.efficiency * speed * acceleration
        return self.smooth_power(speed, acceleration) - stored

    def stored_energy(self, speed: Tensor) -> Tensor:
        """Return what a speed is worth: kinetic energy over efficiency [J], same shape."""
        return 0.5 * self.mass / self.efficiency * speed * speed

    def acceleration_loss(self, speed: Tensor, acceleration: Tensor) -> Tensor | None:
        """Return what accelerating loses for good [W]; None where the model has no such part."""
        return None

    def infeasible(self, speed: Tensor, acceleration: Tensor) -> Tensor | None:
        """Return where the vehicle cannot accelerate like this; None where the model is silent."""
        return None
