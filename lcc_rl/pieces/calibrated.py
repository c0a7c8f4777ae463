"""Drivers of a population with one or several models."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import torch
from torch import Tensor

from lcc_rl.errors import ConfigError
from lcc_rl.functional.driver_models import DriverConstants
from lcc_rl.functional.laws import LAWS
from lcc_rl.pieces.drivers import LONGEST_TIME_GAP, Drivers
from lcc_rl.pieces.world import World


class CalibratedDrivers(Drivers):
    """Drivers of the population; each follows its calibrated model and parameters."""

    tells_gap = True
    further = ("driver",)
    kinds: ClassVar[Tensor]

    def setup(self, world: World) -> None:
        super().setup(world)
        population = world.population
        models = getattr(population, "models", None) or ("idm",) * len(population.time_gap)
        self.models = [name for name in LAWS if name in models]
        self.register_buffer("kinds", torch.tensor([self.models.index(name) for name in models]))
        for name, values in population.parameters().items():
            # Parameters that a driver's model lacks are computed, too, and need a finite gradient.
            otherwise = [getattr(LAWS[model], name, 1.0) for model in self.models]
            self.register_buffer(f"own_{name}", values.float().nan_to_num(nan=otherwise[0]))

    def described(self, world: World, where: str) -> tuple[Tensor, Tensor, DriverConstants]:
        """Return the drivers, see :class:`Drivers`."""
        if not hasattr(world.population, "parameters"):
            raise ConfigError(f"{where}: expected a population with its drivers' parameters")
        return super().described(world, where)

    def acceleration(self, speed: Tensor, *more: Tensor) -> Tensor:
        """Return the desired acceleration of each driver by its model."""
        gap, relative_speed, desired_speed, time_gap, driver = more
        motion = (speed, gap, -relative_speed, desired_speed, time_gap)
        return self._each(driver, lambda law: law(*motion))

    def equilibrium_gap(
        self, speed: Tensor, desired_speed: Tensor, time_gap: Tensor, driver: Tensor
    ) -> Tensor:
        """Return the equilibrium gap of each driver by its model."""
        steady = (speed, desired_speed, time_gap, LONGEST_TIME_GAP)
        return self._each(driver, lambda law: law.equilibrium_gap(*steady))

    def _each(self, driver: Tensor, quantity: Callable[[DriverConstants], Tensor]) -> Tensor:
        kind, result = self.kinds[driver], None
        for number, name in enumerate(self.models):
            law = LAWS[name]
            constants = {x: getattr(self, f"own_{x}")[driver] for x in law.shared()}
            values = quantity(law(**constants))
            result = values if result is None else torch.where(kind == number, values, result)
        assert result is not None  # a population holds drivers
        return result
