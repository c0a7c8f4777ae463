"""What a study is made from: leaders' speed profiles to train and to evaluate on, and drivers."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig

from lcc_rl.config import CALLED, build_as, is_sweep, plain
from lcc_rl.config_checks import string_of_scenario
from lcc_rl.data.cycles import Case
from lcc_rl.data.profiles import Profiles, from_records, leader_profiles
from lcc_rl.data.sources import LoadedEpisodes, find_files
from lcc_rl.errors import DataError
from lcc_rl.functional.pattern import RING, VehicleString
from lcc_rl.pieces.controllers import Population


@dataclass(frozen=True)
class Inputs:
    """What a study is made from.

    Args:
        training: speed profiles for training.
        evaluation: speed profiles held out, as windows of one horizon.
        population: the human drivers.
        report: what was read and dropped, as plain lines.
        cases: runs that are looked at closely.
        full_length: a whole record to drive; None for none.
    """

    training: Profiles
    evaluation: Profiles
    population: Population
    report: tuple[str, ...] = ()
    cases: tuple[Case, ...] = ()
    full_length: Case | None = None


def string_of(cfg: DictConfig) -> VehicleString:
    """Return the string of vehicles of a configuration.

    Raises:
        ConfigError: pointing at the place in the pattern where it cannot be read.
    """
    return string_of_scenario(cfg.scenario)


def build_drivers(cfg: DictConfig) -> Population:
    """Build the human drivers of a configuration.

    Raises:
        ConfigError: naming the option at fault.
    """
    needed = ("desired_speed", "time_gap", "constants")
    return cast(Population, build_as("a population", needed, cfg.drivers, "drivers"))


def build_source(node: Any) -> Any:
    """Build the source of episodes that the node ``data`` describes.

    Raises:
        ConfigError: naming the option at fault.
    """
    return build_as("a source of episodes", ("load",), node, "data")


def load_inputs(cfg: DictConfig, episodes: Any = None) -> Inputs:
    """Read what the leader drives, split it and build the population.

    Args:
        cfg: configuration of a study.
        episodes: table of episodes if already at hand; else ``cfg.data`` is read.

    Raises:
        DataError, ConfigError: naming the file, row or option at fault.
    """
    scenario = cfg.scenario
    population = build_drivers(cfg)
    if scenario.road == RING:
        names = [f"ring {number}" for number in range(cfg.evaluation.profiles or 1)]
        nobody = constant_profiles(0.0, scenario.horizon, scenario.time_step, names)
        return Inputs(nobody, nobody, population)
    if cfg.get("leader") is not None:
        return _record_inputs(cfg, population)
    report: Sequence[str] = ()
    if episodes is None:
        loaded = _load_episodes(cfg.data)
        episodes, report = loaded.episodes, loaded.report
    profiles = leader_profiles(episodes, scenario.time_step).at_least(scenario.horizon)
    training, evaluation = build_as("a split", CALLED, cfg.split, "split")(profiles)
    windows = evaluation.windows(scenario.horizon, cfg.evaluation.profiles)
    available = {"profiles": len(windows), "drivers": len(population.time_gap)}
    return Inputs(training, windows, population, (*report, *shortfalls(cfg, available)))


def constant_profiles(
    speed: float, horizon: int, time_step: float, names: Sequence[str]
) -> Profiles:
    """Return profiles at a constant speed [m/s], long enough for an episode."""
    records = [torch.full((max(2, horizon + 1),), speed) for _ in names]
    return from_records(records, list(names), list(names), time_step)


# Of the sweep that this process works on: its runs mostly differ in other things than the data.
_loaded: dict[str, LoadedEpisodes] = {}


def _load_episodes(node: DictConfig) -> LoadedEpisodes:
    """Load episodes; the runs of a sweep that one process does share those of the same files."""
    if not is_sweep():
        return build_source(node).load()
    settings = plain(node)
    key = json.dumps([settings, list(_stamps(settings))])
    if key not in _loaded:
        loaded = build_source(node).load()
        _loaded.clear()
        _loaded[key] = loaded
    return _loaded[key]


def _stamps(value: Any) -> Iterator[tuple[str, int, int]]:
    """Yield name, time and size of every file that settings name, by a pattern, too."""
    if isinstance(value, (Mapping, list)):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _stamps(item)
    elif isinstance(value, str):
        with suppress(DataError, OSError):
            for name in find_files(value):
                stat = Path(name).stat()
                yield name, stat.st_mtime_ns, stat.st_size


def shortfalls(cfg: DictConfig, available: Mapping[str, int]) -> list[str]:
    """Return a line for everything that an evaluation asks more of than there is."""
    return [
        f"evaluation.{name}={cfg.evaluation[name]}: only {count} are available; taking all"
        for name, count in available.items()
        if cfg.evaluation[name] is not None and cfg.evaluation[name] > count
    ]


def _record_inputs(cfg: DictConfig, population: Population) -> Inputs:
    """Read the records that the leader drives."""
    scenario = cfg.scenario
    leaders = build_as("a source of leaders", ("load",), cfg.leader, "leader").load(
        scenario.time_step, scenario.horizon, len(string_of(cfg))
    )
    return Inputs(
        leaders.training.at_least(scenario.horizon),
        leaders.windows.spread(cfg.evaluation.profiles),
        population,
        leaders.report,
        leaders.cases,
        leaders.full_length,
    )
