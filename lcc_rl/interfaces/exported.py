"""Policies and rules as programs of tensors, from measurements to accelerations.

A program consists of pieces of the environment in their order: memory and observation of a policy,
controller, safety filter. :mod:`.export` writes it to files, :mod:`.driver` runs it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from pydantic import InstanceOf
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from lcc_rl.config.schemas import StudyConfig
from lcc_rl.config.words import FILTERED
from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs.factory import build_env
from lcc_rl.envs.inputs import constant_profiles
from lcc_rl.envs.step import pieces_of, read_before
from lcc_rl.errors import ConfigError, require
from lcc_rl.evaluation.foreign import as_given, check_observed
from lcc_rl.evaluation.strategies import with_weights
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, VehicleString
from lcc_rl.pieces import Action, CBFFilter, Controller, Observation
from lcc_rl.pieces.base import (
    OBSERVATION,
    ROLE,
    SEED,
    STEP,
    Key,
    Piece,
    RoleTransform,
    State,
    StepTransform,
    declared,
    next_key,
)
from lcc_rl.pieces.controllers import Population
from lcc_rl.pieces.knowledge import ObservationMemory
from lcc_rl.pieces.views import AHEAD, BEHIND, SELF, TARGET_AGE, VEHICLES
from lcc_rl.pieces.world import World
from lcc_rl.results.policies import load_policy
from lcc_rl.settings import Acceleration, Positive, Settings, parse, values

# Entries that are computed from other measurements: v_ahead − v.
DERIVED_INPUTS = {
    "self.relative_speed": ("ahead.speed", "self.speed"),
    "behind.relative_speed": ("self.speed", "behind.speed"),
}
BEHIND_PRESENT = "behind.present"
AGE = f"{SELF}.{TARGET_AGE}"
COMMAND_KEY = (AUTOMATED, "command")


Safety = CBFFilter | Mapping[str, Any] | None  # a filter, or changed settings of a given one


class CarLimits(Settings):
    """Brakes and drive of the vehicle; None: those of the training, 3 m/s² for a rule."""

    max_braking: Acceleration | None = None  # [m/s²]
    max_acceleration: Acceleration | None = None  # [m/s²]

    def of(self, world: World) -> World:
        """Return a world with these limits of automated vehicles."""
        given = values(self).items()
        return replace(world, limited_by="limits", **{key: x for key, x in given if x is not None})


class Input(NamedTuple):
    """A column of a program's input: its name, unit and meaning."""

    name: str
    unit: str
    meaning: str


class NetworkController(Controller):
    """Commands the action of a network, in [−1, 1], times the largest acceleration."""

    network: InstanceOf[nn.Module]  # maps the scaled observation to actions
    max_acceleration: Positive  # acceleration of action 1, in both directions [m/s²]

    of_limits = True
    reads = (next_key(OBSERVATION),)

    def setup(self, world: World) -> None:
        self.declare(world)
        least, largest = self.limits or (-self.max_acceleration, self.max_acceleration)
        self.limits = max(least, -self.max_acceleration), min(largest, self.max_acceleration)
        self.layers = self.network  # as a part of this module

    def command(self, observation: Tensor) -> Tensor:
        return self.max_acceleration * self.layers(observation.flatten(1)).unsqueeze(1)


class DrivingProgram(nn.Module):
    """Maps measurements ``[batch, inputs]`` to accelerations ``[batch, 1]`` [m/s²].

    A program with a memory also reads and returns the memory, ``[batch, width]``. If its first
    number is zero, the vehicle starts anew, as after a memory that is not finite. Inputs of
    ``behind.`` that are not finite get their stand-ins. With a safety filter, an input ahead that
    is not finite, or a gap that is not positive, is no measurement. After one such step the last
    measurements are used again. In further ones the filter brakes fully, then it starts anew.
    Without a filter, a controller that reads ``self.target_age`` gets the last gap and motion ahead
    for any time, and this age, which grows by a step each.

    Args:
        pieces: a policy's memory and observation, the controller, the safety filter, in this order
            and bound to :func:`measuring`.

    Attributes:
        names: the inputs, such as ``"self.gap"``.
        inputs: the inputs of each entry.
        stand_ins: for each input of ``behind.`` the input that replaces a NaN, or a number.
        kept: shapes and types of the remembered entries.
        width: size of the memory, 0 if there is none.
    """

    held: Tensor  # inputs without which there is no measurement
    aged: Tensor  # a step's duration in the column of the age, else 0 [s]

    def __init__(self, pieces: Sequence[Piece]) -> None:
        super().__init__()
        self.pieces, self.parts = list(pieces), nn.ModuleList(pieces)
        self.controller = next(p for p in pieces if isinstance(p, Controller))
        self.safety = next((p for p in pieces if isinstance(p, CBFFilter)), None)
        self.observation = next((p for p in pieces if isinstance(p, Observation)), None)
        # The observation's inputs come first.
        inner = sorted(pieces, key=lambda piece: isinstance(piece, ObservationMemory))
        needs = [key for piece in inner for _, key in piece.needs]
        before, clock = read_before(pieces), [key for key in (SEED, STEP) if key in needs]
        self.kept: dict[Key, Any] = dict.fromkeys(clock, (torch.Size([1]), torch.int64))
        for piece in pieces:
            keys = [key for key in piece.entries if key in before]
            self.kept |= piece.layouts(torch.Size([]), keys)
        self.sizes = [shape.numel() for shape, _ in self.kept.values()]
        written = {SEED, STEP}.union(*(piece.entries for piece in pieces))
        self.inputs = {key: self._inputs(".".join(key)) for key in needs if key not in written}
        self.names = list(dict.fromkeys(name for names in self.inputs.values() for name in names))
        self.stand_ins = self._stand_ins()
        target = [x == f"{SELF}.gap" or x == AGE or x.startswith(AHEAD) for x in self.names]
        steps = [self.controller.time_step * (x == AGE) for x in self.names]
        held = [self.safety is not None or x for x in target]
        self.register_buffer("held", torch.tensor(held), persistent=False)
        self.register_buffer("aged", torch.tensor(steps), persistent=False)
        # The last measurements, and the number of steps since then.
        self.holds = self.safety is not None or AGE in self.names
        self.sizes += [len(self.names), 1] if self.holds else []
        self.width = 1 + sum(self.sizes) if self.sizes else 0

    def _inputs(self, name: str) -> tuple[str, ...]:
        """Return the inputs of an entry, one per number."""
        columns = [] if self.observation is None else self.observation.columns()
        several = tuple(column for column, *_ in columns if column.startswith(f"{name}."))
        return several or DERIVED_INPUTS.get(name, (name,))

    def _stand_ins(self) -> dict[str, str | float]:
        """Return zeros for a policy that observes presence, else a vehicle like the own one."""
        stand_ins: dict[str, str | float] = {}
        for name in (name for name in self.names if name.startswith(f"{BEHIND}.")):
            own = name.replace(BEHIND, SELF)
            if BEHIND_PRESENT in self.names or name.endswith(".acceleration"):
                stand_ins[name] = 0.0
            elif own in self.names:
                stand_ins[name] = own
        return stand_ins

    def forward(self, state: Tensor, memory: Tensor | None = None) -> Any:
        """Return the commanded accelerations and, if there is one, the memory after the step."""
        if memory is None:
            return self.step(state)[0]
        started = memory[:, :1]
        seeds = torch.zeros_like(started, dtype=torch.int64)
        return self.step(state, torch.where(started > 0.0, memory, self.begin(state, seeds)))

    def begin(self, state: Tensor, seeds: Tensor) -> Tensor:
        """Return the initial memories of vehicles from seeds ``[batch, 1]``, int64."""
        state = self._with_stand_ins(state)
        start = TensorDict()  # no batch dimensions: an export would fix their number
        clock: State = {SEED: seeds, STEP: torch.zeros_like(seeds)}
        for key, value in {**self.measured(state), **clock}.items():
            start.set(key, value)
        for piece in self.pieces:
            if isinstance(piece, StepTransform):
                piece.begin(TensorDict(), start)
        nothing = [state, torch.ones_like(state[:, :1])] if self.holds else []
        return self._packed({key: start.get(key) for key in self.kept}, state, nothing)

    def step(
        self, state: Tensor, memory: Tensor | None = None, apply: Any = None
    ) -> tuple[Tensor, ...]:
        """Return the accelerations and, if there is one, the memory after the step.

        ``apply(piece, before, reached)`` applies each piece, by default ``piece.derive``.
        """
        state = self._with_stand_ins(state)
        last: Sequence[Tensor] = ()
        values = () if memory is None else memory[:, 1:].split(self.sizes, -1)
        if self.holds:
            state, *last = self._held(state, *values[-2:])
        reached = self.measured(state)
        before = dict(reached)
        if memory is not None:
            for (key, (shape, dtype)), value in zip(self.kept.items(), values, strict=False):
                before[key] = value.reshape(-1, *shape).to(dtype)
        reached |= {key: before[key] + (key == STEP) for key in (SEED, STEP) if key in before}
        for piece in self.pieces:
            apply(piece, before, reached) if apply else piece.derive(before, reached)
        command = reached[COMMAND_KEY].flatten(1)
        if memory is None:
            return (command,)
        after = self._packed(reached, memory, last)
        # Without measurements the vehicle starts anew.
        return command, torch.where(after.isfinite().all(-1, keepdim=True), after, 0.0)

    def _with_stand_ins(self, state: Tensor) -> Tensor:
        """Return the inputs with the stand-ins of a vehicle behind that is not measured."""
        if not self.stand_ins:
            return state
        columns = dict(zip(self.names, state.split(1, -1), strict=True))
        rear = [columns[name] for name in self.stand_ins]
        measured = torch.cat(rear, -1).isfinite().all(-1, keepdim=True)
        if BEHIND_PRESENT in columns:
            measured = measured & (columns[BEHIND_PRESENT] > 0.0)
        for name, other in self.stand_ins.items():
            value = columns[other] if isinstance(other, str) else other
            columns[name] = torch.where(measured, columns[name], value)
        return torch.cat([columns[name] for name in self.names], -1)

    def _held(self, state: Tensor, last: Tensor, missed: Tensor) -> tuple[Tensor, ...]:
        """Return the inputs of a step, those to keep, and the steps since the last measurement."""
        measured = (state.isfinite() | ~self.held).all(-1, keepdim=True)
        if "self.gap" in self.names:
            gap = state[:, self.names.index("self.gap")].unsqueeze(-1)
            measured = measured & (gap > 0.0)
        lost = last.to(state.dtype)
        if self.safety is not None:
            lost = torch.where(missed > 0.0, torch.nan, lost)
        kept = torch.where(measured | ~self.held, state, lost)
        missed = torch.where(measured, 0.0, missed.to(state.dtype) + 1.0)
        return (kept + missed * self.aged if AGE in self.names else kept), kept, missed

    def _packed(self, entries: State, like: Tensor, last: Sequence[Tensor]) -> Tensor:
        rows = [torch.ones_like(like[:, :1])]
        for key, (shape, _) in self.kept.items():
            rows.append(entries[key].expand(like.shape[0], *shape).flatten(1).to(like.dtype))
        return torch.cat([*rows, *(value.to(like.dtype) for value in last)], 1)

    def measured(self, state: Tensor) -> State:
        """Return the measured entries, ``[batch, 1, width]``."""
        columns = dict(zip(self.names, state.unsqueeze(1).split(1, -1), strict=True))
        entries = {}
        for key, names in self.inputs.items():
            value = torch.cat([columns[name] for name in names], -1)
            if names == DERIVED_INPUTS.get(".".join(key)):
                value = columns[names[0]] - columns[names[1]]
                if key[0] == BEHIND and BEHIND_PRESENT in columns:  # zero without a vehicle behind
                    value = value * columns[BEHIND_PRESENT]
            entries[key] = value
        return entries


def described_input(name: str) -> Input:
    """Return name, unit and meaning of a measurement such as ``"ahead.speed"``.

    Columns of a wide entry have a number, ``"traffic.speed.0"``.
    """
    view, entry, *column = name.split(".")
    owners = {"self": "own", "ahead": "of the vehicle ahead", "behind": "of the vehicle behind"}
    whose = owners.get(view, view)
    if column:
        whose += f", value {int(column[0]) + 1}"
    shown = declared(Piece)
    for key in ((view, entry), (VEHICLES, entry), (ROLE, entry)):
        if key in shown:
            return Input(name, shown[key].unit, f"{shown[key].meaning} ({whose})")
    return Input(name, "–", f"{entry} ({whose})")


def measuring(time_step: float, behind: bool = True, population: Population | None = None) -> World:
    """Return the world of a vehicle that measures its neighbours.

    Without ``behind`` there is not always a vehicle behind. Human drivers are drawn from the
    population, by default the shipped one.
    """
    string = VehicleString((AUTOMATED, HUMAN)[: 1 + behind], ring=True, measured=True)
    return World(string, time_step, population=population or bootstrap())


def program(
    policy: str | Path | nn.Module,
    trust: Sequence[str] = (),
    cfg: StudyConfig | None = None,
    safety: Safety = None,
    limits: Mapping[str, float] | None = None,
) -> DrivingProgram:
    """Build the program of a trained policy.

    Args:
        policy: a run folder, a policy file, or ``pretrained/<name>``; or a network, see
            :func:`lcc_rl.evaluation.foreign.network_of`.
        trust: modules outside this package that the policy may name.
        cfg: the configuration in which a network was trained.
        safety: the safety filter, or changed settings of its own; None: its own.
        limits: settings of :class:`CarLimits`.

    Raises:
        ConfigError: if no network drives, its filter depends on delays of a scenario, or its
            vehicles have a class with limits.
        ResultsError: if the policy cannot be read.
    """
    population, weights = bootstrap(), None
    if not isinstance(policy, nn.Module):
        weights, cfg = load_policy(policy, trust=trust)
    assert cfg is not None
    scenario = cfg.scenario
    leader = constant_profiles(10.0, scenario.horizon, scenario.time_step, ["constant"])
    env = build_env(cfg, leader, population)
    if isinstance(policy, nn.Module) and (foreign := as_given(policy, type(policy).__name__)):
        check_observed(foreign, env)
        foreign.tried(env.reset())
    pieces = pieces_of(env)
    by_kind = {kind: [p for p in pieces if isinstance(p, kind)] for kind in (Observation, Action)}
    require(all(by_kind.values()), f"{policy}: no network drives its vehicles; nothing to export")
    for name, node in scenario.fleet.items():
        if node is not None and AUTOMATED in node.settings["roles"]:
            raise ConfigError(
                f"{policy}: it drives vehicles of the class {name} (scenario.fleet) with limits "
                "that only an environment has: it cannot drive in SUMO or be exported"
            )
    own = next((p for p in pieces if isinstance(p, CBFFilter)), None)
    safety = filter_of(safety, own, str(policy))
    if safety is not None and any(vars(safety).get("remembers", {}).values()):
        raise ConfigError(
            f"{policy}: its filter needs pending commands or earlier measurements, which exist "
            "only in an environment: use a filter without delays, lag and drop-outs"
        )
    if isinstance(policy, nn.Module):
        network = policy
    else:
        learned = with_weights(cfg, weights or {}, cfg.seed, str(policy), population).policy
        assert isinstance(learned, TensorDictModule)
        network = learned.module
    (observation,), (action,) = by_kind.values()
    text = f"{policy}: scenario.controllers.automated.hold, an action that is held, has no program"
    require(action.every == 1, text)
    world = replace(
        measuring(scenario.time_step, BEHIND_PRESENT not in observation.names),
        max_braking=scenario.max_braking,
        max_acceleration=scenario.max_acceleration,
    )
    views = {name.partition(".")[0] for name in observation.seen}
    memory = [p for p in pieces if isinstance(p, ObservationMemory) and p.view in views]
    largest = action.max_acceleration
    network = NetworkController(network=network, max_acceleration=largest)
    return driving([*memory, observation, network], safety, world, limits)


def filter_of(safety: Safety, own: CBFFilter | None, name: str) -> CBFFilter | None:
    """Return the safety filter of a driver, whose own one is used if nothing else is given."""
    if not isinstance(safety, Mapping):
        return safety or own
    if own is None:
        hint = f"; a rule whose name ends in {FILTERED} has one"
        raise ConfigError(f"{name} has no safety filter whose settings safety could change{hint}")
    return parse(type(own), values(own) | dict(safety), "safety")


def driving(
    pieces: Sequence[Piece],
    safety: CBFFilter | None,
    world: World,
    limits: Mapping[str, float] | None = None,
) -> DrivingProgram:
    """Return the program of pieces and a filter in a world; the filter acts from the start.

    All are bound here, see :class:`DrivingProgram`, :func:`measuring` and :class:`CarLimits`.
    """
    world = parse(CarLimits, limits or {}, "limits").of(world)
    if safety is not None:
        world = replace(world, filtered=[AUTOMATED])
        pieces = [*pieces, type(safety)(**values(safety) | {"from_s": 0.0})]
    roles = [AUTOMATED if isinstance(piece, RoleTransform) else None for piece in pieces]
    bound = [piece.bind(world, role) for piece, role in zip(pieces, roles, strict=True)]
    return DrivingProgram(bound).eval().requires_grad_(False)
