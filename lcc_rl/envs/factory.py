"""Builds environments from configurations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import torch
from tensordict.utils import NestedKey
from torchrl.envs import TransformedEnv

from lcc_rl.config import load
from lcc_rl.config.nodes import CALLED, Node
from lcc_rl.config.schemas import AUTO, SECTIONS, ScenarioConfig, StudyConfig
from lcc_rl.config.unused import drawn_in_training, refuse
from lcc_rl.config.words import with_variant
from lcc_rl.data.profiles import Profiles
from lcc_rl.envs.checks import check_pieces
from lcc_rl.envs.clock import Clock, Traffic, batch_shape
from lcc_rl.envs.inputs import build_energy, shared_inputs
from lcc_rl.envs.single import view_of
from lcc_rl.envs.step import Pieces
from lcc_rl.errors import ConfigError, require, require_known
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, RING
from lcc_rl.io.memory import require_memory, torch_device
from lcc_rl.pieces import (
    Action,
    Actuation,
    CBFFilter,
    Controller,
    Corrected,
    EnergyClasses,
    Handover,
    Piece,
    RewardTerm,
    RolePlaces,
    Sensors,
    Slope,
    StringMotion,
    TotalReward,
)
from lcc_rl.pieces.base import ACTION
from lcc_rl.pieces.controllers import Population
from lcc_rl.pieces.hybrid import check_rewards, check_spacing
from lcc_rl.pieces.views import LEADER, VEHICLES
from lcc_rl.pieces.world import World
from lcc_rl.settings import TARGET, parse, path_of

# Settings that no environment reads, and why they have no effect.
OF_COMMANDS = {
    **{
        f"{part}.{x.name}": why
        for part, why in (("training", "nothing trains"), ("evaluation", "nothing is evaluated"))
        for x in fields(SECTIONS[part])
        if x.name != "gap_range"  # of the first states
    },
    "seed": "use make_env(seed=…), or reset(seed=…) in Gymnasium",
    "device": "use make_env(device=…)",
    "training.environments": "use make_env(batch_size=…), or num_envs in Gymnasium",
    **dict.fromkeys(("threads", "matmul_precision"), "set it with torch"),
    "agent.hold": "use scenario.controllers.automated.hold=…",
    "agent.": "it belongs to the learners of lcc-rl train",
}
MOMENTS = 3  # least states in memory: before and after a step, and intermediate results


def build_env(
    cfg: StudyConfig,
    profiles: Profiles,
    population: Population,
    batch_size: Sequence[int] | int = (),
    seed: int | None = 0,
    device: torch.device | str | None = None,
    nominal: bool = False,
) -> TransformedEnv:
    """Build the environment of a configuration.

    Args:
        cfg: configuration with the nodes ``scenario``, ``observation`` and ``reward``.
        profiles: speed profiles of the leader.
        population: the human drivers.
        batch_size: parallel episodes.
        seed: seed of the generator of the episodes' seeds; None: drawn at random.
        device: device of the tensors.
        nominal: leaders and starts as in an evaluation, without the deviations of training.

    Returns:
        A TorchRL environment; docs/entries.md lists its entries.

    Raises:
        ConfigError: naming the option at fault, or the memory that the batch needs.
    """
    scenario, device = cfg.scenario, device and torch_device(device)
    if scenario.road != RING:  # numbers of records are the same for all pieces
        profiles = profiles.at_least(scenario.horizon)
    world = world_of(cfg, profiles, population, nominal)
    pieces = build_pieces(cfg, world)
    if (dtype := torch.get_default_dtype()) != torch.float32:  # in which inputs are stored
        pieces = [piece.to(dtype) for piece in pieces]
    acts = any(key == ACTION for piece in pieces for _, key in piece.needs)
    actions: dict[NestedKey, tuple[int, ...]] = {ACTION: (cfg.automated, 1)} if acts else {}
    size = MOMENTS * moment_bytes(pieces) * math.prod(batch_shape(batch_size))
    require_memory({f"batch_size={batch_size}": size}, device or "cpu")
    check_pieces(pieces, scenario.horizon, actions)
    clock = Clock(scenario.horizon, batch_size, actions, seed, device)
    acting = Pieces(*pieces)
    acting.world = replace(world, profiles=None, population=None, nominal=False)
    env = Traffic(clock, acting)
    return env.to(device) if device is not None else env


def world_of(
    cfg: StudyConfig, profiles: Any = None, population: Any = None, nominal: bool = False
) -> World:
    """Return the world of a configuration's pieces; arguments as for :func:`build_env`."""
    scenario = cfg.scenario
    return World(
        string=scenario.vehicles,
        time_step=scenario.time_step,
        horizon=scenario.horizon,
        profiles=profiles,
        population=population,
        energy=build_energy(cfg),
        nominal=nominal,
        actuators={role: node.made(Actuation) for role, node in _by_role(scenario, "actuators")},
        sensors={role: node.made(Sensors) for role, node in _by_role(scenario, "sensors")},
        filtered=[role for role, _ in _by_role(scenario, "filters")],
        max_braking=scenario.max_braking,
        max_acceleration=scenario.max_acceleration,
        replaced=scenario.replaced,
        perturbation=scenario.perturbation,
        slope=scenario.slope and scenario.slope.made(Slope),
    )


def after_humans(cfg: StudyConfig, seconds: float) -> StudyConfig:
    """Return a configuration in which human drivers drive all vehicles for the first seconds.

    Raises:
        ConfigError: if that is no multiple of the time step, or the road is open.
    """
    if not seconds:
        return cfg
    require(cfg.scenario.road == RING, "humans_first needs a ring: a leader's record would end")
    steps = World(time_step=cfg.scenario.time_step).steps(seconds, "humans_first")
    drivers, safety = cfg.scenario.controllers, cfg.scenario.filters.get(AUTOMATED)
    changes: dict[str, Any] = {"horizon": cfg.scenario.horizon + steps}
    if drivers[AUTOMATED] != drivers[HUMAN]:
        both = {"before": drivers[HUMAN], "after": drivers[AUTOMATED], "from_s": seconds}
        changes["controllers"] = {AUTOMATED: Node.of({TARGET: path_of(Handover), **both}, AUTO)}
    if safety is not None:
        changes["filters"] = {AUTOMATED: safety.changed(from_s=seconds)}
    return cfg.with_(scenario=changes)


def after_uncounted(cfg: StudyConfig) -> tuple[StudyConfig, int, int]:
    """Return the configuration of an evaluation, the steps of human drivers and of the warm-up.

    Raises:
        ConfigError: if a duration is no multiple of the time step, or the warm-up is too long.
    """
    settings, scenario = cfg.evaluation, cfg.scenario
    warm = warm_up_steps(scenario, settings.warm_up, "evaluation.warm_up")
    driven = after_humans(cfg, settings.humans_first)
    return driven, driven.scenario.horizon - scenario.horizon, warm


def warm_up_steps(scenario: ScenarioConfig, seconds: float, name: str) -> int:
    """Return the steps of a warm-up; one as long as the episode is refused."""
    steps = World(time_step=scenario.time_step).steps(seconds, name)
    require(
        steps < scenario.horizon,
        f"{name} must be below the {scenario.horizon * scenario.time_step:g} s of an episode "
        f"(scenario.horizon), got {seconds:g} s",
    )
    return steps


def _by_role(scenario: ScenarioConfig, group: str) -> list[tuple[str, Node]]:
    """Return the nodes of a group by role, for the roles in the string; refuse unknown roles."""
    nodes = getattr(scenario, group)
    require_known(f"role (scenario.{group})", nodes, scenario.controllers)
    return [(role, nodes[role]) for role in scenario.vehicles.names if nodes.get(role) is not None]


def moment_bytes(pieces: Sequence[Piece]) -> int:
    """Return the size of all entries of an episode at one time [bytes]."""
    size = torch.Size([1])
    layouts = [layout for piece in pieces for layout in piece.layouts(size, piece.targets).values()]
    return sum(shape.numel() * dtype.itemsize for shape, dtype in layouts)


def build_pieces(cfg: StudyConfig, world: World) -> list[Piece]:
    """Build the pieces of a configuration in the order in which they act.

    The order is: leader; controllers of the roles, filters and actuators; motion of the string;
    sensors; further pieces of the scenario; and, with automated vehicles, observation and reward.

    Args:
        cfg: configuration with the nodes ``scenario``, ``observation`` and ``reward``.
        world: the world to which they are bound.

    Raises:
        ConfigError: naming the option at fault.
    """
    scenario, string, energy = cfg.scenario, world.string, world.energy
    named = {name: node for name, node in scenario.pieces.items() if node is not None}
    pieces = _leader(scenario, named.pop("leader", None), world)
    named.pop("slope", None)
    slopes = [world.slope.bind(world, x) for x in (LEADER, VEHICLES)] if world.slope else []
    driving = [x for group in ("controllers", "filters") for x in _by_role(scenario, group)]
    drivers: list[Any] = [node.made(Piece).bind(world, role) for role, node in driving]
    for name, kind in energy.classes.items():
        roles = kind.roles if kind.share else ()
        require_known(f"role (scenario.fleet.{name}.roles)", roles, scenario.controllers)
    require_known("role (energy.roles)", energy.roles, scenario.controllers)
    classes = [EnergyClasses().bind(world)] if len(energy.models) > 1 else []
    actuators, sensors = (
        [piece.bind(world, role) for role, piece in group.items()]
        for group in (world.actuators, world.sensors)
    )
    pieces += [RolePlaces().bind(world), *classes, *drivers, *actuators]
    pieces += [_motion(scenario, world), *slopes, *sensors]
    pieces += _watchers(drivers, world)
    for name, node in named.items():
        piece = node.made(Piece)
        misplaced = f"scenario.pieces.{name} is a reward term: it belongs under reward.terms"
        require(not isinstance(piece, RewardTerm), misplaced)
        pieces.append(piece.bind(world, name))
    check_spacing(pieces, world.profiles)
    if not string.count(AUTOMATED):
        return pieces
    pieces.append(cfg.observation.made(Piece).bind(world))
    terms = cfg.reward.terms
    pieces += [node.made(RewardTerm).bind(world, name) for name, node in terms.items()]
    check_rewards(pieces)
    # The sum is last, before collisions of the next step.
    return [*pieces, TotalReward(terms=list(terms)).bind(world)]


def _watchers(drivers: Sequence[Controller | CBFFilter], world: World) -> list[Piece]:
    """Build the pieces that record the filters' guarantees and corrections."""
    filters = {piece.role: piece for piece in drivers if isinstance(piece, CBFFilter)}
    changed = [
        Corrected().bind(world, piece.role)
        for piece in drivers
        if isinstance(piece, Action) and piece.role in filters
    ]
    return [*(piece.watch() for piece in filters.values() if piece.guaranteed), *changed]


def _leader(scenario: ScenarioConfig, node: Any, world: World) -> list[Piece]:
    """Build the leader of an open road; a ring road has none."""
    text = "scenario.pieces.leader: a ring road has no leader that drives or is replaced "
    text += "(+event=cut_in, +event=cut_out), an open road needs one"
    require((node is None) == (scenario.road == RING), text)
    return [] if node is None else [node.made(Piece).bind(world, "leader")]


def _motion(scenario: ScenarioConfig, world: World) -> StringMotion:
    string = world.string
    if not string.ring and scenario.circumference is not None:
        raise ConfigError("scenario.circumference needs scenario.road=ring")
    named = {role: node for role, node in scenario.start.items() if role in string.names and node}
    start = {} if string.ring else {role: node.made(CALLED) for role, node in named.items()}
    names = ("circumference", "circumference_range", "vehicle_length", "initial_speed")
    of_ring = {name: getattr(scenario, name) for name in names} if string.ring else {}
    return parse(StringMotion, {"start": start, **of_ring}, "scenario").bind(world)


def make_env(
    variant: str = "alcc",
    batch_size: Sequence[int] | int = (),
    overrides: Sequence[str] = (),
    seed: int | None = None,
    device: torch.device | str | None = None,
    held_out: bool = False,
    single: bool | None = None,
) -> TransformedEnv:
    """Build the environment of a variant, as the command line does.

    Args:
        variant: ``"alcc"``, ``"reference"``, ``"idm"`` … (``conf/variant``).
        batch_size: parallel episodes.
        overrides: further command-line overrides, e.g. ``["scenario.horizon=100"]``.
        seed: seed of the generator of the episodes' seeds; None: drawn at random, so that workers
            play different episodes. ``env.set_seed`` sets it anew.
        device: device of the tensors.
        held_out: play the evaluation profiles instead of the training profiles.
        single: show the one automated vehicle as :class:`lcc_rl.envs.SingleAgent`; None: so if
            there is exactly one, and several as :class:`lcc_rl.envs.MultiAgent`; False: neither.

    Returns:
        A TorchRL environment: ``observation``, ``[*batch, features]``, scaled to about 1 or, with
        ``observation.raw=true``, in SI units; ``action`` in [−1, 1], by default ±3 m/s²,
        ``reward``, without unit, and ``done``, ``[*batch, 1]`` each. Several automated vehicles
        have ``("automated", "action")`` …, ``[*batch, vehicles, 1]``. docs/entries.md lists all.

    Raises:
        ConfigError: if the variant or an override is unknown or has no effect, or with ``single``
            there is not exactly one automated vehicle.

    Examples:
        >>> env = make_env("alcc", batch_size=1024)  # doctest: +SKIP
        >>> env.rollout(300)["next", "reward"].shape  # doctest: +SKIP
        torch.Size([1024, 300, 1])
    """
    for name, flag, kinds in (("held_out", held_out, bool), ("single", single, bool | None)):
        require(isinstance(flag, kinds), f"{name} must be True or False, got {flag!r}")
    words = with_variant(variant, overrides)
    cfg = load("train", words)
    unused = OF_COMMANDS | (drawn_in_training(cfg.scenario) if held_out else {})
    if held_out and cfg.scenario.road != RING:
        del unused["evaluation.profiles"]
    refuse(words, unused)
    inputs = shared_inputs(cfg)
    profiles = inputs.evaluation if held_out else inputs.to_learn_from()
    env = build_env(cfg, profiles, inputs.population, batch_size, seed, device, held_out)
    count = cfg.automated
    if single and count != 1:
        raise ConfigError(f"single=True needs one automated vehicle, the string has {count}")
    return env.append_transform(view_of(count)) if count and single is not False else env
