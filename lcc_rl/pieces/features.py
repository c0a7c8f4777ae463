"""Features of vehicles: time-to-collision, time gap and motor power."""

from __future__ import annotations

from torch import Tensor

from lcc_rl.errors import require_in, require_positive
from lcc_rl.functional.pattern import VehicleString
from lcc_rl.functional.power import motor_power
from lcc_rl.functional.safety import time_gap, time_to_collision
from lcc_rl.pieces.base import Feature, StepTransform, as_key, next_key
from lcc_rl.pieces.views import VEHICLES, Views


class TimeToCollision(Feature):
    """Writes the time-to-collision of every vehicle, ``("vehicles", "ttc")`` [s] (A10).

    Args:
        string: the string of vehicles.
        floor: smallest value, which a collision has too [s].

    Raises:
        ConfigError: if the floor is not positive.
    """

    def __init__(self, string: VehicleString, floor: float = 0.01) -> None:
        require_positive("scenario.pieces.ttc", floor=floor)
        reads = [(VEHICLES, "gap"), (VEHICLES, "relative_speed")]
        super().__init__(reads, [(VEHICLES, "ttc")], (len(string), 1))
        self.floor = floor

    def compute(self, gap: Tensor, relative_speed: Tensor) -> Tensor:
        """Return the time-to-collision, ``[*batch, N, 1]``."""
        return time_to_collision(gap, -relative_speed, self.floor)


class TimeGap(Feature):
    """Writes the time gap of every vehicle, ``("vehicles", "time_gap")`` [s] (A12).

    Args:
        string: the string of vehicles.
        speed_floor: speeds below this count as this; 0 is the literal rule [m/s].

    Raises:
        ConfigError: if the floor is negative.
    """

    def __init__(self, string: VehicleString, speed_floor: float = 1.0) -> None:
        require_in("scenario.pieces.time_gap", "[0, inf)", speed_floor=speed_floor)
        reads = [(VEHICLES, "gap"), (VEHICLES, "speed")]
        super().__init__(reads, [(VEHICLES, "time_gap")], (len(string), 1))
        self.speed_floor = speed_floor

    def compute(self, gap: Tensor, speed: Tensor) -> Tensor:
        """Return the time gap, ``[*batch, N, 1]``."""
        return time_gap(gap, speed, self.speed_floor)


class MotorPower(StepTransform):
    """Writes the motor power of the step just taken [W] (A2): from the speed at its start.

    Args:
        string: the string of vehicles.
        vehicles: whose power: ``"vehicles"`` for all of them, or a role.
        acceleration: entry of theirs that holds the acceleration; ``"predicted_acceleration"``
            for what an automated vehicle believes of a human driver (A16).
        power: entry of theirs that is written.
        recuperation: count negative (braking) power.
    """

    def __init__(
        self,
        string: VehicleString,
        vehicles: str = VEHICLES,
        acceleration: str = "acceleration",
        power: str = "power",
        recuperation: bool = True,
    ) -> None:
        everybody = vehicles == VEHICLES
        speed = f"{VEHICLES}.speed" if everybody else "self.speed"
        source = next_key((vehicles, acceleration))
        self.views = Views(string, vehicles, [speed, ".".join(source)])
        count = len(string) if everybody else string.count(vehicles)
        super().__init__(self.views.keys, [as_key((vehicles, power))], event_shape=(count, 1))
        self.recuperation = recuperation

    def compute(self, *entries: Tensor) -> Tensor:
        """Return the motor power, ``[*batch, n, 1]``."""
        speed, acceleration = self.views(*entries)
        return motor_power(speed, acceleration, self.recuperation)
