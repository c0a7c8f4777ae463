"""Inputs of a study: speed profiles of leaders for training and evaluation, and drivers."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import torch

from lcc_rl.config.compose import is_sweep
from lcc_rl.config.inputs import inputs_of
from lcc_rl.config.nodes import CALLED, Node, as_plain, nodes_in
from lcc_rl.config.schemas import StudyConfig
from lcc_rl.data.leaders import Case, TrajectoryLeaders
from lcc_rl.data.profiles import Profiles, from_records
from lcc_rl.data.sources import LoadedEpisodes
from lcc_rl.energy import Fleet, VehicleClass, as_fleet
from lcc_rl.errors import Concern, ConfigError
from lcc_rl.functional.driver_models import Reaction
from lcc_rl.functional.pattern import RING
from lcc_rl.pieces.controllers import Population
from lcc_rl.settings import TARGET

MADE = "lcc_rl.data"  # key of the data's hash in the metadata of a pipeline's trajectories
BOOTSTRAP = "lcc_rl.drivers.population.bootstrap"  # of a table, by default the shipped one
POPULATION = ("desired_speed", "time_gap", "constants")  # attributes of human drivers
LOADS = ("load",)  # method of sources of episodes and of leaders
MEANT = ("power", "path_power", "stored_energy", "acceleration_loss", "infeasible")


@dataclass(frozen=True)
class Inputs:
    """Inputs of a study.

    Args:
        training: speed profiles for training; none if all are for evaluation.
        evaluation: held-out speed profiles, windows of one horizon.
        population: the human drivers.
        report: lines on the data that were read and dropped.
        cases: records that are shown as time series.
        full_length: whole records to drive.
    """

    training: Profiles
    evaluation: Profiles
    population: Population
    report: tuple[str, ...] = ()
    cases: tuple[Case, ...] = ()
    full_length: tuple[Case, ...] = ()

    def to_learn_from(self) -> Profiles:
        """Return the profiles for training.

        Raises:
            ConfigError: if all are for evaluation.
        """
        if not len(self.training):
            raise ConfigError(
                "no profile is left to train on: evaluation_share=1 of split or "
                "leader holds out all of them; hold out less"
            )
        return self.training


def build_drivers(cfg: StudyConfig) -> Population:
    """Build the human drivers of a configuration.

    Raises:
        ConfigError: naming the option at fault.
    """
    return cast(Population, cfg.drivers.made(POPULATION))


def build_energy(cfg: StudyConfig) -> Fleet:
    """Build the classes of vehicles of a configuration: those of ``energy``, then of the scenario.

    Without the node ``energy`` the only class has the energy model of the ALCC paper.

    Raises:
        ConfigError: naming the option at fault.
    """
    fleet, nodes = as_fleet(cfg.energy and cfg.energy.made(MEANT)), cfg.scenario.fleet
    classes = {name: node.made(VehicleClass) for name, node in nodes.items() if node is not None}
    return fleet.extended(classes, cfg.scenario.vehicle_length)


def second_energy(cfg: StudyConfig) -> Fleet | None:
    """Build the energy model of the second saving, ``evaluation.second_energy``, if there is one.

    Raises:
        ConfigError: naming the option at fault.
    """
    node = cfg.evaluation.second_energy
    return None if node is None else as_fleet(node.made(MEANT))


def load_inputs(cfg: StudyConfig, episodes: Any = None) -> Inputs:
    """Read the leaders' records, split them and build the population.

    Args:
        cfg: configuration of a study.
        episodes: table of episodes; None: ``cfg.data`` is read.

    Raises:
        DataError, ConfigError: naming the file, row or option at fault.
    """
    scenario = cfg.scenario
    population = build_drivers(cfg)
    if scenario.road == RING:
        names = [f"ring {number}" for number in range(cfg.evaluation.profiles or 1)]
        empty = constant_profiles(0.0, scenario.horizon, scenario.time_step, names)
        short = shortfalls(cfg, {"drivers": len(population.time_gap)}, {})
        return Inputs(empty, empty, population, (described(population, cfg), *short))
    cars = len(cfg.scenario.vehicles) if cfg.evaluation.rows == "vehicles" else None
    leaders = _source_of_leaders(cfg, episodes).load(scenario.time_step, scenario.horizon, cars)
    windows, training = leaders.windows, leaders.training
    if len(training):
        training = training.at_least(scenario.horizon)
    available = {
        f"profiles {source}".strip(): count
        for source, count in (Counter(windows.sources) or {"": len(windows)}).items()
    } | {"drivers": len(population.time_gap)}
    short = shortfalls(cfg, available, leaders.left_out)
    return Inputs(
        training,
        windows.spread(cfg.evaluation.profiles),
        population,
        (*leaders.report, described(population, cfg), *short),
        leaders.cases,
        leaders.full_length,
    )


def _source_of_leaders(cfg: StudyConfig, episodes: Any) -> Any:
    """Build the node ``leader``; without it, the leaders of ``data`` divided by ``split``."""
    if cfg.leader is not None:
        return cfg.leader.made(LOADS)
    loaded = load_episodes(cfg.data) if episodes is None else LoadedEpisodes(episodes, [])
    split = cfg.split.made(CALLED)
    # Every window is kept: the low-variation filter is for platoons, whose errors are relative.
    return TrajectoryLeaders(source=loaded, split=split, least_variation=0.0)


def described(population: Population, cfg: StudyConfig) -> str:
    """Return a line on the human drivers and their leaders."""
    speed, gap = population.desired_speed, population.time_gap
    separate = cfg.leader is not None and "source" not in cfg.leader.settings
    leaders = cfg.leader if separate else cfg.data
    source = leaders.settings.get("path") or "synthetic or shipped traffic"
    behind = "on a ring" if cfg.scenario.road == RING else f"behind leaders of {source}"
    mode = getattr(population, "mode", None)
    suffix = f", drivers.mode={mode}" if mode else ""
    vehicles = getattr(population, "vehicles", 0)
    records = f", one per record of {vehicles} vehicle(s)" * (0 < vehicles < len(gap))
    drivers = f"{len(gap)} human drivers{records} ({origin_of(cfg.drivers)}{suffix})"
    line = f"{drivers} {behind}: mean v0 {speed.mean():.1f} m/s, mean T {gap.mean():.2f} s"
    reaction = getattr(population, "reaction", None)
    if reaction is None or reaction == Reaction():
        return line
    line += f", reaction delay {reaction.delay:g} s, noise {reaction.noise:g} m/s²"
    return line + f", of perceived gaps {reaction.gap_noise:g}" * bool(reaction.gap_noise)


def origin_of(drivers: Node) -> str:
    """Return the origin of drivers, or the name of the user's function that returns them."""
    if drivers.settings[TARGET] != BOOTSTRAP:
        return drivers.name
    path = drivers.settings.get("path")
    return f"calibrated, {path}" if path else "fitted to NGSIM I-80, shipped"


def constant_profiles(
    speed: float, horizon: int, time_step: float, names: Sequence[str]
) -> Profiles:
    """Return profiles at a constant speed [m/s], long enough for an episode."""
    records = [torch.full((max(2, horizon + 1),), speed) for _ in names]
    return from_records(records, list(names), list(names), time_step)


# Values that this process read last, with their keys and classes, by kind.
_last: dict[str, tuple[str, list[Any], Any]] = {}
SHARED = "data: read by an earlier run of this process, which reported:"


def _once(what: str, settings: Any, make: Callable[[], Any]) -> tuple[Any, bool]:
    """Return the value of settings, with their files and classes, and whether it was cached."""
    plain = as_plain(settings)
    key, kinds = json.dumps([plain, inputs_of(plain)], default=str), nodes_in(settings)
    of = key, [node.kind for node in kinds]  # a notebook may define a class anew
    cached = what in _last and _last[what][:2] == of
    if not cached:
        _last[what] = *of, make()
    return _last[what][2], cached


def shared_inputs(cfg: StudyConfig) -> Inputs:
    """Load inputs as :func:`load_inputs`; consecutive environments of equal settings share them.

    Raises:
        DataError, ConfigError: naming the file, row or option at fault.
    """
    inputs: Inputs = _once("inputs", cfg, lambda: load_inputs(cfg))[0]
    return inputs


def load_episodes(node: Node) -> LoadedEpisodes:
    """Load episodes; runs of a sweep in one process share those of the same files.

    Args:
        node: the node ``data`` of a configuration.

    Raises:
        DataError, ConfigError: naming the file, row or option at fault.
    """
    if not is_sweep():
        return cast(LoadedEpisodes, node.made(LOADS).load())
    loaded, cached = _once("episodes", {"data": node}, lambda: node.made(LOADS).load())
    return replace(loaded, report=[SHARED, *loaded.report]) if cached else loaded


def shortfalls(
    cfg: StudyConfig, available: Mapping[str, int], gone: Mapping[str, int]
) -> list[Concern]:
    """Return a line for every count of an evaluation that exceeds the available data.

    Args:
        cfg: configuration of a study.
        available: available numbers by ``"<setting>"`` or ``"<setting> <source>"``.
        gone: ``left_out`` of :class:`lcc_rl.data.leaders.Leaders`.
    """
    lines = []
    for label, count in available.items():
        name, _, source = label.partition(" ")
        asked = getattr(cfg.evaluation, name)
        if asked is not None and asked > count:
            out = gone.get(source, 0) if name == "profiles" else 0
            only = f"only {count} {f'of {source} ' if source else ''}are available"
            only += f" and {out} are left out, see above" * bool(out) + "; taking all"
            lines.append(Concern(f"evaluation.{name}={asked}: {only}"))
    return lines
