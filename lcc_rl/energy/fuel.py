"""Fuel of cars and trucks: the simplified models of the CIRCLES consortium, version 3.1."""

from __future__ import annotations

import csv
from functools import cache

import torch
from torch import Tensor

from lcc_rl.assets import ASSETS
from lcc_rl.energy.base import EnergyModel, Grade
from lcc_rl.errors import require_known
from lcc_rl.settings import Positive

FUEL = "circles_fuel.csv"
GASOLINE, DIESEL = 0.745, 0.832  # [kg/L]
# Carbon dioxide of burnt fuel [kg/L]: 8,887 and 10,180 g per US gallon (US EPA, Greenhouse Gas
# Emissions from a Typical Passenger Vehicle, EPA-420-F-11-041, 2011).
CARBON_DIOXIDE = {GASOLINE: 2.348, DIESEL: 2.689}
TRUCKS = ("Class4PND", "Class8Tractor")
STANDSTILL, STILL = 0.1, 0.01  # idle: below both, speed [m/s] and |acceleration| [m/s²]
# Kinetic energy per gram of fuel: 35 % of 44 kJ.
KINETIC = 15.4e3  # [J/g]
KILOWATT = 1e3


@cache
def coefficients() -> dict[str, dict[str, float]]:
    """Return the published coefficients of every vehicle; missing ones are zero."""
    text = (ASSETS / "energy" / FUEL).read_text(encoding="utf-8")
    rows = csv.DictReader(text.splitlines())
    return {
        row.pop("vehicle"): {name: float(value or 0.0) for name, value in row.items()}
        for row in rows
    }


class CirclesFuel(EnergyModel):
    """Fuel rate of a vehicle as a polynomial of speed, acceleration and grade, as power [W].

    Below a deceleration that grows with speed the engine gets no fuel. This jump is exact in
    :meth:`power` and smoothed over ``width`` in :meth:`smooth_power`. Infeasible accelerations
    count as the largest feasible one (:meth:`infeasible` returns where). At speeds that the engine
    cannot hold, this would be a deceleration, as in the published model. Here it is zero, so that
    the driven speed is paid for. Height counts as the fuel that the polynomial has for the grade,
    0.33 to 0.44 of whose heat becomes height from 10 to 30 m/s.
    """

    vehicle: str = "midBase"  # Compact, midBase, midSUV, Pickup, Class4PND or Class8Tractor
    grade: Grade = 0.0  # of the road [rad]
    width: Positive = 0.1  # range over which the cut of the fuel is smoothed [m/s²]

    def validate(self) -> None:
        require_known("vehicle (energy.vehicle)", self.vehicle, coefficients())
        self.own = coefficients()[self.vehicle]
        self.heating_value = self.own["gs2kW"] * KILOWATT
        self.truck = self.vehicle in TRUCKS
        self.density = DIESEL if self.truck else GASOLINE
        self.carbon_dioxide = CARBON_DIOXIDE[self.density] / self.density
        self.mass, self.efficiency = self.own["mass_kg"], KINETIC / self.heating_value

    def power(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the heat of the fuel burnt [W]."""
        return self.fuel(speed, acceleration) * self.heating_value

    def smooth_power(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the heat with a smoothed fuel cut and without idling."""
        speed = speed.clamp(min=0.0)
        rate = self._rate(speed, acceleration)
        if not self.truck:
            weaker = (self._cut(speed) - acceleration) / self.width
            rate = rate * (1.0 - weaker.sigmoid() * (speed > self.own["vc"]))
        return rate * self.heating_value

    def fuel(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the fuel rate [g/s], same shape; arguments as for :meth:`power`."""
        own, idle = self.own, (speed.abs() < STANDSTILL) & (acceleration.abs() < STILL)
        speed = speed.clamp(min=0.0)
        # The cut depends on the given acceleration, the rate on the feasible one.
        rate = self._rate(speed, acceleration)
        if not self.truck:
            cut = (speed > own["vc"]) & (acceleration <= self._cut(speed))
            rate = rate.masked_fill(cut, 0.0)
        return rate.masked_fill(idle, own["fc_idle"])

    def climbing(self, speed: Tensor) -> Tensor:
        """Return the heat of the fuel that the grade takes [W]; 0 at standstill."""
        return self.smooth_climbing(speed).masked_fill(speed.abs() < STANDSTILL, 0.0)

    def smooth_climbing(self, speed: Tensor) -> Tensor:
        """Return the same without idling; the polynomial has fuel for a grade at standstill [W]."""
        return self._climbing(speed.clamp(min=0.0)) * self.heating_value

    def unpaid(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the kinetic power of what exceeds the largest acceleration, which is drawn [W]."""
        beyond = acceleration - self.strongest(speed).clamp(min=0.0)
        return self.mass / self.efficiency * speed * beyond.clamp(min=0.0)

    def strongest(self, speed: Tensor) -> Tensor:
        """Return the largest feasible acceleration [m/s²]."""
        own, speed = self.own, speed.clamp(min=0.0)
        force = own["b2"] / speed.clamp(min=1e-6) - own["b3"] * speed.square()
        uphill = (own["b5"] + own["b6"] * speed).clamp(max=own["b4"])
        return force.clamp(max=own["b1"]) - uphill * self.grade

    def _rate(self, speed: Tensor, acceleration: Tensor) -> Tensor:
        """Return the fuel rate [g/s] without the fuel cut."""
        own = self.own
        acceleration = torch.minimum(acceleration, self.strongest(speed).clamp(min=0.0))
        linear = own["p0"] + speed * (own["p1"] + speed * own["p2"])
        quadratic = own["q0"] + own["q1"] * speed
        vertex = -linear / (2.0 * quadratic).clamp(min=1e-9)
        rate = own["C0"] + speed * (own["C1"] + speed * (own["C2"] + speed * own["C3"]))
        rate = rate + acceleration * linear
        rate = rate + torch.maximum(acceleration, vertex).square() * quadratic
        rate = rate + self._climbing(speed)
        if self.truck:
            return torch.maximum(rate, own["h0"] + own["h1"] * speed)
        idling = own["beta0"] * (speed <= own["vc"])
        return torch.maximum(rate, idling)

    def _climbing(self, speed: Tensor) -> Tensor:
        """Return the fuel rate of the grade [g/s]."""
        return self.grade * (self.own["z0"] + speed * (self.own["z1"] + speed * self.own["z2"]))

    def _cut(self, speed: Tensor) -> Tensor:
        """Return the acceleration below which the engine gets no fuel [m/s²]."""
        own, grade = self.own, self.grade
        cut = own["a0"] + speed * (own["a1"] + own["a3"] * speed)
        return cut + grade * (own["a2"] + own["a4"] * speed)
