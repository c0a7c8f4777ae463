"""Vehicles of a SUMO simulation, driven by a policy or a rule of this package.

::

    libsumo.start(["sumo", "-c", "my.sumocfg", "--step-length", "0.1"])
    bridge = Bridge("pretrained/i24-follow5", ["car7"])
    while libsumo.simulation.getMinExpectedNumber():
        bridge.command()
        libsumo.simulationStep()
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any
from unittest.mock import patch

from lcc_rl.errors import ConfigError, Diverged, how_to_install
from lcc_rl.interfaces.driver import MEASURED, Driver
from lcc_rl.pieces import CBFFilter
from lcc_rl.pieces.controllers import Population

UNCHECKED, RELEASED = 0, -1.0  # SUMO's speed mode without checks, and the speed that releases


def load_sumo() -> Any:
    """Return the module ``libsumo``, imported without its line about pyarrow's version.

    Raises:
        ConfigError: if it is not installed.
    """
    try:
        # Only meanwhile: in the environment it would also replace SUMO's module traci.
        with patch.dict(os.environ, {"LIBSUMO_AS_TRACI": "quiet"}):
            import libsumo
    except ImportError as error:
        raise ConfigError(f"libsumo is not installed: {how_to_install('sumo')}") from error
    return libsumo


class Bridge:
    """Lets a policy or a rule drive vehicles of the SUMO simulation that runs in libsumo.

    The commands are executed exactly: SUMO's checks of speeds, right of way and traffic lights are
    off for the driven vehicles (speed mode 0). SUMO's own model drives a vehicle that sees none
    ahead within ``sight``; its memory then begins anew. If none is behind and the policy does
    not observe that, a vehicle at the own speed and gap is assumed. SUMO changes lanes.

    Args:
        driver: a policy or a rule, as :class:`lcc_rl.interfaces.driver.Driver` takes it.
        vehicles: ids of the driven vehicles, which may enter later, or a predicate on ids.
        sight: distance at which a vehicle ahead is seen, bumper to bumper [m].
        trust, safety, seed, drivers: see :class:`lcc_rl.interfaces.driver.Driver`.

    Raises:
        LccError: if libsumo is missing or runs no simulation, or the driver cannot drive there.
    """

    def __init__(
        self,
        driver: Any,
        vehicles: str | Sequence[str] | Callable[[str], bool],
        sight: float = 150.0,
        trust: Sequence[str] = (),
        seed: int = 0,
        safety: CBFFilter | None = None,
        drivers: Population | None = None,
    ) -> None:
        self.sumo = load_sumo()
        if not self.sumo.isLoaded():
            raise ConfigError("SUMO runs no simulation: call libsumo.start([…]) first")
        delta = self.sumo.simulation.getDeltaT()
        self.driver = Driver(driver, delta, trust, safety, seed, drivers)
        names = {vehicles} if isinstance(vehicles, str) else vehicles
        self.chosen = names if callable(names) else set(names).__contains__
        self.sight = sight
        self.modes: dict[str, int] = {}  # of those commanded, their speed modes before

    def command(self, execute: bool = True) -> dict[str, float]:
        """Set the speeds that the driven vehicles have after SUMO's next step.

        Args:
            execute: False to update memories only, while SUMO's own model drives.

        Returns:
            The accelerations commanded, by vehicle [m/s²].

        Raises:
            Diverged: if a command is no number; SUMO would drive with its own model instead.
        """
        cars = self.sumo.vehicle
        present = cars.getIDList()
        seen = {car: self._measured(car) for car in present if self.chosen(car)}
        measured = {car: row for car, row in seen.items() if row is not None}
        for car in [car for car in self.modes if car not in measured]:
            self._release(car, car in present)
        columns = zip(*measured.values(), strict=True) if measured else [()] * len(MEASURED)
        try:
            wanted = self.driver.step(dict(zip(MEASURED, columns, strict=True)), list(measured))
        except Diverged as error:
            raise Diverged(f"{error} at {self.sumo.simulation.getTime():g} s") from error
        commands = dict(zip(measured, wanted.tolist(), strict=True))
        for car, acceleration in commands.items() if execute else ():
            self._set(car, cars.getSpeed(car) + acceleration * self.driver.time_step)
        return commands

    def release(self) -> None:
        """Return all vehicles to SUMO's own model."""
        present = self.sumo.vehicle.getIDList()
        for car in list(self.modes):
            self._release(car, car in present)
        self.driver.reset(self.driver.cars)

    def _set(self, car: str, speed: float) -> None:
        if car not in self.modes:
            self.modes[car] = self.sumo.vehicle.getSpeedMode(car)
            self.sumo.vehicle.setSpeedMode(car, UNCHECKED)
        self.sumo.vehicle.setSpeed(car, max(speed, 0.0))

    def _release(self, car: str, present: bool) -> None:
        mode = self.modes.pop(car)
        if present:
            self.sumo.vehicle.setSpeedMode(car, mode)
            self.sumo.vehicle.setSpeed(car, RELEASED)

    def _measured(self, car: str) -> tuple[float, ...] | None:
        """Return what :data:`MEASURED` names of a vehicle; None if it sees no vehicle ahead."""
        cars = self.sumo.vehicle
        ahead, free = cars.getLeader(car, self.sight) or ("", 0.0)
        gap = free + cars.getMinGap(car)  # SUMO's gaps are without the least one desired
        if not ahead or gap > self.sight:
            return None
        own = (cars.getSpeed(car), gap, cars.getAcceleration(car))
        lead = (cars.getSpeed(ahead), cars.getAcceleration(ahead))
        behind, free = cars.getFollower(car, self.sight) or ("", 0.0)
        if not behind:
            return (*own, *lead, 0.0, 0.0, 0.0, 0.0)
        room = free + cars.getMinGap(behind)
        return (*own, *lead, cars.getSpeed(behind), room, cars.getAcceleration(behind), 1.0)
