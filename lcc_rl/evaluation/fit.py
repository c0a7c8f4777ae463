"""Checks that variant, task and trained policies fit the configuration under study."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModule

from lcc_rl.config import load
from lcc_rl.config.compose import config_hash
from lcc_rl.config.nodes import Node, as_plain
from lcc_rl.config.schemas import AUTO, StudyConfig
from lcc_rl.energy import VehicleClass
from lcc_rl.envs.inputs import MADE, build_energy, origin_of
from lcc_rl.errors import ConfigError, is_ours, require
from lcc_rl.functional.pattern import AUTOMATED, HUMAN
from lcc_rl.io.files import parquet_metadata
from lcc_rl.results.policies import PRETRAINED
from lcc_rl.results.runs import differing, flatten
from lcc_rl.results.task import OF_FUEL, Task, burns_one_fuel, check_unit
from lcc_rl.settings import TARGET, parse

MESSAGES = "communication"  # name of the piece with messages between connected vehicles
FIRST_LAYER = "module.0.0.weight"  # first layer of a policy's network
TRAFFIC_NODES = ("data", "split", "drivers")


def check_table_unit(cfg: StudyConfig) -> None:
    """Check that energies of a configuration's tables have its ``unit``, if it gives one."""
    if (unit := cfg.unit) is None:
        return
    episodes, task = cfg.evaluation.rows == "episodes", task_of(cfg)
    require(episodes, f"unit={unit}: tables of platoons have no energy per distance")
    per = task is None or task.measure.per
    require(per, f"unit={unit}: the score of this task is no energy per distance")
    check_unit(unit, build_energy(cfg))


def task_of(cfg: StudyConfig) -> Task | None:
    """Return the task of a configuration; None without one.

    If its unit needs a single fuel and scenario.fleet adds vehicles of another, it is kJ/km.
    """
    if cfg.task is None:
        return None
    task, energy = parse(Task, cfg.task, "task"), build_energy(cfg)
    if cfg.scenario.fleet and task.unit in OF_FUEL and not burns_one_fuel(energy):
        return replace(task, unit="kJ/km")
    check_unit(task.unit, energy)
    return task


def check_variant(cfg: StudyConfig) -> None:
    """Refuse a variant that does not fit the scenario.

    Variant and configuration must both have an agent or none, and connected vehicles need messages.
    """
    try:
        variant = load("train", [f"variant={cfg.variant}"])
    except ConfigError:  # a user's variant that only this command line defines
        return
    talks, heard = (MESSAGES in x.scenario.pieces for x in (variant, cfg))
    if talks and not heard:
        raise ConfigError(
            f"variant={cfg.variant} is of connected vehicles, and scenario {cfg.scenario.name} has "
            "no messages: use task=platoon-us06, task=platoon-highway or scenario=platoon"
        )
    if cfg.learns and not variant.learns:  # the variant has no automated vehicle, the task has
        raise ConfigError(f"variant={cfg.variant} has no agent: use compare=[{cfg.variant}]")
    if variant.learns and not cfg.learns and cfg.automated:
        one, other = (x.scenario.controllers[AUTOMATED].kind for x in (cfg, variant))
        require(
            one is not other,
            f"variant={cfg.variant} is a learned controller, but there is no agent; for a human "
            "driver use variant=idm",
        )


def check_policy(cfg: StudyConfig, own: StudyConfig) -> None:
    """Check that a policy was trained for the variant, observation and action under study.

    Args:
        cfg: configuration under study; its ``policy`` names the policy.
        own: configuration of the policy's training.

    Raises:
        ConfigError: naming the difference.
    """
    path = f"policy={cfg.policy}"
    task = (own.task or {}).get("name")
    if task is not None and cfg.task is None:
        raise ConfigError(f"{path} was trained for a task: add task={task}")
    check_scenario(path, own, cfg)
    hybrid = cfg.deployed is not None or own.deployed is not None
    if own.variant != cfg.variant and not hybrid:
        raise ConfigError(f"{path} was trained as variant {own.variant}, not {cfg.variant}")
    _check_entries(path, own, cfg)
    _check_same(path, *(_observed(x, of_observation(own)) for x in (own, cfg)))
    check_action(path, own, cfg)


def _check_entries(path: str, own: StudyConfig, cfg: StudyConfig) -> None:
    """Check that an observation has the entries of the training."""
    scales = (x.observation.settings.get("scales", {}) for x in (own, cfg))
    trained, studied = ({key for key, _ in flatten(nested)} for nested in scales)
    groups = (("with", trained - studied), ("without", studied - trained))
    extra = [f"{word} {', '.join(sorted(keys))}" for word, keys in groups if keys]
    require(
        not extra,
        f"{path} was trained {' and '.join(extra)} in its observation: give the options of its "
        f"training, or 'compare=[{path.removeprefix('policy=')}]', which observes as in training",
    )


def of_observation(cfg: StudyConfig) -> set[str]:
    """Return the pieces that belong to an observation: named as an entry, or a user's own."""
    scales = cfg.observation.settings.get("scales", {})
    kinds = {x: node.settings[TARGET] for x, node in cfg.scenario.pieces.items() if node}
    return {x for x, kind in kinds.items() if x in scales or not is_ours(kind)}


def _observed(cfg: StudyConfig, names: Iterable[str]) -> dict[str, Any]:
    """Return the settings of an observation, the order of its entries and the named pieces."""
    node = as_plain(cfg.observation)
    order = [key for key, _ in flatten(node) if key.startswith("scales.")]
    pieces = {name: cfg.scenario.pieces.get(name) for name in names}
    settled = {f"scenario.pieces.{x}": _settled(piece) for x, piece in pieces.items()}
    return {"observation": {**node, "order of scales": order}, **settled}


def _settled(piece: Node | None) -> Any:
    """Return the settings of a piece without its conditions, which an evaluation may change."""
    free = conditions_of(piece)
    return piece and {key: x for key, x in as_plain(piece).items() if key not in free}


def conditions_of(piece: Node | None) -> tuple[str, ...]:
    """Return the names of a piece's conditions."""
    return getattr(piece.kind, "conditions", ()) if piece else ()


def check_scenario(path: str, own: StudyConfig, cfg: StudyConfig) -> None:
    """Check that a policy was trained in the scenario under study.

    Raises:
        ConfigError: naming both scenarios.
    """
    if own.scenario.name != cfg.scenario.name:
        raise ConfigError(
            f"{path} was trained as variant {own.variant}, in the scenario "
            f"{own.scenario.name}, not in {cfg.scenario.name}"
        )


def check_action(path: str, own: StudyConfig, cfg: StudyConfig) -> None:
    """Check that an action has the size and duration of the training.

    Args:
        path: origin of the policy, for the message.
        own: configuration of its training.
        cfg: configuration under study.

    Raises:
        ConfigError: naming the difference.
    """
    trained, studied = (
        {
            "scenario.time_step": node.scenario.time_step,
            AUTO: as_plain(node.scenario.controllers[AUTOMATED]),
        }
        for node in (own, cfg)
    )
    _check_same(path, trained, studied)


def _check_same(path: str, own: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    old, new = dict(flatten(own)), dict(flatten(asked))
    changes = [f"{key}={old.get(key)}, got {new.get(key)}" for key in differing(old, new)]
    require(not changes, f"{path} was trained with {'; '.join(changes)}")


def other_traffic(path: str, own: StudyConfig, cfg: StudyConfig) -> str:
    """Return a warning if a policy was trained with other data, drivers or split; else nothing.

    There is no warning for a task, which defines its own, or for a shipped policy.
    """
    if cfg.task is not None or Path(path).parts[:1] == (PRETRAINED,):
        return ""
    pairs = {x: [(getattr(y, x), y.inputs.get(x)) for y in (own, cfg)] for x in TRAFFIC_NODES}
    changed = [x for x, (a, b) in pairs.items() if _hashes(*a, True).isdisjoint(_hashes(*b))]
    if not changed:
        return ""
    paths = {x: (node := getattr(own, x)) and node.settings.get("path") for x in changed}
    sources = ", ".join(name + (f" (path={at})" if at else "") for name, at in paths.items())
    options = " ".join(f"{name}=…" for name in changed)
    return (
        f"{path} was trained with other {sources}: use {options} as in the config.yaml of its "
        "training to evaluate on the windows that were held out there"
    )


def _hashes(described: Any, files: Mapping[str, str] | None, copies: bool = False) -> set[str]:
    """Return hashes of a node, of its files' contents and, for ``copies``, of their originals."""
    node = as_plain(described)
    hashes = {config_hash(node), config_hash([node, files])}
    if files:
        rest = {key: x for key, x in node.items() if key != "path" and x is not None}
        hashes.add(config_hash([rest, sorted(files.values())]))
    for file in (x for x in files or () if copies and x.endswith(".parquet") and Path(x).is_file()):
        hashes |= {x for key, x in parquet_metadata(file).items() if key == MADE}
    return hashes


def other_drivers(cfg: StudyConfig) -> str:
    """Return a sentence if a task's human drivers have been replaced; else nothing."""
    if cfg.task is None or HUMAN not in cfg.scenario.vehicles.names:
        return ""
    name = cfg.task["name"]
    try:
        task = load("evaluate", [f"task={name}"])
    except ConfigError:  # a task without a file
        return ""
    if task.drivers == cfg.drivers:
        return ""
    return (
        f"Human drivers: {origin_of(cfg.drivers)} instead of those of task={name} "
        f"({origin_of(task.drivers)}); published scores do not apply."
    )


def classes(cfg: StudyConfig) -> str:
    """Return a sentence on the classes of ``scenario.fleet`` and their shares; else nothing."""
    nodes = {name: node for name, node in cfg.scenario.fleet.items() if node is not None}
    fleet = {name: node.made(VehicleClass) for name, node in nodes.items()}
    shares = (f"{x.share:.0%} of {' and '.join(x.roles)}: {name}" for name, x in fleet.items())
    return f"Classes of vehicles (scenario.fleet): {', '.join(shares)}." if nodes else ""


def check_width(policy: TensorDictModule, weights: Mapping[str, Any], path: str) -> None:
    """Check that a trained network has as many inputs as a network for this string.

    Raises:
        ConfigError: naming both numbers.
    """
    trained, built = (state.get(FIRST_LAYER) for state in (weights, policy.state_dict()))
    if trained is not None and built is not None and trained.shape[1] != built.shape[1]:
        raise ConfigError(
            f"policy={path} was trained with {trained.shape[1]} observed entries; in this "
            f"scenario.string an automated vehicle has {built.shape[1]}: train one for it, with "
            "the same scenario.string and observation"
        )
