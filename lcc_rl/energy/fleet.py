"""Classes of vehicles: energy model, length and limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from functools import partial
from typing import Annotated, Any, Self

import torch
from pydantic import Field, InstanceOf
from torch import Tensor

from lcc_rl.energy.base import BURNT, GRAVITY, STEEPEST, EnergyModel
from lcc_rl.energy.electric import PaperMotor
from lcc_rl.errors import ConfigError, raised_as, require, require_known
from lcc_rl.functional.guard import check_independent, unchanged
from lcc_rl.functional.pattern import HUMAN
from lcc_rl.settings import Positive, Settings, values

Quantity = Callable[[EnergyModel, Tensor, Tensor], Tensor]
# Distance of commands from the largest acceleration, which rounded speeds would exceed [m/s²].
ROUNDING = 1e-3
MASSES = (50.0, 200_000.0)  # of vehicles [kg]
# Speed [m/s] at which power and kinetic energy are compared, and their largest factor: the motor of
# the ALCC paper has 2.6, other shipped models 0.6 to 1.1; km/h for m/s have 3.6.
PROBE, MOST_OFF = 10.0, 3.0
UPHILL = 0.01  # grade at which power and height are compared [rad]
HEATS, DENSITIES = (5e3, 150e3), (0.05, 1.5)  # of fuels, alcohols to hydrogen [J/g], [kg/L]


class VehicleClass(Settings):
    """A class of vehicles: energy model, length and limits.

    Its acceleration is at most :meth:`lcc_rl.energy.EnergyModel.strongest` (power divided by mass
    and speed, minus the resistances), and its speed at most its speed limit.
    """

    energy: InstanceOf[EnergyModel]  # mass, power, resistances and energy
    share: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0  # of the vehicles of its roles
    # Roles of the vehicles of this class.
    roles: Annotated[tuple[str, ...], Field(min_length=1)] = (HUMAN,)
    length: Positive = 5.0  # [m]
    speed_limit: Positive | None = None  # None: limited by its power only [m/s]
    bounded: bool = True  # False: it accelerates as commanded, without limits of power

    def validate(self) -> None:
        kind, mass, share = type(self.energy).__name__, self.energy.mass, self.energy.efficiency
        fits = MASSES[0] <= mass <= MASSES[1]
        text = f"{kind}: an energy model needs its mass, {MASSES[0]:g} to {MASSES[1]:g} kg"
        require(fits, f"{text}, got {mass!r}")
        if not isinstance(grade := getattr(self.energy, "grade", 0.0), Tensor):
            require(
                abs(grade) <= STEEPEST, f"{kind}: grade must be at most {STEEPEST} rad, got {grade}"
            )
        require(0.0 < share <= 1.0, f"{kind}: efficiency must lie from 0 to 1, got {share!r}")
        fuel, density = self.energy.heating_value, self.energy.density
        for name, number, (least, most), unit in (
            ("heating_value", fuel, HEATS, "J/g"),
            ("density", density, DENSITIES, "kg/L"),
        ):
            text = f"{kind}: {name} must lie from {least:g} to {most:g} {unit}, got {number!r}"
            require(not fuel or least <= number <= most, text)
        self._check_power(kind)

    def _check_power(self, kind: str) -> None:
        """Refuse a power that depends on more than its motion, or is not in W for m/s, kg, rad."""
        model, graded = self.energy, hasattr(self.energy, "grade")
        motion = torch.full((2,), PROBE), torch.tensor([0.0, 0.1])
        with raised_as(ConfigError, f"{kind}.power", Exception):
            level = model.on(0.0) if graded else model  # uphill the engine may be at its limit
            power = unchanged(level.power, motion, kind, ("speed", "acceleration"))
            shape = [*power.shape]
            require(shape == [2], f"its shape is {shape} for speeds of shape [2]")
            check_independent(kind, ["power"], lambda *x: [level.power(*x)], motion)
        steady, faster = power.tolist()
        with raised_as(ConfigError, f"{kind}.power with the grade as a tensor", Exception):
            uphill = model.on(torch.full((2,), UPHILL)).power(*motion)[0] if graded else steady
        stored = PROBE * model.inertia / model.efficiency
        lifted = PROBE * model.mass / model.efficiency * GRAVITY * UPHILL
        of = "W per m/s², its kinetic energy"
        self._check_rise(kind, (faster - steady) / 0.1, of, stored, "are these in W, m/s and kg")
        if graded:
            of = f"W for a grade of {UPHILL:g} rad, its height"
            self._check_rise(
                kind, float(uphill) - steady, of, lifted, "does it use the grade, in rad"
            )

    def _check_rise(self, kind: str, risen: float, of: str, stored: float, ask: str) -> None:
        """Refuse a rise of power that differs much from that of the energy stored."""
        require(
            stored / MOST_OFF <= risen <= stored * MOST_OFF,
            f"{kind}.power at {PROBE:g} m/s rises by {risen:.4g} {of} by {stored:.4g} W (mass "
            f"{self.energy.mass:g} kg, efficiency {self.energy.efficiency:g}): {ask}?",
        )

    def at(self, grade: Tensor) -> Self:
        """Return the class on a road with a grade at each sample [rad]."""
        found = copy(self)
        found.energy = self.energy.at(grade)
        return found

    def within(self, command: Tensor, speed: Tensor, time_step: float) -> Tensor:
        """Return commands within the vehicle's power and its speed limit [m/s²].

        Args:
            command: commanded acceleration, any shape [m/s²].
            speed: speed at the start of the step, same shape [m/s].
            time_step: duration of the step [s].
        """
        strongest = self.energy.strongest(speed) if self.bounded else None
        if strongest is not None:
            command = torch.minimum(command, strongest - ROUNDING)
        if self.speed_limit is not None:
            command = torch.minimum(command, (self.speed_limit - speed) / time_step)
        return command


class Fleet:
    """The classes of the vehicles of a string.

    Args:
        models: energy models by the name of the class; such a class has no limits.
        shares: share of each class among the vehicles; None for equal shares.
        roles: shares among the vehicles of a role, if they differ.
    """

    def __init__(
        self,
        models: Mapping[str, EnergyModel],
        shares: Mapping[str, float] | None = None,
        roles: Mapping[str, Mapping[str, float]] | None = None,
    ) -> None:
        require(models, "energy.models is empty: a mixture needs at least one model")
        self.classes = {x: VehicleClass(energy=own, bounded=False) for x, own in models.items()}
        shares = dict.fromkeys(self.names, 1.0) if shares is None else shares
        self.shares = self._checked(shares, "energy.shares")
        self.roles = {
            role: self._checked(own, f"energy.roles.{role}") for role, own in (roles or {}).items()
        }

    def _checked(self, shares: Mapping[str, float], where: str) -> list[float]:
        """Return the shares of all classes, which add up to one."""
        require_known(f"class of {where}", shares, self.names)
        total = sum(shares.values())
        if not total > 0.0 or min(shares.values()) < 0.0:
            raise ConfigError(f"{where}: shares must not be negative, and one must be above 0")
        return [shares.get(name, 0.0) / total for name in self.names]

    @property
    def names(self) -> list[str]:
        """The names of the classes, by number."""
        return list(self.classes)

    @property
    def models(self) -> list[EnergyModel]:
        """The energy models of the classes, by number."""
        return [one.energy for one in self.classes.values()]

    def extended(self, classes: Mapping[str, VehicleClass], length: float) -> Self:
        """Return the fleet with further classes.

        Args:
            classes: classes by name; the rest of a role is divided as before.
            length: length of the vehicles of all other classes [m].

        Raises:
            ConfigError: if a name is taken, or the shares of a role exceed 1.
        """
        if taken := set(classes) & set(self.names):
            raise ConfigError(f"scenario.fleet: energy has a class {min(taken)}, too; rename one")
        found, none = copy(self), [0.0] * len(classes)
        old = {
            x: VehicleClass(**values(one) | {"length": length}) for x, one in self.classes.items()
        }
        found.classes = {**old, **classes}
        found.shares = [*self.shares, *none]
        found.roles = {role: [*own, *none] for role, own in self.roles.items()}
        for role in dict.fromkeys(role for one in classes.values() for role in one.roles):
            added = [one.share * (role in one.roles) for one in classes.values()]
            if (rest := 1.0 - sum(added)) < -1e-6:
                raise ConfigError(
                    f"scenario.fleet: the shares of {role} must not exceed 1, got {sum(added):g}"
                )
            own = self.roles.get(role, self.shares)
            found.roles[role] = [*(max(rest, 0.0) * share for share in own), *added]
        return found

    def at(self, grade: Tensor | None) -> Self:
        """Return the fleet on a road with a grade at each sample, of the shape of speeds [rad].

        Args:
            grade: None for the fleet itself.

        Raises:
            ConfigError: if an energy model has no grade.
        """
        if grade is None:
            return self
        found = copy(self)
        found.classes = {name: one.at(grade) for name, one in self.classes.items()}
        return found

    @property
    def level(self) -> bool:
        """Whether the road is level for all classes."""
        return all(model.level for model in self.models)

    @property
    def limited(self) -> bool:
        """Whether a class has limits."""
        return any(one.bounded or one.speed_limit for one in self.classes.values())

    def longest(self, role: str) -> float:
        """Return the length of the longest vehicle of a role [m]."""
        shares = self.roles.get(role, self.shares)
        met = zip(self.classes.values(), shares, strict=True)
        return max(one.length for one, share in met if share > 0.0)

    def within(self, command: Tensor, speed: Tensor, time_step: float, kind: Tensor) -> Tensor:
        """Return commands within the limits of each vehicle, see :meth:`VehicleClass.within`."""
        found = command
        for number, one in enumerate(self.classes.values()):
            found = torch.where(kind == number, one.within(command, speed, time_step), found)
        return found

    def lengths(self, kind: Tensor) -> Tensor:
        """Return the length of each vehicle by its class, same shape [m]."""
        return self._of_class([one.length for one in self.classes.values()], kind)

    def speed_limits(self, kind: Tensor) -> Tensor:
        """Return the speed limit of each vehicle by its class, same shape; infinite for none."""
        limits = [one.speed_limit or torch.inf for one in self.classes.values()]
        return self._of_class(limits, kind)

    @staticmethod
    def _of_class(numbers: list[float], kind: Tensor) -> Tensor:
        return torch.tensor(numbers, device=kind.device)[kind]

    def power(self, speed: Tensor, acceleration: Tensor, kind: Tensor | None = None) -> Tensor:
        """Return the power drawn [W], see :meth:`EnergyModel.power`.

        Args:
            speed: speed at the start of a step, any shape [m/s].
            acceleration: executed acceleration, same shape [m/s²].
            kind: number of each vehicle's class, same shape, int64; None: all have the first.
        """
        return self._of(lambda model, *motion: model.power(*motion), speed, acceleration, kind)

    def path_power(self, speed: Tensor, acceleration: Tensor, kind: Tensor | None = None) -> Tensor:
        """Return the power net of kinetic energy [W]; arguments as for :meth:`power`."""
        return self._of(lambda model, *motion: model.path_power(*motion), speed, acceleration, kind)

    def stored_energy(self, speed: Tensor, kind: Tensor | None = None) -> Tensor:
        """Return the kinetic energy [J], see :meth:`EnergyModel.stored_energy`."""
        return self._of(lambda model, v, _: model.stored_energy(v), speed, speed, kind)

    def climbing(self, speed: Tensor, kind: Tensor | None = None) -> Tensor:
        """Return the power that becomes height [W], see :meth:`EnergyModel.climbing`."""
        return self._of(lambda model, v, _: model.climbing(v), speed, speed, kind)

    def acceleration_loss(
        self, speed: Tensor, acceleration: Tensor, kind: Tensor | None = None
    ) -> Tensor | None:
        """Return the power dissipated by accelerating [W]; None unless all models define it."""
        return self._known("acceleration_loss", all, speed, acceleration, kind)

    def unpaid(self, speed: Tensor, acceleration: Tensor, kind: Tensor | None = None) -> Tensor:
        """Return the kinetic power that is not drawn [W], see :meth:`EnergyModel.unpaid`."""
        return self._of(lambda model, *motion: model.unpaid(*motion), speed, acceleration, kind)

    def infeasible(
        self, speed: Tensor, acceleration: Tensor, kind: Tensor | None = None
    ) -> Tensor | None:
        """Return where an acceleration is infeasible; None if no model defines it."""
        return self._known("infeasible", any, speed, acceleration, kind)

    def burnt(self, energy: Tensor, kind: Tensor | None = None) -> dict[str, Tensor]:
        """Return :data:`BURNT` of energies drawn [J], same shape; empty if no model burns fuel.

        They are 0 for vehicles without fuel.
        """
        if not any(model.heating_value for model in self.models):
            return {}

        def part(number: int) -> Tensor:
            return self._of(lambda model, x, _: model.burnt(x)[number], energy, energy, kind)

        return {name: part(number) for number, name in enumerate(BURNT)}

    def _known(self, name: str, enough: Any, *motion: Any) -> Tensor | None:
        """Return a quantity of the models, false for others; None unless enough define it."""
        nothing = torch.empty(0)
        if not enough(getattr(x, name)(nothing, nothing) is not None for x in self.models):
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
    """Return a fleet with one model; None: that of the ALCC paper."""
    if isinstance(energy, Fleet):
        return energy
    return Fleet({"all": PaperMotor() if energy is None else energy})
