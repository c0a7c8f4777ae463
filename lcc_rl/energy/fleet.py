"""Which vehicle has which energy model: one for all, or classes drawn by share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from lcc_rl.energy.base import BURNT, EnergyModel
from lcc_rl.energy.electric import PaperMotor
from lcc_rl.errors import ConfigError, unknown_name
from lcc_rl.functional.guard import unchanged

Quantity = Callable[[EnergyModel, Tensor, Tensor], Tensor]


class Fleet:
    """The energy models of the vehicles of a string.

    Args:
        models: by the name of the class.
        shares: share of each class among the vehicles; None for equal shares.
        roles: shares among the vehicles of a role, where they differ.
    """

    def __init__(
        self,
        models: Mapping[str, EnergyModel],
        shares: Mapping[str, float] | None = None,
        roles: Mapping[str, Mapping[str, float]] | None = None,
    ) -> None:
        if not models:
            raise ConfigError("energy.models is empty: a mixture needs at least one model")
        self.names = list(models)
        self.models = list(models.values())
        shares = dict.fromkeys(self.names, 1.0) if shares is None else shares
        self.shares = self._checked(shares, "energy.shares")
        self.roles = {
            role: self._checked(own, f"energy.roles.{role}") for role, own in (roles or {}).items()
        }

    def _checked(self, shares: Mapping[str, float], where: str) -> list[float]:
        """Return the shares of all classes, which add up to one."""
        for name in shares:
            if name not in self.names:
                raise unknown_name(f"class of {where}", name, self.names)
        total = sum(shares.values())
        if not total > 0.0 or min(shares.values()) < 0.0:
            raise ConfigError(f"{where}: shares must not be negative, and one must be above 0")
        return [shares.get(name, 0.0) / total for name in self.names]

    def power(self, speed: Tensor, acceleration: Tensor, kind: Tensor | None = None) -> Tensor:
        """Return the power drawn [W], see :meth:`EnergyModel.power`.

        Args:
            speed: speed at the start of a step, any shape [m/s].
            acceleration: executed acceleration, same shape [m/s²].
            kind: number of each vehicle's class, same shape, int64; None: all have the first.
        """
        return self._of(lambda model, *motion: model.power(*motion), speed, acceleration, kind)

    def path_power(self, speed: Tensor, acceleration: Tensor, kind: Tensor | None = None) -> Tensor:
        """Return the power without what the motion stores [W]; arguments as of :meth:`power`."""
        return self._of(lambda model, *motion: model.path_power(*motion), speed, acceleration, kind)

    def stored_energy(self, speed: Tensor, kind: Tensor | None = None) -> Tensor:
        """Return what a speed is worth [J], see :meth:`EnergyModel.stored_energy`."""
        return self._of(lambda model, v, _: model.stored_energy(v), speed, speed, kind)

    def acceleration_loss(
        self, speed: Tensor, acceleration: Tensor, kind: Tensor | None = None
    ) -> Tensor | None:
        """Return what accelerating loses [W]; None unless all models have such a part."""
        return self._known("acceleration_loss", all, speed, acceleration, kind)

    def infeasible(
        self, speed: Tensor, acceleration: Tensor, kind: Tensor | None = None
    ) -> Tensor | None:
        """Return where a vehicle cannot accelerate like this; None if no model defines it."""
        return self._known("infeasible", any, speed, acceleration, kind)

    def burnt(self, energy: Tensor, kind: Tensor | None = None) -> dict[str, Tensor]:
        """Return :data:`BURNT` of energies drawn [J], of whatever shape; empty if none burns fuel.

        Vehicles without fuel add nothing.
        """
        if not any(model.heating_value for model in self.models):
            return {}

        def part(number: int) -> Tensor:
            return self._of(lambda model, x, _: model.burnt(x)[number], energy, energy, kind)

        return {name: part(number) for number, name in enumerate(BURNT)}

    def _known(self, name: str, enough: Any, *motion: Any) -> Tensor | None:
        """Return what models define, false of the others; None unless enough define it."""
        base = getattr(EnergyModel, name)
        if not enough(getattr(type(model), name) is not base for model in self.models):
            return None

        def of(model: EnergyModel, speed: Tensor, acceleration: Tensor) -> Tensor:
            found = getattr(model, name)(speed, acceleration)
            return torch.zeros_like(speed, dtype=torch.bool) if found is None else found

        return self._of(of, *motion)

    def _of(
        self, quantity: Quantity, speed: Tensor, acceleration: Tensor, kind: Tensor | None
    ) -> Tensor:
        def of(model: EnergyModel) -> Tensor:
            title, motion = type(model).__name__, (speed, acceleration)
            return unchanged(partial(quantity, model), motion, title, ("speed", "acceleration"))

        found = of(self.models[0])
        if kind is not None:
            for number, model in enumerate(self.models[1:], 1):
                found = torch.where(kind == number, of(model), found)
        return found


def as_fleet(energy: EnergyModel | Fleet | None) -> Fleet:
    """Return one model, or that of the ALCC paper for None, as that of a whole fleet."""
    if isinstance(energy, Fleet):
        return energy
    return Fleet({"all": PaperMotor() if energy is None else energy})
