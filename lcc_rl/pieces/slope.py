"""Slopes: the grade of the road by place, and its preview."""

from __future__ import annotations

import itertools
import math
from typing import Annotated, ClassVar

import numpy as np
import torch
from pydantic import Field
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.energy.base import Grade
from lcc_rl.errors import require
from lcc_rl.functional.layout import join
from lcc_rl.pieces.base import Entry, Feature, StepTransform, next_key
from lcc_rl.pieces.features import CLASS
from lcc_rl.pieces.views import EPISODE, LEADER, VEHICLES
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative

PLACE, REST = "place", "place_rest"
SPACING = 1.0  # largest distance between stored grades [m]
LAST_PLACE = 1e6  # of a profile [m]
Point = tuple[Annotated[float, Field(ge=0.0, le=LAST_PLACE)], Grade]


class Slope(StepTransform):
    """The grade of an open road at the place of every vehicle, and of the leader.

    A place is that of the front bumper, counted from the leader's at the start of the episode.
    Its part below whole metres is kept, too: sums of single steps in single precision would be off
    by up to 250 m after an hour. Energies count the grade
    (:meth:`lcc_rl.energy.EnergyModel.at`), and vehicles with limits
    have less power left uphill. All other vehicles execute their commands, except for the share
    ``slope`` of :class:`lcc_rl.pieces.Actuation`.
    """

    # Places [m], the first 0, and grades [rad], positive uphill and linear in between.
    points: Annotated[tuple[Point, ...], Field(min_length=2)]
    repeats: bool = False  # the profile begins anew at its end; else the last grade continues

    kinds = (
        Entry("vehicles.place", "m", "place of the front bumper, on a road with slopes"),
        Entry("vehicles.grade", "rad", "grade of the road"),
        Entry("vehicles.place_rest", "m", "the place minus its whole metres"),
        Entry("leader.place", "m", "place of its front bumper, on a road with slopes"),
        Entry("leader.grade", "rad", "grade of the road"),
        Entry("leader.place_rest", "m", "the place minus its whole metres"),
    )
    grades: ClassVar[Tensor]

    def validate(self) -> None:
        places = [place for place, _ in self.points]
        if places[0] != 0.0 or any(x >= y for x, y in itertools.pairwise(places)):
            raise ValueError(f"points: places must begin with 0 and increase, got {places}")

    def setup(self, world: World) -> None:
        """Find the vehicles, or the leader, by its name.

        Raises:
            ConfigError: on a ring, or if an energy model has no grade.
        """
        require(not world.string.ring, "scenario.pieces.slope needs an open road")
        self.energy, self.time_step = world.given("energy", self.title), world.time_step
        self.energy.at(torch.zeros(()))
        self.role = VEHICLES if self.name == VEHICLES else EPISODE
        own = [entry for entry in self.kinds if entry.key.startswith(self.name)]
        places, speed = [(self.name, x) for x in (PLACE, REST)], (self.name, "speed")
        self.declare(world, [*places, speed, next_key(speed)], own)
        self.register_buffer("grades", self.table())

    def table(self) -> Tensor:
        """Return the grades at equal distances from the first to the last place, float32 [rad]."""
        places, grades = np.array(self.points).T
        even = np.linspace(0.0, places[-1], math.ceil(places[-1] / SPACING) + 1)
        return torch.from_numpy(np.interp(even, places, grades).astype(np.float32))

    def grade_at(self, place: Tensor) -> Tensor:
        """Return the grade at places of any shape [m]; unless it repeats, the ends continue."""
        last = len(self.grades) - 1
        number = place * (last / self.points[-1][0])
        if self.repeats:
            number = number - last * (number / last).floor()
        number = number.clamp(0.0, last)
        before = number.floor().clamp(max=last - 1)
        low = before.long()
        first = self.grades[low]
        return first + (number - before) * (self.grades[low + 1] - first)

    def along(self, speed: Tensor) -> Tensor:
        """Return the grade after each step of the leader's record, ``[steps]`` [rad]."""
        way = (0.5 * self.time_step * (speed[:-1] + speed[1:]).double()).cumsum(0)
        return self.grade_at(way.to(speed.dtype))

    def compute(
        self, place: Tensor, rest: Tensor, speed: Tensor, reached: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the place after the step, by the trapezoidal rule, its grade and its rest."""
        whole, rest = (place - rest).round(), rest + 0.5 * self.time_step * (speed + reached)
        metres = rest.floor()
        rest = rest - metres
        place = whole + metres + rest
        return place, self.grade_at(place), rest

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        place = torch.zeros_like(start.get((LEADER, "speed")))
        if self.name == VEHICLES:
            gap = start.get((VEHICLES, "gap"))
            kind = torch.zeros_like(gap, dtype=torch.int64)
            first, lengths = (self.energy.lengths(x) for x in (kind, start.get(CLASS, kind)))
            ahead = join([first[..., :1, :], lengths], -2)
            place = -(gap + ahead[..., :-1, :]).cumsum(-2)
        for key, value in zip(
            self.targets, (place, self.grade_at(place), place - place.floor()), strict=True
        ):
            start.set(key, value)


class SlopePreview(Feature):
    """The grade at some distances ahead of each automated vehicle, as a map contains it.

    Writes ``("terrain", "grade")``, ``[*batch, A, distances]`` [rad].
    """

    distances: Annotated[tuple[NonNegative, ...], Field(min_length=1)] = (0.0, 50.0, 100.0, 200.0)

    known = Entry("terrain.grade", "rad", "grade of the road at each distance ahead")
    ahead: ClassVar[Tensor]

    def setup(self, world: World) -> None:
        require(world.slope is not None, "+knowledge=terrain needs a slope: +slope=hills")
        self.declare(world, ["self.place"], [self.known.wide(len(self.distances))])
        self.slope = world.slope.bind(world, VEHICLES)
        self.register_buffer("ahead", torch.tensor(self.distances))

    def compute(self, place: Tensor) -> Tensor:
        return self.slope.grade_at(place + self.ahead)
