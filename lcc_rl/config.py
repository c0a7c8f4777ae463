"""Composes configurations and builds the objects that their nodes describe."""

from __future__ import annotations

import hashlib
import inspect
import json
import re
import typing
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from lcc_rl.config_checks import as_meant, check_ignored, renamed_option
from lcc_rl.config_errors import check_keys, explain, refused_by_hydra, refused_key
from lcc_rl.config_types import check_numbers, check_types
from lcc_rl.errors import ConfigError, LccError, unknown_name
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, parse_string
from lcc_rl.schemas import check_ranges, register_schemas
from lcc_rl.settings import Settings, parse, values
from lcc_rl.targets import TARGET, find_target, forget_places, parameters_of

CONF = "lcc_rl.conf"
CALLED = ("__call__",)  # what a node that is used as a function makes
# Settings that do not change any row of a result.
NOT_IDENTITY = (
    *("resume", "jobs", "sweep", "objective", "logger", "trust", "figure_formats"),
    "training.keep_every",
)


def chosen_folder(resumed: str | None, fresh: str) -> str:
    """Return where a run goes: a resumed one on in its own folder, which Hydra would make anew.

    Raises:
        ConfigError: if there is no run to resume.
    """
    if resumed and not (Path(resumed) / "config.yaml").is_file():
        raise ConfigError(f"resume={resumed}: not a run folder: it has no config.yaml")
    return str(resumed or fresh)


def hydra_folder(folder: str | None) -> str | None:
    """Return where Hydra notes its own settings: nowhere in a folder that holds a run before."""
    return None if folder and (Path(folder) / "config.yaml").is_file() else ".hydra"


def terms_of_energy(string: Any) -> float:
    """Return how many vehicles' energy counts for an automated one: its own and those behind."""
    roles = parse_string(plain(string) if OmegaConf.is_config(string) else string)
    return 1.0 + roles.count(HUMAN) / max(roles.count(AUTOMATED), 1)


register_schemas()
OmegaConf.register_new_resolver("lcc.folder", chosen_folder, replace=True)
OmegaConf.register_new_resolver("lcc.hydra", hydra_folder, replace=True)
OmegaConf.register_new_resolver("lcc.pairs", lambda a, b: len(a) * len(b), replace=True)
OmegaConf.register_new_resolver("lcc.energies", terms_of_energy, replace=True)


def load(entry: str, overrides: Sequence[str] = ()) -> DictConfig:
    """Compose a configuration in Python exactly as the command line would.

    Args:
        entry: entry point: ``"train"``, ``"evaluate"``, ``"calibrate"`` or ``"pipeline"``.
        overrides: what one would type after the command.

    Raises:
        ConfigError: if an override is unknown, of the wrong type or out of range.
    """
    try:
        cfg = _compose(entry, overrides)
        check_keys(cfg)
        leave_out_foreign(cfg, overrides)
        complete(cfg)
        check_ignored(cfg, overrides)
        check_ranges(cfg)
    except Exception as error:
        if isinstance(error, LccError) or not refused_by_hydra(error):
            raise
        said = str(explained(error, entry, overrides))
        raise ConfigError(" ".join(said.split())) from error
    return cfg


def _compose(entry: str, overrides: Sequence[str], hydra: bool = False) -> DictConfig:
    typed = as_meant(overrides)
    if GlobalHydra.instance().is_initialized():
        return compose(entry, overrides=typed, return_hydra_config=hydra)
    with initialize_config_module(CONF, version_base="1.3"):
        return compose(entry, overrides=typed, return_hydra_config=hydra)


# Nodes of classes with settings: by name, and single ones. What others refer to comes first.
NODES = (
    *("reward.terms", "agent.surrogates", "agent.regularizers"),
    *(f"scenario.{name}" for name in ("start", "pieces", "controllers", "filters")),
)
SINGLE = ("observation", "deployed")


def complete(cfg: DictConfig) -> None:
    """Check the settings of classes with :class:`Settings`, and write their defaults beside them.

    Raises:
        ConfigError: naming a setting that is unknown or wrong, or a node without a class.
    """
    for group in NODES:
        nodes = OmegaConf.select(cfg, group)
        for name in nodes or ():
            if OmegaConf.is_missing(nodes, name):
                raise ConfigError(f"{group}.{name} is required: say {group}.{name}=…")
            node = nodes[name]
            if OmegaConf.is_dict(node) and TARGET not in node:
                known = [key for key in nodes if TARGET in (nodes[key] or ())]
                raise unknown_name(f"setting of {group}", str(name), map(str, known))
            _complete(node, f"{group}.{name}")
    for name in SINGLE:
        _complete(OmegaConf.select(cfg, name), name)


def _complete(node: Any, where: str) -> None:
    """Complete one node, if it is one, and those in it."""
    if not OmegaConf.is_dict(node) or TARGET not in node:
        return
    try:
        kind = find_target(str(node[TARGET]), where)
    except ConfigError:  # said where it is built
        return
    if inspect.isclass(kind) and issubclass(kind, Settings):
        for key in node:
            if not OmegaConf.is_interpolation(node, key):
                _complete(node[key], f"{where}.{key}")
        settled = values(_made(plain(node), where, {}))
        with open_dict(node):
            node.update({k: v for k, v in settled.items() if k not in node})


def leave_out_foreign(cfg: DictConfig, overrides: Sequence[str]) -> None:
    """Leave out settings of a class that was replaced on the command line by another one.

    After ``scenario.controllers.automated._target_=mine.Rule`` the settings that the file gives
    for its own class stay where the new one has them, too; what was typed always stays.
    A recipe's agent settings are dropped when nothing is learned.
    """
    if OmegaConf.is_dict(cfg.get("agent")) and TARGET not in cfg.agent:
        cfg.agent = None
    typed = set()
    for item in overrides:
        key, _, value = item.lstrip("+~").partition("=")
        inside = re.findall(r"(\w+)\s*:", value) if value.startswith("{") else []
        typed |= {key, *(f"{key}.{name}" for name in inside)}
    for place in (key.removesuffix(f".{TARGET}") for key in typed if key.endswith(f".{TARGET}")):
        node = OmegaConf.select(cfg, place)
        if not isinstance(node, DictConfig) or TARGET not in node:
            continue
        try:
            target = find_target(str(node[TARGET]), place)
            known = parameters_of(getattr(target, "Settings", target), place).values()
        except ConfigError:  # said where it is built
            continue
        if any(parameter.kind is parameter.VAR_KEYWORD for parameter in known):
            continue
        names = {parameter.name for parameter in known}
        for key in [str(key) for key in node if not str(key).startswith("_")]:
            if key not in names and f"{place}.{key}" not in typed:
                with open_dict(node):
                    node.pop(key)


def is_sweep() -> bool:
    """Whether this process does a run of a sweep; False outside Hydra, too."""
    return HydraConfig.initialized() and HydraConfig.get().mode is RunMode.MULTIRUN


def explained(error: Exception, entry: str, overrides: Sequence[str]) -> Exception:
    """Return a clearer error for what Hydra refused, naming the nearest option that exists."""
    renamed = renamed_option(overrides)
    if renamed is not None:
        return renamed
    if not isinstance(error, (HydraException, OmegaConfBaseException)):
        return ConfigError(f"{_culprit(entry, overrides)}: {error}")
    key = refused_key(error)
    hydra = key is not None and key.startswith("hydra.")
    # What exists may depend on the other overrides: leave out only those that fail.
    kept, wrong = list(overrides), key
    while True:
        fewer = [item for item in kept if wrong and wrong not in item]
        try:
            return explain(error, _compose(entry, fewer, hydra))
        except Exception as next_error:
            if not refused_by_hydra(next_error):
                raise
            if len(fewer) in (0, len(kept)):  # nobody typed the key that was refused
                return error
            kept, wrong = fewer, refused_key(next_error)


def _culprit(entry: str, overrides: Sequence[str]) -> str:
    """Return the override without which a configuration can be composed; all where none is."""
    for place, item in enumerate(overrides):
        with suppress(Exception):
            _compose(entry, [*overrides[:place], *overrides[place + 1 :]])
            return item
    return " ".join(overrides)


def build(
    node: Any, where: str, world: Any = None, name: str | None = None, **resources: Any
) -> Any:
    """Construct the object that a configuration node describes.

    The keys of the node are the settings of its ``_target_``, or its arguments; arguments that
    the node does not give are taken from ``resources`` where the names match, else the
    constructor's defaults stand. Nested nodes are built first, in the same way.

    Args:
        node: a mapping with ``_target_``.
        where: the node's place in the configuration, for messages.
        world: the :class:`lcc_rl.pieces.world.World` that a part of an environment is put into.
        name: the name that it has there.
        **resources: what the caller has to offer a constructor: population, time_step …

    Raises:
        ConfigError: if the target is unknown, a key is none of its arguments, one is missing, or
            a value has the wrong type or is no finite number.
    """
    settings: Any = (
        OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
    )
    if not isinstance(settings, Mapping) or TARGET not in settings:
        without = f"; to leave it out, say ~{where}" if settings is None else ""
        raise ConfigError(f"{where}: expected a node with {TARGET}, got {settings!r}{without}")
    check_numbers(settings, where)
    made = _made(settings, where, resources)
    if world is None or not isinstance(made, Settings) or not hasattr(made, "bind"):
        return made
    try:
        return made.bind(world, name)
    except (LccError, OSError):
        raise
    except Exception as error:  # whatever a class of the user's own raises
        raise _not_built(where, type(made), error) from error


def _made(settings: Mapping[str, Any], where: str, resources: dict[str, Any]) -> Any:
    """Construct what plain settings describe, and what is nested in them."""
    target = find_target(str(settings[TARGET]), where)
    given = {key: value for key, value in settings.items() if not key.startswith("_")}
    for key, value in given.items():
        if value == "???":
            raise ConfigError(f"{where}.{key} is required: say {where}.{key}=…")
        if isinstance(value, Mapping) and TARGET in value:
            given[key] = build(value, f"{where}.{key}", **resources)
    if inspect.isclass(target) and issubclass(target, Settings):
        return parse(target, given, where)
    own = getattr(target, "Settings", None)
    if own is None:
        return _construct(target, given, where, resources)
    # A class with a dataclass of settings: the node's keys are its fields.
    settled = _construct(own, given, where, {})
    return _construct(target, {}, where, {**resources, "settings": settled})


def _not_built(where: str, target: Any, error: Exception) -> ConfigError:
    called = getattr(target, "__name__", str(target))
    return ConfigError(f"{where}: {called} cannot be built: {type(error).__name__}: {error}")


def build_as(
    kind: str, needed: type | Sequence[str], node: Any, where: str, **resources: Any
) -> Any:
    """Construct an object of a certain kind, see :func:`build`.

    Args:
        kind: what it has to be, in words.
        needed: its class, or the methods and attributes that make it one.

    Raises:
        ConfigError: if the node describes something else.
    """
    made = build(node, where, **resources)
    fits = isinstance(made, needed) if isinstance(needed, type) else None
    if fits is None:
        fits = all(hasattr(made, name) for name in typing.cast(Sequence[str], needed))
    require(fits, f"{where}: expected {kind}, got {type(made).__name__} ({node[TARGET]})")
    return made


def _construct(target: Any, given: dict[str, Any], where: str, resources: dict[str, Any]) -> Any:
    """Call a class or function with the arguments that a node gives and, else, the resources."""
    called = getattr(target, "__name__", str(target))
    signature = parameters_of(target, where)
    takes_any = any(p.kind is p.VAR_KEYWORD for p in signature.values())
    for key in given:
        if key not in signature and not takes_any:
            own = set(signature) - set(resources) - INTERNAL
            raise unknown_name(f"setting of {where} ({called})", key, own)
    offered = {k: v for k, v in resources.items() if k in signature and k not in given}
    check_types(target, given, where)
    required = {k for k, p in signature.items() if p.default is p.empty and p.kind not in (2, 4)}
    missing = sorted(required - set(given) - set(offered))
    if missing:
        raise ConfigError(f"{where}: missing {', '.join(missing)} of {called}")
    try:
        return target(**given, **offered)
    except (LccError, OSError):  # of a file: its name says more than the node's
        raise
    except Exception as error:  # whatever a constructor of the user's own raises
        raise _not_built(where, target, error) from error


def short_name(target: object) -> str:
    """Return what tables call the class that a ``_target_`` names: ``ddpg`` of the agent DDPG."""
    return str(target).rpartition(".")[2].lower()


# Arguments of the pieces' base classes, which no configuration sets.
INTERNAL = {"reads", "writes", "constants", "reset_options"}


def plain(config: Any) -> dict[str, Any]:
    """Return a configuration as plain, resolved containers; what is missing stays ``"???"``."""
    node = config if OmegaConf.is_config(config) else OmegaConf.create(config)
    return typing.cast(dict[str, Any], OmegaConf.to_container(node, resolve=True))


def config_hash(config: Any) -> str:
    """Return a short hash of what a configuration says, independent of the order of its keys."""
    text = json.dumps(plain(config), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def identity(cfg: DictConfig) -> str:
    """Return the hash of everything in a configuration that determines the results."""
    content = plain(cfg)
    forget_places(content)
    for key in NOT_IDENTITY:
        *path, last = key.split(".")
        node = content
        for part in path:
            node = node.get(part) or {}
        node.pop(last, None)
    if content.get("policy") is None:  # some entry points have no such setting
        content.pop("policy", None)
    return config_hash(content)


def require(condition: bool, message: str) -> None:
    """Raise a ConfigError with the message unless the condition holds."""
    if not condition:
        raise ConfigError(message)
