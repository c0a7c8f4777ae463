"""Electric cars: losses of the drivetrain, and limits of what braking returns."""

from __future__ import annotations

import math

from torch import Tensor

from lcc_rl.energy.base import EnergyModel
from lcc_rl.errors import require_in, require_positive

GRAVITY, AIR = 9.81, 1.2  # [m/s²], [kg/m³]


class ElectricCar(EnergyModel):
    """Battery power of an electric car; what braking cannot return, friction brakes take.

    At the wheels P = m a v + ½ ρ C_D A v³ + m g (c_rr cos θ + sin θ) v. Driving, the battery gives
    P over the efficiency of the drivetrain; braking, the motor takes at most its limit, fading
    out at low speed, and the battery gets that times the efficiency. The values are those of a
    2016 Nissan Leaf of 30 kWh in the vehicle files of FASTSim (NREL), a driver and passenger on
    board; the efficiency is the product of motor (0.9 at partial load), gear (0.98) and one way
    through the battery (0.985).

    Args:
        mass: of the car and those in it [kg].
        rotating_mass: factor of the mass that is accelerated.
        drag: drag coefficient.
        area: frontal area [m²].
        rolling: rolling resistance coefficient.
        efficiency: of the drivetrain, in either direction.
        auxiliary: power of everything that does not drive [W].
        regeneration_limit: largest braking power at the wheels that the motor takes [W].
        fade_speed: below this speed recuperation fades, in proportion to it [m/s].
        grade: of the road [rad].

    Raises:
        ConfigError: if a setting is out of range.
    """

    def __init__(
        self,
        mass: float = 1636.0,
        rotating_mass: float = 1.03,
        drag: float = 0.315,
        area: float = 2.755,
        rolling: float = 0.008,
        efficiency: float = 0.87,
        auxiliary: float = 250.0,
        regeneration_limit: float = 50000.0,
        fade_speed: float = 5.0,
        grade: float = 0.0,
    ) -> None:
        require_in("energy", "[100, 100000]", mass=mass)  # kilograms, not tonnes
        require_positive("energy", drag=drag, area=area, rotating_mass=rotating_mass)
        require_in("energy", "[0, inf)", rolling=rolling, auxiliary=auxiliary)
        require_in("energy", "[0, inf)", regeneration_limit=regeneration_limit)
        require_positive("energy", fade_speed=fade_speed)
        super().__init__(mass * rotating_mass, efficiency, grade)
        self.drag = 0.5 * AIR * drag * area
        slope = rolling * math.cos(grade) + math.sin(grade)
        self.resistance = mass * GRAVITY * slope  # [N]
        self.auxiliary, self.limit, self.fade_speed = auxiliary, regeneration_limit, fade_speed

    def power(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the power drawn from the battery [W], negative where it is charged."""
        force = self.mass * acceleration + self.resistance + self.drag * speed.square()
        wheels = force * speed
        taken = (-wheels).clamp(0.0, self.limit) * (speed / self.fade_speed).clamp(max=1.0)
        driving = wheels.clamp(min=0.0) / self.efficiency
        return driving - taken * self.efficiency + self.auxiliary
