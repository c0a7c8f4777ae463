"""Base of energy models: power from speed and acceleration, and kinetic energy."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from copy import copy
from typing import Annotated, Self

import torch
from pydantic import Field
from torch import Tensor

from lcc_rl.errors import require
from lcc_rl.settings import Settings

# Widths of moving averages of speeds before their energy is computed [s]. Shorter ones keep the
# noise of records; longer ones remove the drivers' own accelerations.
AVERAGES = (1.1, 3.1)
AVERAGED = tuple(f"path_energy_{seconds:g}s_kj" for seconds in AVERAGES)  # their energies [kJ]
SECOND = "second_path_energy_kj"  # path energy by evaluation.second_energy
BURNT = ("fuel_l", "co2_g")  # fuel of an energy [L] and its carbon dioxide [g]

GRAVITY = 9.81  # [m/s²]
STEEPEST = 0.3  # grade of a road [rad]
Grade = Annotated[float, Field(ge=-STEEPEST, le=STEEPEST)]


class EnergyModel(Settings, ABC):
    """Base of all energy models: power [W] that a vehicle draws from its battery or tank.

    Your own model is a class with ``mass`` and :meth:`power`. The energy of a trip net of kinetic
    energy follows from ``mass`` and ``efficiency``.

    Attributes:
        mass: mass of the vehicle with its passengers [kg].
        rotating_mass: factor on the mass for rotating parts.
        efficiency: share of the drawn energy that becomes kinetic energy; kinetic energy counts as
            itself divided by this efficiency.
        heating_value: heating value of the fuel [J/g]; 0 for a vehicle without fuel.
        density: density of the fuel [kg/L].
        carbon_dioxide: carbon dioxide per gram of fuel [g]; NaN if unknown.
    """

    mass = math.nan
    rotating_mass = 1.0
    efficiency = 1.0
    heating_value = 0.0
    density = 0.0
    carbon_dioxide = math.nan

    @property
    def inertia(self) -> float:
        """The mass that is accelerated, rotating parts included [kg]."""
        return self.mass * self.rotating_mass

    def burnt(self, energy: Tensor) -> tuple[Tensor, Tensor]:
        """Return the fuel [L] and its carbon dioxide [g] of an energy drawn [J]; 0 without fuel."""
        if not self.heating_value:
            return torch.zeros_like(energy), torch.zeros_like(energy)
        grams = energy / self.heating_value
        return grams * 1e-3 / self.density, grams * self.carbon_dioxide

    def at(self, grade: Tensor) -> Self:
        """Return the model on a road with a grade at each sample, beside its own grade [rad].

        Raises:
            ConfigError: if the model has no grade.
        """
        kind = type(self).__name__
        require(
            hasattr(self, "grade"), f"{kind} has no grade; choose another, such as energy=electric"
        )
        return self.on(self.grade + grade)  # type: ignore[attr-defined]

    def on(self, grade: Tensor | float) -> Self:
        """Return the model on a road of this grade [rad], in place of its own."""
        model = copy(self)
        model.grade = grade  # type: ignore[attr-defined]
        model.validate()
        return model

    @abstractmethod
    def power(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the power drawn [W], negative where energy is recovered; same shape.

        Args:
            speed: speed at the start of a step, any shape [m/s].
            acceleration: executed acceleration, same shape [m/s²].
        """

    def smooth_power(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return :meth:`power` without its jumps, for objectives with a gradient."""
        return self.power(speed, acceleration)

    def path_power(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the smooth power [W] minus the change of kinetic energy and of height."""
        stored = self.inertia / self.efficiency * speed * acceleration
        stored = stored - self.unpaid(speed, acceleration)
        net = self.smooth_power(speed, acceleration) - stored
        return net if self.level else net - self.smooth_climbing(speed)

    @property
    def level(self) -> bool:
        """Whether the road is level: a model without a grade, or of grade 0."""
        grade = getattr(self, "grade", 0.0)
        return not isinstance(grade, Tensor) and grade == 0.0

    def climbing(self, speed: Tensor) -> Tensor:
        """Return the power that becomes height, divided by efficiency [W]; 0 on a level road."""
        grade = getattr(self, "grade", 0.0)
        sine = grade.sin() if isinstance(grade, Tensor) else math.sin(grade)
        return self.mass / self.efficiency * speed * (GRAVITY * sine)

    def smooth_climbing(self, speed: Tensor) -> Tensor:
        """Return what :meth:`smooth_power` contains of :meth:`climbing`, without its jumps [W]."""
        return self.climbing(speed)

    def stored_energy(self, speed: Tensor) -> Tensor:
        """Return kinetic energy divided by efficiency [J], same shape."""
        return 0.5 * self.inertia / self.efficiency * speed * speed

    def acceleration_loss(self, speed: Tensor, acceleration: Tensor) -> Tensor | None:
        """Return the power dissipated by accelerating [W]; None if the model has no such part."""
        return None

    def unpaid(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the power that becomes kinetic energy, over efficiency, but is not drawn [W].

        It is 0 unless accelerations that are infeasible draw less than they take.
        """
        return torch.zeros_like(speed)

    def strongest(self, speed: Tensor) -> Tensor | None:
        """Return the largest acceleration at a speed [m/s²]; None if the model defines none."""
        return None

    def infeasible(self, speed: Tensor, acceleration: Tensor) -> Tensor | None:
        """Return where an acceleration is infeasible; None if the model does not define it."""
        strongest = self.strongest(speed)
        return None if strongest is None else acceleration > strongest
