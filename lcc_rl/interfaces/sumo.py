"""Vehicles of a SUMO simulation, driven by a policy or a rule of this package.

::

    libsumo.start(["sumo", "-c", "my.sumocfg", "--step-length", "0.1"])
    bridge = Bridge("pretrained/i24-follow5", ["car7"])
    while libsumo.simulation.getMinExpectedNumber():
        bridge.command()
        libsumo.simulationStep()
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from typing import Any
from unittest.mock import patch

import torch

from lcc_rl.errors import ConfigError, Diverged, how_to_install
from lcc_rl.interfaces.driver import PRESENT_KEY, Driver, Measured, state_of
from lcc_rl.pieces.base import SEED, STEP, State

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
    off for the driven vehicles (speed mode 0). SUMO's own model drives a vehicle that sees nobody
    ahead within ``sight``; its memory then begins anew. If nobody is behind and the policy does
    not observe that, a vehicle at the own speed and gap is assumed. SUMO changes lanes.

    Args:
        driver: a run, a run folder, a policy file, ``pretrained/<name>``, or a controller by name
            (``"idm_acc"``), as object, class, function, file or node, as :func:`lcc_rl.compare`
            takes it.
        vehicles: ids of the driven vehicles, which may enter later, or a predicate on ids.
        sight: distance at which a vehicle ahead is seen, bumper to bumper [m].
        trust: modules outside this package that a policy may name.
        seed: seed of the drivers' noise.

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
    ) -> None:
        self.sumo = load_sumo()
        if not self.sumo.isLoaded():
            raise ConfigError("SUMO runs no simulation: call libsumo.start([…]) first")
        self.driver = Driver(driver, self.sumo.simulation.getDeltaT(), trust)
        names = {vehicles} if isinstance(vehicles, str) else vehicles
        self.chosen = names if callable(names) else set(names).__contains__
        self.sight, self.seed, self.begun = sight, seed, 0
        self.tells = PRESENT_KEY in self.driver.reads()
        self.keys = [*self.driver.kept, SEED, STEP]
        self.driven: dict[str, State] = {}  # what each vehicle remembers: the keys
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
        for car in [car for car in self.driven if car not in measured]:
            self._release(car, car in present)
        if not measured:
            return {}
        for car, row in measured.items():
            if car not in self.driven:
                self._take(car, state_of([row]))
        before = {key: torch.cat([self.driven[car][key] for car in measured]) for key in self.keys}
        wanted, after = self.driver(state_of(list(measured.values())) | before, before)
        after |= {SEED: before[SEED], STEP: before[STEP] + 1}
        commands = dict(zip(measured, wanted.tolist(), strict=True))
        for car, acceleration in commands.items():
            if not math.isfinite(acceleration):
                when = f"at {self.sumo.simulation.getTime():g} s"
                raise Diverged(f"{self.driver.name}: the command of {car} is {acceleration} {when}")
        for place, (car, acceleration) in enumerate(commands.items()):
            if execute:
                self._set(car, cars.getSpeed(car) + acceleration * self.driver.time_step)
            self.driven[car] = {key: entry[place : place + 1] for key, entry in after.items()}
        return commands

    def release(self) -> None:
        """Return all vehicles to SUMO's own model."""
        present = self.sumo.vehicle.getIDList()
        for car in list(self.driven):
            self._release(car, car in present)

    def _take(self, car: str, state: State) -> None:
        own = {SEED: torch.tensor([[self.seed + self.begun]]), STEP: torch.zeros(1, 1).long()}
        self.driven[car] = own | self.driver.begin(state | own)
        self.begun += 1

    def _set(self, car: str, speed: float) -> None:
        if car not in self.modes:
            self.modes[car] = self.sumo.vehicle.getSpeedMode(car)
            self.sumo.vehicle.setSpeedMode(car, UNCHECKED)
        self.sumo.vehicle.setSpeed(car, max(speed, 0.0))

    def _release(self, car: str, present: bool) -> None:
        del self.driven[car]
        mode = self.modes.pop(car, None)
        if present and mode is not None:
            self.sumo.vehicle.setSpeedMode(car, mode)
            self.sumo.vehicle.setSpeed(car, RELEASED)

    def _measured(self, car: str) -> Measured | None:
        cars = self.sumo.vehicle
        ahead, free = cars.getLeader(car, self.sight) or ("", 0.0)
        gap = free + cars.getMinGap(car)  # SUMO's gaps are without the least one desired
        if not ahead or gap > self.sight:
            return None
        own = (cars.getSpeed(car), gap, cars.getAcceleration(car))
        lead = (cars.getSpeed(ahead), cars.getAcceleration(ahead))
        behind, free = cars.getFollower(car, self.sight) or ("", 0.0)
        other: tuple[float, float, float] = (own[0], gap, 0.0)
        if self.tells:
            other = (0.0, 0.0, 0.0)
        if behind:
            room = free + cars.getMinGap(behind)
            other = (cars.getSpeed(behind), room, cars.getAcceleration(behind))
        return Measured(*own, *lead, *other, float(bool(behind)))
