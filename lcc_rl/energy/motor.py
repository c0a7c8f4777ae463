"""The motor of the ALCC paper, A2."""

from __future__ import annotations

from torch import Tensor

from lcc_rl.energy.base import EnergyModel
from lcc_rl.functional.power import PAPER_VEHICLE, acceleration_loss, motor_power, path_power


class PaperMotor(EnergyModel):
    """Electric power of the ALCC paper's car (A2); braking returns 2.4 times its kinetic energy.

    Steady power, what the motion stores and what accelerating loses add up to A2 exactly.
    """

    mass = PAPER_VEHICLE.mass
    rotating_mass = PAPER_VEHICLE.rotating_mass

    def power(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the motor's power [W] (A2)."""
        return motor_power(speed, acceleration)

    def path_power(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return A2 without the part that the motion stores [W]."""
        return path_power(speed, acceleration)

    def acceleration_loss(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the part of A2 with a² [W]."""
        return acceleration_loss(speed, acceleration)
