"""Electric cars: a model with losses and limited recuperation, and the ALCC paper's."""

from __future__ import annotations

import math
from typing import Annotated

import torch
from pydantic import AfterValidator, Field
from torch import Tensor

from lcc_rl.energy.base import GRAVITY, EnergyModel, Grade
from lcc_rl.errors import require
from lcc_rl.functional.power import acceleration_loss, motor_power, path_power
from lcc_rl.settings import NonNegative, Positive

AIR = 1.2  # [kg/m³]
MOST_POWER = 2e6  # of a vehicle [W]


def _in_watts(least: float) -> AfterValidator:
    """Return a check of a power that is 0 or that of a vehicle: kW for W are refused."""

    def check(power: float) -> float:
        fits = power == 0.0 or least <= power <= MOST_POWER
        require(fits, f"must be 0 or {least:g} to {MOST_POWER:g} W, got {power:g}")
        return power

    return AfterValidator(check)


class ElectricCar(EnergyModel):
    """Battery power of an electric car; friction brakes dissipate the rest of braking.

    At the wheels P = m a v + ½ ρ C_D A v³ + m g (c_rr cos θ + sin θ) v. For P > 0 the battery
    delivers P divided by the efficiency of the drivetrain. In braking the motor recovers at most
    its limit, which fades out at low speed, times the efficiency. The values are those of a 2016
    Nissan Leaf of 30 kWh in the vehicle files of FASTSim (NREL) with driver and passenger. The
    efficiency is the product of motor (0.9 at partial load), gear (0.98) and one way through the
    battery (0.985).
    """

    # Mass of the car and its passengers [kg].
    mass: Annotated[float, Field(ge=100.0, le=100_000.0)] = 1636.0
    # Factor on the mass for rotating parts.
    rotating_mass: Annotated[float, Field(ge=1.0, le=2.0)] = 1.03
    drag: Annotated[float, Field(gt=0.0, le=3.0)] = 0.315  # drag coefficient
    area: Annotated[float, Field(gt=0.0, le=20.0)] = 2.755  # frontal area [m²]
    rolling: Annotated[float, Field(ge=0.0, le=0.1)] = 0.008  # rolling resistance coefficient
    efficiency: Annotated[float, Field(ge=0.1, le=1.0)] = 0.87  # of the drivetrain, either way
    # Power of auxiliary consumers [W].
    auxiliary: Annotated[float, Field(ge=0.0, le=1e5), _in_watts(1.0)] = 250.0
    # Largest braking power of the motor [W].
    regeneration_limit: Annotated[NonNegative, _in_watts(1000.0)] = 50_000.0
    fade_speed: Positive = 5.0  # below this speed recuperation is proportional to speed [m/s]
    grade: Grade = 0.0  # of the road [rad]
    # Largest power at the wheels [W]; None: no limit.
    power_limit: Annotated[Positive, _in_watts(1000.0)] | None = None

    def validate(self) -> None:
        self.resistance = 0.5 * AIR * self.drag * self.area  # of the air [N/(m/s)²]
        lib = torch if isinstance(self.grade, Tensor) else math  # a grade of each sample, or one
        slope = self.rolling * lib.cos(self.grade) + lib.sin(self.grade)
        self.rolling_force = self.mass * GRAVITY * slope  # [N]

    def strongest(self, speed: Tensor) -> Tensor | None:
        """Return the acceleration at the power limit, less the resistances [m/s²]."""
        if self.power_limit is None:
            return None
        force = self.power_limit / speed.clamp(min=1e-3) - self.resistance * speed.square()
        return (force - self.rolling_force) / self.inertia

    def power(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the power drawn from the battery [W], negative where it is charged."""
        force = self.inertia * acceleration + self.rolling_force + self.resistance * speed.square()
        wheels = force * speed
        fading = (speed / self.fade_speed).clamp(max=1.0)
        taken = (-wheels).clamp(0.0, self.regeneration_limit) * fading
        driving = wheels.clamp(min=0.0) / self.efficiency
        return driving - taken * self.efficiency + self.auxiliary


class PaperMotor(EnergyModel):
    """Electric power (A2); gentle braking from 15 m/s returns 2.6 times the car's kinetic energy.

    Steady power, change of kinetic energy and loss by acceleration add up to A2 exactly. Of the
    force at the wheels (A1) and Table I, only the kinetic energy ½ δ m v² is used.
    """

    mass = 1005.0  # m of A1 [kg]
    rotating_mass = 1.02  # δ of A1

    def power(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the motor's power [W] (A2)."""
        return motor_power(speed, acceleration)

    def path_power(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return A2 without the change of kinetic energy [W]."""
        return path_power(speed, acceleration)

    def acceleration_loss(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the part of A2 with a² [W]."""
        return acceleration_loss(speed, acceleration)
