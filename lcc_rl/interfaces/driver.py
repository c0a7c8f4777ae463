"""Policies and rules for vehicles of another simulator."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lcc_rl.config import load
from lcc_rl.config.schemas import TimeStep
from lcc_rl.config.words import FILTERED
from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs.checks import BATCH, check_alone, check_step
from lcc_rl.envs.clock import checked_seed
from lcc_rl.envs.rowwise import Array, Rowwise
from lcc_rl.errors import ConfigError, Diverged, raised_as, require, unknown_name
from lcc_rl.evaluation.named import controller_of, is_policy, one_of
from lcc_rl.functional.guard import check_forgets
from lcc_rl.functional.machine_code import kept
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.functional.recorder import Untranslatable
from lcc_rl.interfaces.exported import (
    AGE,
    BEHIND_PRESENT,
    DrivingProgram,
    Safety,
    described_input,
    driving,
    filter_of,
    measuring,
    program,
)
from lcc_rl.pieces import CBFFilter, Controller
from lcc_rl.pieces.controllers import Population
from lcc_rl.pieces.world import World
from lcc_rl.settings import Settings, parse

# Motion of the vehicle, of the vehicle ahead and of the vehicle behind.
MEASURED = (
    *("self.speed", "self.gap", "self.acceleration", "ahead.speed", "ahead.acceleration"),
    *("behind.speed", "behind.gap", "behind.acceleration", BEHIND_PRESENT),
)
KNOWN = (*MEASURED, AGE)
WIDEST = 200  # largest memory in machine code


class Simulator(Settings):
    """The simulator of the vehicles."""

    time_step: TimeStep  # duration of a step [s]


class Driver:
    """Computes the accelerations of any number of cars and stores their memories.

    Args:
        name: a run, a run folder, a policy file, ``pretrained/<name>``, or a controller by name
            (``"idm_acc"``), as object, class, function, file or node, see :func:`lcc_rl.compare`.
            ``_filtered`` at the end of a rule's name, also in ``{name: rule}``, adds the filter.
        time_step: duration of a step of the simulator, 0.001 to 0.5 s; a policy needs that of its
            training.
        trust: modules outside this package that a policy may name.
        safety: the safety filter, or changed settings, such as ``{"margin": 2.0}``, of the default:
            that of the policy's training, or of ``+filter=cbf`` for rules with ``_filtered``.
        seed: seed of the drivers' noise; each new car has the next seed, and keeps it if it leaves
            and returns.
        drivers: population of rules with human drivers, such as ``"human"``: a table of ``lcc-rl
            calibrate`` or a population of :mod:`lcc_rl.drivers.population`; None: the shipped one.
        limits: ``max_braking`` and ``max_acceleration`` of the car [m/s²]; by default those of the
            policy's training, for rules 3.

    Attributes:
        names: the inputs of :meth:`step`, in SI units: ``"self.gap"`` …
        cars: the cars of the last step.

    Raises:
        LccError: if the policy or rule is unknown, was trained with another step, reads an entry
            that is not measured, or does not return a row per vehicle.

    Examples:
        >>> driver = Driver("idm_acc", time_step=0.1)
        >>> driver.names
        ['self.speed', 'self.gap', 'ahead.speed']
        >>> round(driver.step({"self.speed": 12.0, "self.gap": 20.0, "ahead.speed": 13.0}), 2)
        2.6
    """

    def __init__(
        self,
        name: Any,
        time_step: float,
        trust: Sequence[str] = (),
        safety: Safety = None,
        seed: int = 0,
        drivers: Population | str | Path | None = None,
        limits: Mapping[str, float] | None = None,
    ) -> None:
        self.time_step = parse(Simulator, {"time_step": time_step}, "").time_step
        self.name, spec = one_of(name)
        first = checked_seed(seed)
        require(first is not None, "seed must be a whole number, got None")
        self.seed = first or 0
        if is_policy(spec):
            require(drivers is None, f"drivers needs a rule; {self.name} is a policy")
            self.program = program(spec, trust, safety=safety, limits=limits)
            trained = self.program.controller.time_step
            if abs(trained - time_step) > 1e-9:
                raise ConfigError(
                    f"{spec} was trained with steps of {trained!r} s, the simulation has "
                    f"{time_step!r} s (in SUMO, --step-length {trained:g} sets it)"
                )
        else:
            population = bootstrap(drivers) if isinstance(drivers, (str, Path)) else drivers
            self.program = self._rule(spec, safety, measuring(time_step, True, population), limits)
        self.names = self.program.names
        self.behind = {x for x in self.names if x.startswith("behind.")} - {BEHIND_PRESENT}
        self._check()
        self.reset()

    def _rule(self, spec: Any, safety: Safety, world: World, limits: Any) -> DrivingProgram:
        active = None
        if any(str(word).endswith(FILTERED) for word in (self.name, spec)):
            filters = load("evaluate", ["variant=idm", "+filter=cbf"]).scenario.filters
            active = filters[AUTOMATED].made(CBFFilter)
        active = filter_of(safety, active, self.name)
        node = controller_of(spec, active is not None and active.time_gap is not None)
        return driving([node.made(Controller)], active, world, limits)

    def _check(self) -> None:
        for name in self.names:
            if name not in KNOWN:
                measurable = ", ".join(KNOWN)
                raise ConfigError(
                    f"{self.name} reads {name}, which is not measured here, only {measurable}"
                )
        step, alone = (partial(self.program.step, apply=x) for x in (check_step, check_alone))
        check_forgets(self.program.pieces, lambda n: step(*self.examples(BATCH, 1.0 + n)))
        alone(*self.examples(BATCH))

    def examples(self, count: int, value: float = 1.0) -> list[Tensor]:
        """Return inputs of some cars and, if there is one, their memory; all first values equal."""
        state, seeds = torch.full((count, len(self.names)), value), torch.zeros(count, 1).long()
        state += torch.arange(count).unsqueeze(-1)  # no two cars alike
        return [state, self.program.begin(state.double(), seeds)] if self.program.width else [state]

    def reset(self, cars: Sequence[Hashable] | None = None) -> None:
        """Reset the memories of cars, which start with their next measurement.

        Args:
            cars: cars of the last step; None: all cars, and their seeds.
        """
        if cars is None:
            self.cars: Sequence[Any] = ()
            self.memory = np.zeros((0, self.program.width))
            self.numbers: dict[Hashable, int] = {}  # seeds of all cars, in order of appearance
            return
        gone = _ids(cars)
        stay = [row for row, car in enumerate(self.cars) if car not in gone]
        self.cars, self.memory = [self.cars[row] for row in stay], self.memory[stay]

    def step(self, measured: Mapping[str, Any], cars: Sequence[Hashable] | None = None) -> Any:
        """Return the acceleration of each car for the next step [m/s²].

        Args:
            measured: numbers of one car by name, or arrays of one length for several cars. A car
                has no vehicle behind if none of its entries is given, or if ``"behind.present"``
                is 0.
            cars: ids of the cars, in the order of the arrays; by default 0, 1, 2 … The memory of a
                car starts anew if it was not in the last step, or after bad samples, for which it
                brakes behind a filter. Cars that are not in this step are forgotten.

        Returns:
            A number for numbers, else an array, ``[cars]``.

        Raises:
            ConfigError: if a measurement is missing or unknown, or sizes differ.
            Diverged: if a command is not finite, as for a NaN ahead if there is no filter and the
                controller does not handle it; memories are then unchanged.
        """
        state, alone = self._state(measured)
        ids = range(len(state)) if cars is None else _ids(cars)
        before = self.cars, self.memory
        self._admit(ids, state)
        command, *memory = self._rows(state, *[self.memory] * (self.program.width > 0))
        if not np.isfinite(command).all():
            row = int(np.isfinite(command).argmin())
            given = zip(self.names, state[row], strict=True)
            lost = [one for one in given if not np.isfinite(one[1])]
            lost = [one for one in lost if one[0] not in self.program.stand_ins]
            faults = [f"{name} is {x} in row {row} of the cars" for name, x in lost]
            faults.append(f"the command of {self.cars[row]} is {command[row, 0]}")
            self.cars, self.memory = before
            raise Diverged(f"{self.name}: {faults[0]}")
        if memory:
            (self.memory,) = memory
            if not self.memory[:, 0].all():
                pairs = zip(self.cars, self.memory, strict=True)
                self.reset([car for car, row in pairs if not row[0]])
        return float(command[0, 0]) if alone else command[:, 0]

    def _admit(self, cars: Sequence[Hashable], state: Array) -> None:
        """Sort the memories by the cars of a step."""
        if cars == self.cars and len(cars) == len(state):
            return
        message = f"cars must be {len(state)} different ids, as many as measured, got {cars}"
        require(len(cars) == len(set(cars)) == len(state), message)
        places = {car: index for index, car in enumerate(self.cars)}
        stay = [row for row, car in enumerate(cars) if car in places]
        new = [row for row, car in enumerate(cars) if car not in places]
        if self.program.width:
            memory = np.zeros((len(state), self.program.width))
            memory[stay] = self.memory[[places[cars[row]] for row in stay]]
            inputs = torch.from_numpy(state[new]).double()
            numbers = [self.numbers.setdefault(cars[row], len(self.numbers)) for row in new]
            seeds = self.seed + torch.tensor(numbers, dtype=torch.long).unsqueeze(-1)
            memory[new] = self.program.begin(inputs, seeds).numpy()
            self.memory = memory
        self.cars = cars

    def _state(self, measured: Mapping[str, Any]) -> tuple[Array, bool]:
        """Return the inputs of the program, ``[cars, names]``, and whether numbers were given."""
        text = f"measured must name measurements, such as self.gap, got {type(measured).__name__}"
        require(isinstance(measured, Mapping), text)
        if unknown := measured.keys() - KNOWN:
            raise unknown_name("measurement", str(min(unknown, key=str)), KNOWN)
        try:
            measured = self._completed(measured) if self.behind else measured
            measured = {AGE: 0.0, **measured} if AGE in self.names else measured
            columns = [np.asarray(measured[name]) for name in self.names]
            for name, column in zip(self.names, columns, strict=True):
                if column.dtype.kind not in "biuf":
                    raise ValueError(f"{name} is {measured[name]!r}"[:100])
            shape, *rest = {column.shape for column in columns} - {()} or [()]
            if rest:
                raise ValueError(f"their shapes are {sorted([shape, *rest])}")
            state = np.empty((math.prod(shape), len(columns)), np.float32)
            for index, column in enumerate(columns):
                state[:, index] = column
        except KeyError as error:
            name, unit, meaning = described_input(error.args[0])
            text = f"{self.name} reads {name}, which is not given: {meaning} [{unit}]"
            raise ConfigError(text) from error
        except (ValueError, TypeError, RuntimeError) as error:  # torch's, of a gradient
            text = f"measured must hold numbers, or arrays of one length: {error}"
            raise ConfigError(text) from error
        return state, not shape

    def _completed(self, measured: Mapping[str, Any]) -> dict[str, Any]:
        """Return measurements with NaN, which get stand-ins, where there is no vehicle behind."""
        completed, absent = dict(measured), measured.keys().isdisjoint(self.behind)
        present = completed.setdefault(BEHIND_PRESENT, float(not absent))
        for name in () if np.all(present) else self.behind:
            completed[name] = np.nan if absent else np.where(present, completed[name], np.nan)
        return completed

    @cached_property
    def _rows(self) -> Rowwise:
        """The program by rows, compiled on demand."""
        make = partial(kept, fused=True) if self.program.width <= WIDEST else _by_tensors
        return Rowwise(self.program.step, self.examples(1), self.name, make)


def _ids(cars: Iterable[Hashable]) -> list[Hashable]:
    """Return the ids of cars as a list of hashable values."""
    require(not isinstance(cars, str), f"cars must be a list of ids, got {cars!r}")
    with raised_as(ConfigError, "cars must be a list of ids", TypeError):
        ids = list(cars)
        hash(tuple(ids))
    return ids


def _by_tensors(source: str) -> Any:
    raise Untranslatable(f"machine code for more than {WIDEST} remembered numbers takes minutes")
