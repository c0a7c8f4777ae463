"""Features of vehicles: time-to-collision, time gap, vehicle class and power."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.functional.pattern import VehicleString
from lcc_rl.functional.random import stream_id, uniform
from lcc_rl.functional.safety import time_gap, time_to_collision
from lcc_rl.functional.string import gather
from lcc_rl.pieces.base import SEED, Entry, Feature, StepTransform
from lcc_rl.pieces.views import NEXT, SELF, VEHICLES
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Positive


class TimeToCollision(Feature):
    """Writes the time-to-collision of every vehicle, ``("vehicles", "ttc")`` [s] (A10)."""

    floor: Positive = 0.01  # smallest value, also after a collision [s]

    steady = True
    role = VEHICLES
    reads = ("vehicles.gap", "vehicles.relative_speed")
    writes = (Entry("vehicles.ttc", "s", "time-to-collision; 1000 where the gap does not close"),)

    def compute(self, gap: Tensor, relative_speed: Tensor) -> Tensor:
        """Return the time-to-collision, ``[*batch, N, 1]``."""
        return time_to_collision(gap, -relative_speed, self.floor)


class TimeGap(Feature):
    """Writes the time gap of every vehicle, ``("vehicles", "time_gap")`` [s] (A12)."""

    speed_floor: NonNegative = 1.0  # speeds below this count as this; 0: the literal rule [m/s]

    steady = True
    role = VEHICLES
    reads = ("vehicles.gap", "vehicles.speed")
    writes = (Entry("vehicles.time_gap", "s", "gap divided by speed"),)

    def compute(self, gap: Tensor, speed: Tensor) -> Tensor:
        """Return the time gap, ``[*batch, N, 1]``."""
        return time_gap(gap, speed, self.speed_floor)


CLASS = (VEHICLES, "energy_class")
GRADE = "grade"  # entry of the vehicles on a slope, see lcc_rl.pieces.slope


class EnergyClasses(StepTransform):
    """Draws the class of every vehicle at reset, ``("vehicles", "energy_class")``, int64.

    The draw depends on the episode's seed, so all strategies have the same vehicles. The numbers
    are those of the fleet's models.
    """

    role = VEHICLES
    keeps = (
        Entry(CLASS, "–", "number of the vehicle's class, where there are several", whole=True),
    )

    def setup(self, world: World) -> None:
        self.declare(world)
        self.energy = world.given("energy", self.title)
        self.stream = stream_id("vehicles.energy_class")

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        count, seed = len(self.string), start.get(SEED).unsqueeze(-2)
        place = torch.arange(count, device=seed.device).unsqueeze(-1)
        draw = uniform(seed, 0, self.stream + place)
        kinds = _drawn(draw, self.energy.shares)
        for role, shares in self.energy.roles.items():
            if role in self.string.names:
                if self.string.drawn:
                    index = start.get((role, "index"))
                else:
                    index = torch.tensor(self.string.places(role), device=seed.device)
                mask = (place == index.unsqueeze(-2)).any(-1, keepdim=True)
                kinds = torch.where(mask, _drawn(draw, shares), kinds)
        start.set(CLASS, kinds.expand(*start.batch_size, count, 1).clone())


def speed_limits(start: TensorDictBase, fleet: Any) -> Tensor | None:
    """Return the speed limit of every vehicle at reset, ``[*batch, N, 1]`` [m/s]; None for none."""
    kinds = start.get(CLASS, None)
    return None if kinds is None or fleet is None else fleet.speed_limits(kinds)


def first_speeds(leader: Tensor, count: int, limits: Tensor | None) -> Tensor:
    """Return the speed at which each vehicle starts, ``[*batch, N, 1]`` [m/s].

    It is the leader's, ``[*batch, 1]``, or the lowest limit of the vehicle and the vehicles ahead.
    """
    speed = leader.unsqueeze(-2).expand(*leader.shape[:-1], count, 1)
    return speed if limits is None else torch.minimum(speed, limits.cummin(-2).values)


def of_role(entry: Tensor, start: TensorDictBase, string: VehicleString, role: str) -> Tensor:
    """Return the rows of a role at reset, ``[*batch, n, 1]``, from ``[*batch, N, 1]``."""
    if string.drawn:
        return gather(entry, start.get((role, "index")))
    return entry[..., list(string.places(role)), :]


def _drawn(draw: Tensor, shares: Sequence[float]) -> Tensor:
    """Return the number of the class for each draw from [0, 1); int64, same shape."""
    bounds = torch.tensor(shares, device=draw.device).cumsum(0)[:-1]
    # A class with share 0 is never drawn, also if rounding leaves a remainder at the end.
    last = max(number for number, share in enumerate(shares) if share > 0.0)
    return torch.bucketize(draw, bounds, right=True).clamp(max=last)


class MotorPower(StepTransform):
    """Writes the power of the step just taken [W], from the speed at its start (A2 by default).

    From a predicted acceleration it computes the power that an automated vehicle estimates for a
    human driver (A16).
    """

    vehicles: str = VEHICLES  # "vehicles" for all of them, or a role
    # Their entry with the acceleration, or "predicted_acceleration".
    acceleration: str = "acceleration"
    power: str = "power"  # their entry that is written
    recuperation: bool = True  # braking feeds the battery

    steady = True
    kinds = (
        Entry("vehicles.power", "W", "power drawn during the last step"),
        Entry("role.predicted_power", "W", "motor power at the predicted acceleration"),
    )

    @property
    def title(self) -> str:
        """Its name in messages, with the energy models."""
        models = dict.fromkeys(type(model).__name__ for model in self.energy.models)
        return f"{type(self).__name__} ({', '.join(models)})"

    def setup(self, world: World) -> None:
        """Read the motion of the vehicles, and their classes if there are several."""
        self.energy = world.given("energy", type(self).__name__)
        every, self.role = self.vehicles == VEHICLES, self.vehicles
        space = VEHICLES if every else SELF
        names = [f"{space}.speed", f"{NEXT}.{self.vehicles}.{self.acceleration}"]
        if len(self.energy.models) > 1:
            names.append(f"{space}.{CLASS[-1]}")
        self.sloped = world.slope is not None
        names += [f"{NEXT}.{space}.{GRADE}"] * self.sloped
        written = self.kinds[0] if every else self.kinds[1]
        self.declare(world, names, [replace(written, key=(self.vehicles, self.power))])

    def compute(self, *motion: Tensor) -> Tensor:
        """Return the power, ``[*batch, n, 1]``."""
        grade = motion[-1] if self.sloped else None
        power = self.energy.at(grade).power(*motion[: len(motion) - self.sloped])
        return power if self.recuperation else power.clamp(min=0.0)
