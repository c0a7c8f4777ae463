"""Energy models and their assignment to vehicles."""

from lcc_rl.energy.base import AVERAGED, AVERAGES, BURNT, SECOND, EnergyModel
from lcc_rl.energy.electric import ElectricCar, PaperMotor
from lcc_rl.energy.fleet import Fleet, VehicleClass, as_fleet
from lcc_rl.energy.fuel import CirclesFuel

__all__ = [
    "AVERAGED",
    "AVERAGES",
    "BURNT",
    "SECOND",
    "CirclesFuel",
    "ElectricCar",
    "EnergyModel",
    "Fleet",
    "PaperMotor",
    "VehicleClass",
    "as_fleet",
]
