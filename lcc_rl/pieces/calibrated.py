"""Drivers of a population of one or several models, each by its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lcc_rl.errors import ConfigError
from lcc_rl.functional.driver_models import DriverConstants, DriverLaw
from lcc_rl.functional.laws import LAWS
from lcc_rl.functional.pattern import HUMAN, VehicleString
from lcc_rl.pieces.controllers import Population
from lcc_rl.pieces.drivers import LONGEST, DriverModel


class CalibratedDrivers(DriverModel):
    """Drivers of the population, each by the model and parameters that were calibrated.

    Args:
        population: the drivers, of one model or several.
        time_step, noise, wiener, delay, string, role: see
            :class:`lcc_rl.pieces.drivers.DriverModel`.

    Raises:
        ConfigError: if a setting is out of range or the population does not tell its parameters.
    """

    tells_gap = True
    further = ("driver",)
    kinds: Tensor

    def __init__(
        self,
        population: Population,
        time_step: float,
        noise: float = 0.05,
        wiener: float = 0.0,
        delay: int = 0,
        string: VehicleString | None = None,
        role: str = HUMAN,
    ) -> None:
        super().__init__(
            population, time_step, noise, wiener, delay=delay, string=string, role=role
        )
        drivers = len(population.time_gap)
        models = getattr(population, "models", None) or ("idm",) * drivers
        self.models = [name for name in LAWS if name in models]
        kinds = torch.tensor([self.models.index(name) for name in models])
        self.register_buffer("kinds", kinds)
        for name, values in population.parameters().items():  # type: ignore[attr-defined]
            # What a driver's model lacks is computed, too, and must have a gradient.
            otherwise = [getattr(LAWS[model].constants, name, 1.0) for model in self.models]
            single = values.float().nan_to_num(nan=otherwise[0])
            self.register_buffer(f"own_{name}", single)

    def _checked(self, where: str, population: Population, *_: Any) -> DriverConstants:
        if not hasattr(population, "parameters"):
            raise ConfigError(f"{where}: expected a population that tells its drivers' parameters")
        return population.constants

    def acceleration(self, speed: Tensor, *more: Tensor) -> Tensor:
        """Return what the drivers wish, each by its own model."""
        gap, relative_speed, desired_speed, time_gap, driver = more
        motion = (speed, gap, -relative_speed, desired_speed, time_gap)
        return self._each(driver, lambda law, own: law.acceleration(*motion, own))

    def equilibrium_gap(
        self, speed: Tensor, desired_speed: Tensor, time_gap: Tensor, driver: Tensor
    ) -> Tensor:
        """Return the gap at which drivers follow steadily, each by its own model."""
        steady = (speed, desired_speed, time_gap)
        return self._each(driver, lambda law, own: law.equilibrium_gap(*steady, own, LONGEST))

    def _each(self, driver: Tensor, quantity: Callable[[DriverLaw, Any], Tensor]) -> Tensor:
        kind, found = self.kinds[driver], None
        for number, name in enumerate(self.models):
            law = LAWS[name]
            own = {part: getattr(self, f"own_{part}")[driver] for part in law.shared}
            values = quantity(law, law.constants().with_(**own))
            found = values if found is None else torch.where(kind == number, values, found)
        assert found is not None  # a population holds drivers
        return found
