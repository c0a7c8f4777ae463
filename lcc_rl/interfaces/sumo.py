"""Policies and rules of this package in a SUMO simulation.

::

    libsumo.start(["sumo", "-c", "my.sumocfg", "--step-length", "0.1"])
    bridge = Bridge("pretrained/i24-follow5", ["car7"])
    while libsumo.simulation.getMinExpectedNumber():
        bridge.command()
        libsumo.simulationStep()
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from typing import Any
from unittest.mock import patch

from lcc_rl.errors import Diverged, needing, require
from lcc_rl.interfaces.driver import MEASURED, Driver
from lcc_rl.interfaces.exported import Safety
from lcc_rl.pieces.controllers import Population

log = logging.getLogger("lcc_rl")

UNCHECKED, RELEASED = 0, -1.0  # SUMO's speed mode without checks; speed that releases a vehicle


def load_sumo() -> Any:
    """Return the module ``libsumo``, imported without its message on pyarrow's version.

    Raises:
        ConfigError: if it is not installed.
    """
    # Only during the import: otherwise it would replace SUMO's module traci, too.
    quiet = patch.dict(os.environ, {"LIBSUMO_AS_TRACI": "quiet"})
    with needing("sumo", "libsumo is not installed"), quiet:
        import libsumo
    return libsumo


class Bridge:
    """Drives vehicles of the SUMO simulation in libsumo by a policy or a rule.

    Commands are executed exactly: SUMO's checks of speeds, right of way and traffic lights are off
    for these vehicles (speed mode 0). Without a vehicle ahead within ``sight``, SUMO's own model
    drives, and the memory starts anew. Without a vehicle behind, one at the own speed and gap is
    assumed, unless the policy observes its presence. SUMO changes lanes.

    Args:
        driver: a policy or a rule, see :class:`lcc_rl.interfaces.driver.Driver`.
        vehicles: ids of the driven vehicles, which may enter later, or a predicate on ids.
        sight: largest gap ahead and behind that is measured, bumper to bumper [m]. SUMO itself
            looks by edges: on the car's own edge it finds a leader at any distance.
        trust, safety, seed, drivers: see :class:`lcc_rl.interfaces.driver.Driver`.

    Raises:
        LccError: if libsumo is missing or runs no simulation, or the driver cannot be used.
    """

    def __init__(
        self,
        driver: Any,
        vehicles: str | Sequence[str] | Callable[[str], bool],
        sight: float = 150.0,
        trust: Sequence[str] = (),
        seed: int = 0,
        safety: Safety = None,
        drivers: Population | None = None,
    ) -> None:
        self.sumo = load_sumo()
        require(self.sumo.isLoaded(), "SUMO runs no simulation: call libsumo.start([…]) first")
        delta = self.sumo.simulation.getDeltaT()
        self.driver = Driver(driver, delta, trust, safety, seed, drivers)
        names = {vehicles} if isinstance(vehicles, str) else vehicles
        self.chosen = names if callable(names) else set(names).__contains__
        self.sight = sight
        kinds = self.sumo.vehicletype
        slow = [kind for kind in kinds.getIDList() if kinds.getActionStepLength(kind) > delta]
        if slow and self.sumo.simulation.getOption("step-method.ballistic") != "true":
            text = "actionStepLength of %s exceeds the step of %g s: SUMO then moves all vehicles "
            log.warning(text + "by ballistic steps, not by Euler's", ", ".join(slow), delta)
        self.modes: dict[str, int] = {}  # original speed modes of commanded vehicles

    def command(self, execute: bool = True) -> dict[str, float]:
        """Set the speeds of the driven vehicles after SUMO's next step.

        Args:
            execute: False: update memories only, while SUMO's own model drives.

        Returns:
            The commanded accelerations by vehicle [m/s²].

        Raises:
            Diverged: if a command is not finite; SUMO would then use its own model.
        """
        cars = self.sumo.vehicle
        present = cars.getIDList()
        rows = {car: self._measured(car) for car in present if self.chosen(car)}
        measured = {car: row for car, row in rows.items() if row is not None}
        for car in [car for car in self.modes if not execute or car not in measured]:
            self._release(car, car in present)
        columns = zip(*measured.values(), strict=True) if measured else [()] * len(MEASURED)
        try:
            result = self.driver.step(dict(zip(MEASURED, columns, strict=True)), list(measured))
        except Diverged as error:
            raise Diverged(f"{error} at {self.sumo.simulation.getTime():g} s") from error
        commands = dict(zip(measured, result.tolist(), strict=True))
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
        """Return the entries :data:`MEASURED` of a vehicle; None without a vehicle ahead."""
        cars = self.sumo.vehicle
        ahead, free = cars.getLeader(car, self.sight) or ("", 0.0)
        gap = free + cars.getMinGap(car)  # SUMO's gaps exclude the minimum gap
        if not ahead or gap > self.sight:
            return None
        motion = (cars.getSpeed(car), gap, cars.getAcceleration(car))
        lead = (cars.getSpeed(ahead), cars.getAcceleration(ahead))
        behind, free = cars.getFollower(car, self.sight) or ("", 0.0)
        room = free + cars.getMinGap(behind) if behind else 0.0
        if not behind or room > self.sight:
            return (*motion, *lead, 0.0, 0.0, 0.0, 0.0)
        return (*motion, *lead, cars.getSpeed(behind), room, cars.getAcceleration(behind), 1.0)
