"""The factory: from a configuration to an environment, a policy and what they need."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torchrl.envs import TransformedEnv

from lcc_rl.config import TARGET, build, find_target, is_sweep, load, plain
from lcc_rl.data.cycles import Case
from lcc_rl.data.profiles import Profiles, leader_profiles
from lcc_rl.data.sources import LoadedEpisodes, find_files
from lcc_rl.envs.clock import Clock, Traffic
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.pieces import Piece, TotalReward
from lcc_rl.pieces.base import SEED, STEP, Pieces, Transition, arrived
from lcc_rl.pieces.vehicles import Population


@dataclass(frozen=True)
class Inputs:
    """What a study is made from: profiles to train and to evaluate on, and drivers.

    Args:
        training: speed profiles for training.
        evaluation: speed profiles held out, as windows of one horizon.
        population: the human drivers.
        report: what was read and dropped, as plain lines.
        cases: runs of a platoon that are looked at closely.
        full_length: a whole record for a platoon; None for none.
    """

    training: Profiles
    evaluation: Profiles
    population: Population
    report: tuple[str, ...] = ()
    cases: tuple[Case, ...] = ()
    full_length: Case | None = None


def load_inputs(cfg: DictConfig, episodes: Any = None) -> Inputs:
    """Read the trajectories, split their leaders' profiles and build the population.

    Args:
        cfg: configuration of a study.
        episodes: table of episodes if already at hand; else ``cfg.data`` is read.

    Raises:
        DataError, ConfigError: naming the file, row or option at fault.
    """
    if cfg.get("leader") is not None:
        return _platoon_inputs(cfg)
    report: Sequence[str] = ()
    if episodes is None:
        loaded = _load_episodes(cfg.data)
        episodes, report = loaded.episodes, loaded.report
    scenario = cfg.scenario
    profiles = leader_profiles(episodes, scenario.time_step).at_least(scenario.horizon)
    training, evaluation = build(cfg.split, "split")(profiles)
    windows = evaluation.windows(scenario.horizon, cfg.evaluation.profiles)
    population = build(cfg.drivers, "drivers")
    available = {"profiles": len(windows), "drivers": len(population.time_gap)}
    return Inputs(training, windows, population, (*report, *shortfalls(cfg, available)))


# Of the sweep that this process works on: its runs mostly differ in other things than the data.
_loaded: dict[str, LoadedEpisodes] = {}


def _load_episodes(node: DictConfig) -> LoadedEpisodes:
    """Load episodes; the runs of a sweep that one process does share those of the same files."""
    if not is_sweep():
        return build(node, "data").load()
    settings = plain(node)
    key = json.dumps([settings, list(_stamps(settings))])
    if key not in _loaded:
        loaded = build(node, "data").load()
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


def _platoon_inputs(cfg: DictConfig) -> Inputs:
    """Read the records that a platoon's leader drives."""
    scenario = cfg.scenario
    leaders = build(cfg.leader, "leader").load(
        scenario.time_step, scenario.horizon, scenario.followers
    )
    return Inputs(
        leaders.training.at_least(scenario.horizon),
        leaders.windows.spread(cfg.evaluation.profiles),
        build(cfg.drivers, "drivers"),
        leaders.report,
        leaders.cases,
        leaders.full_length,
    )


def build_env(
    cfg: DictConfig,
    profiles: Profiles,
    population: Population,
    batch_size: Sequence[int] | int = (),
    seed: int = 0,
    device: torch.device | str | None = None,
) -> TransformedEnv:
    """Build the environment of a configuration.

    Args:
        cfg: configuration with the nodes ``scenario``, ``observation`` and ``reward``.
        profiles: speed profiles of the leader.
        population: the human drivers.
        batch_size: episodes side by side.
        seed: seed of the episodes' seeds.
        device: where the tensors live.

    Returns:
        A TorchRL environment; see the README for its entries.

    Raises:
        ConfigError: naming the option at fault.
    """
    scenario = cfg.scenario
    resources = {
        "profiles": profiles,
        "population": population,
        "time_step": scenario.time_step,
        "horizon": scenario.horizon,
    }
    pieces: list[Piece] = [
        build(node, f"scenario.pieces.{name}", **resources)
        for name, node in scenario.pieces.items()
        if node is not None
    ]
    pieces.append(build(cfg.observation, "observation", **resources))
    pieces += [
        build(node, f"reward.terms.{name}", name=name, **resources)
        for name, node in cfg.reward.terms.items()
    ]
    moved = [piece.event_shape for piece in pieces if ("action",) in map(arrived, piece.in_keys)]
    action_shape = moved[0] if moved else (1,)
    # What is rewarded is what acts: one car, or every follower of a platoon.
    pieces.append(TotalReward(list(cfg.reward.terms), action_shape))
    _check_wiring(pieces)
    clock = Clock(scenario.horizon, batch_size, action_shape, seed, device)
    env = Traffic(clock, Pieces(*pieces))
    return env.to(device) if device is not None else env


def _check_wiring(pieces: Sequence[Piece]) -> None:
    """Check that every entry read is written by the clock, the policy or a piece.

    Raises:
        ConfigError: naming the entry and the piece that reads it.
    """
    own = [SEED, STEP, ("action",), ("done",), ("terminated",)]
    written = {arrived(key) for piece in pieces for key in piece.out_keys} | set(own)
    for piece in pieces:
        written |= set(piece.constants) if isinstance(piece, Transition) else set()
    for piece in pieces:
        for key in map(arrived, piece.in_keys):
            if key not in written:
                raise ConfigError(
                    f"{type(piece).__name__} reads {'.'.join(key)}, which no piece of the "
                    "scenario writes; was a piece removed?"
                )


def any_leader(cfg: DictConfig) -> DictConfig:
    """Return a configuration without the one record that its leader may be told to play.

    That record is one to train on: with other profiles at hand its number means nothing.
    """
    cfg = cfg.copy()
    if "profile" in cfg.scenario.pieces.get("leader", {}):
        cfg.scenario.pieces.leader.profile = None
    return cfg


def learns(cfg: DictConfig) -> bool:
    """Whether the agent of a configuration learns anything."""
    return bool(getattr(find_target(cfg.agent[TARGET], "agent"), "learns", True))


def build_agent(cfg: DictConfig, population: Population, device: str = "cpu") -> Any:
    """Build the agent of a configuration: something with ``policy`` and ``learns``.

    Raises:
        ConfigError: naming the option at fault.
    """
    node = plain(cfg.agent)
    if not learns(cfg):
        # A recipe's learning settings mean nothing to those that do not learn.
        known = inspect.signature(find_target(node[TARGET], "agent")).parameters
        node = {key: value for key, value in node.items() if key in known or key == TARGET}
    vehicle = cfg.scenario.pieces.get("cav") or cfg.scenario.pieces.get("platoon")
    observation: Piece = build(cfg.observation, "observation")
    return build(
        node,
        "agent",
        population=population,
        observation_size=observation.event_shape[-1],
        action_size=1,
        max_acceleration=vehicle.max_acceleration if vehicle is not None else 1.0,
        seed=cfg.seed,
        time_step=cfg.scenario.time_step,
        device=device,
    )


def build_policy(cfg: DictConfig, learned: Any) -> Any:
    """Build what drives: the agent's policy, or the controller composed with it.

    Args:
        cfg: configuration of a study; its node ``controller`` may be null.
        learned: the policy of the agent.

    Raises:
        ConfigError: naming the option at fault.
    """
    if cfg.get("controller") is None:
        return learned
    return build(
        cfg.controller,
        "controller",
        learned=learned,
        time_step=cfg.scenario.time_step,
        max_acceleration=cfg.scenario.pieces.platoon.max_acceleration,
    )


def make_env(
    variant: str = "alcc",
    batch_size: Sequence[int] | int = (),
    overrides: Sequence[str] = (),
    seed: int = 0,
    device: torch.device | str | None = None,
    held_out: bool = False,
) -> TransformedEnv:
    """Build the environment of a variant, as the command line would.

    Args:
        variant: ``"alcc"``, ``"reference"``, ``"idm"`` … (``conf/variant``).
        batch_size: episodes side by side.
        overrides: further command-line overrides, e.g. ``["scenario.horizon=100"]``.
        seed: seed of the episodes' seeds.
        device: where the tensors live.
        held_out: play the evaluation profiles instead of the training ones.

    Raises:
        ConfigError: if the variant or an override is unknown.

    Examples:
        >>> env = make_env("alcc", batch_size=1024)  # doctest: +SKIP
        >>> env.rollout(300)["next", "reward"].shape  # doctest: +SKIP
        torch.Size([1024, 300, 1])
    """
    cfg = load("train", [f"variant={variant}", *overrides])
    inputs = load_inputs(cfg)
    profiles = inputs.evaluation if held_out else inputs.training
    return build_env(cfg, profiles, inputs.population, batch_size, seed, device)
