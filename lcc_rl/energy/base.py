"""What an energy model is: power from speed and acceleration, and what a motion stores."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from lcc_rl.settings import Settings

# Widths of moving averages of speeds before their energy is computed [s]: with a shorter one the
# noise of records counts, with a longer one what drivers do does not.
AVERAGES = (1.1, 3.1)
AVERAGED = tuple(f"path_energy_{seconds:g}s_kj" for seconds in AVERAGES)  # such energies [kJ]
BURNT = ("fuel_l", "co2_g")  # what an energy of fuel is in litres, and its carbon dioxide [g]

Grade = Annotated[float, Field(ge=-0.3, le=0.3)]  # of the road [rad]


class EnergyModel(Settings, ABC):
    """Base of all energy models: power [W] that a vehicle draws from its battery or tank.

    A model of your own is a class with ``mass`` and :meth:`power`. What a trip takes net of what
    the last speed stores follows from ``mass`` and ``efficiency``.

    Attributes:
        mass: of the vehicle and those in it [kg].
        rotating_mass: factor of the mass that is accelerated.
        efficiency: share of what is drawn that becomes kinetic energy; what the speed of the
            vehicle stores counts as kinetic energy over efficiency.
        heating_value: of the fuel [J/g]; 0 for a vehicle without fuel.
        density: of the fuel [kg/L].
        carbon_dioxide: of a gram of the fuel [g]; NaN where it is not known.
    """

    mass = 1500.0
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
        stored = self.inertia / self.efficiency * speed * acceleration
        return self.smooth_power(speed, acceleration) - stored

    def stored_energy(self, speed: Tensor) -> Tensor:
        """Return what a speed is worth: kinetic energy over efficiency [J], same shape."""
        return 0.5 * self.inertia / self.efficiency * speed * speed

    def acceleration_loss(self, speed: Tensor, acceleration: Tensor) -> Tensor | None:
        """Return what accelerating loses for good [W]; None where the model has no such part."""
        return None

    def strongest(self, speed: Tensor) -> Tensor | None:
        """Return the largest acceleration at a speed [m/s²]; None where the model is silent."""
        return None

    def infeasible(self, speed: Tensor, acceleration: Tensor) -> Tensor | None:
        """Return where the vehicle cannot accelerate like this; None where the model is silent."""
        strongest = self.strongest(speed)
        return None if strongest is None else acceleration > strongest
