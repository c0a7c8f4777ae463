"""What the pieces of an environment share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lcc_rl.energy import Fleet, as_fleet
from lcc_rl.functional.pattern import VehicleString


@dataclass(frozen=True)
class World:
    """What the pieces of an environment share; by default one automated vehicle at 10 Hz.

    Args:
        string: the string of vehicles.
        time_step: duration of a step [s].
        horizon: steps of an episode.
        profiles: speed profiles of the leader.
        population: the human drivers.
        energy: the energy models of the vehicles.
        nominal: leaders and starts as in an evaluation, without the deviations of training.
    """

    string: VehicleString = field(default_factory=VehicleString)
    time_step: float = 0.1
    horizon: int = 300
    profiles: Any = None
    population: Any = None
    energy: Fleet = field(default_factory=lambda: as_fleet(None))
    nominal: bool = False
