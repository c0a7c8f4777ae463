"""Composes configurations by Hydra and parses them once into typed trees."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from copy import deepcopy
from functools import cache, lru_cache
from importlib.resources import files
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_module
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationKeyError, OmegaConfBaseException

from lcc_rl.config.inputs import inputs_of
from lcc_rl.config.nodes import (
    MISSING,
    as_nodes,
    as_plain,
    settings_of,
    takes_action,
    with_defaults,
    without_defaults,
)
from lcc_rl.config.schemas import AUTO, KINDS, SECTIONS, parse_config
from lcc_rl.config.unused import check_used
from lcc_rl.config.words import key_of
from lcc_rl.errors import ConfigError, how_to_install, unknown_name
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, parse_string
from lcc_rl.settings import TARGET, find_target

CONF = "lcc_rl.conf"
# Settings that do not change any row of a result.
NOT_IDENTITY = (
    *("resume", "jobs", "sweep", "logger", "trust", "figure_formats", "table"),
    "training.keep_every",
)
# Launchers that come with other packages: which extra brings them.
EXTRAS = {"joblib": "sweeps", "submitit_local": "sweeps", "submitit_slurm": "sweeps", "ray": "ray"}
# Settings that came later: without them a run is what it was before.
LATER = ("evaluation.warm_up", "scenario.fleet")
NEEDED = ("data", "split", "drivers", "observation", "calibration")  # of commands that have them
NAMED, QUOTED = re.compile(r"(?:(?<=[\[,])|^)([^\[\],{}]*=[^\[\],{}]*)"), r'"\1"'  # text with =
# Hydra's keys are without quotes.
NAMES_HINT = (
    "; names before a colon have no quotes but letters, digits, spaces and _-+./%*@?|, and begin "
    "with a letter; lcc_rl.compare takes any"
)
HYDRA_ERRORS = (HydraException, OmegaConfBaseException)


def find_conf() -> None:
    """Let a clone that hides the installed package find :data:`CONF`, which lies beside it."""
    beside = Path(__file__).parents[2] / "conf" / "__init__.py"
    if find_spec(CONF) is None and beside.is_file():
        spec: Any = spec_from_file_location(CONF, beside)
        sys.modules[CONF] = module = module_from_spec(spec)
        spec.loader.exec_module(module)


def terms_of_energy(string: Any) -> float:
    """Return how many vehicles' energy counts for an automated one: its own and those behind."""
    plain = OmegaConf.to_container(string) if OmegaConf.is_config(string) else string
    roles = parse_string(plain)
    return 1.0 + roles.count(HUMAN) / max(roles.count(AUTOMATED), 1)


find_conf()
OmegaConf.register_new_resolver("lcc.either", lambda so, yes, no: yes if so else no, replace=True)
OmegaConf.register_new_resolver("lcc.pairs", lambda a, b: len(a) * len(b), replace=True)
OmegaConf.register_new_resolver("lcc.energies", terms_of_energy, replace=True)


def load(entry: str, overrides: Sequence[str] = ()) -> Any:
    """Compose a configuration in Python exactly as the command line would.

    Args:
        entry: ``"train"``, ``"evaluate"``, ``"calibrate"`` or ``"pipeline"``.
        overrides: what one would type after the command.

    Returns:
        The typed tree, see :mod:`lcc_rl.config.schemas`.

    Raises:
        ConfigError: if an override is unknown, of the wrong type or out of range.
    """
    if entry not in KINDS:
        raise unknown_name("command", entry, KINDS)
    if isinstance(overrides, str):
        raise ConfigError(f"expected a list of settings, got the text {overrides!r}")
    return parsed(composed(entry, overrides), entry, overrides)


def composed(entry: str, overrides: Sequence[str] = ()) -> DictConfig:
    """Return what Hydra composes."""
    hydra, meant = GlobalHydra.instance(), as_meant(overrides)
    try:
        where = str(hydra.config_loader().get_search_path()) if hydra.is_initialized() else ""
        made = _composed.__wrapped__ if "command-line" in where else _composed  # own files change
        cfg = deepcopy(made(entry, tuple(filter(_is_choice, meant)), where))
        read = OverridesParser.create().parse_overrides([x for x in meant if not _is_choice(x)])
        ConfigLoaderImpl.validate_sweep_overrides_legal(read, RunMode.RUN, from_shell=False)
        ConfigLoaderImpl._apply_overrides_to_config(read, cfg)
        return cfg
    except (*HYDRA_ERRORS, ValueError, TypeError) as error:  # Hydra raises some as plain ones
        raise explained(error, overrides) from None


@lru_cache(maxsize=512)  # Hydra takes 0.1 s to read and merge the files, settings a hundredth
def _composed(entry: str, chosen: tuple[str, ...], where: str) -> DictConfig:
    """Compose files; ``where`` Hydra looks for them is empty if it has not been initialised."""
    with nullcontext() if where else initialize_config_module(CONF, version_base="1.3"):
        return compose(entry, overrides=list(chosen))


def as_meant(overrides: Sequence[str]) -> list[str]:
    """Return overrides as Hydra has to read them.

    The typed tree knows which settings exist, Hydra only those that stand in a file: it may add
    any. Names of variants, which papers write in capitals, become lower case.

    Examples:
        >>> as_meant(["variant=ALCC,HCFS", "reward.terms.safety.margin=0", "agent=td3"])
        ['variant=alcc,hcfs', '++reward.terms.safety.margin=0', 'agent=td3']
        >>> as_meant(["compare=[idm,outputs/seed=0_1f]"])
        ['++compare=[idm,"outputs/seed=0_1f"]']
        >>> as_meant(["compare=['a=1,b=2_1f']"])
        ["++compare=['a=1,b=2_1f']"]
    """
    found = []
    for item in overrides:
        key, equals, value = item.partition("=")
        if key.lstrip("+") in ("variant", "variants"):
            found.append(f"{key}{equals}{value.lower()}")
        elif key in ("compare", "policy", "resume"):  # a sweep's folders are named seed=0_…
            quoted = "'" in value or '"' in value
            found.append(f"++{key}{equals}{value if quoted else NAMED.sub(QUOTED, value)}")
        else:
            own = key.partition(".")[0] in _top_level() and not _is_choice(item)
            found.append(f"++{item}" if equals and own else item)
    return found


def _is_choice(item: str) -> bool:
    """Whether Hydra reads files for an override, or its own settings; other ones follow on them."""
    key, _, value = item.lstrip("+~").partition("=")
    group = key.partition("@")[0]
    return "/" in group or group.startswith("hydra") or (value[:1] != "{" and bool(choices(group)))


def choices(group: str) -> list[str]:
    """Return the names of a group's files, those of ``--config-dir`` among them."""
    if GlobalHydra.instance().is_initialized():
        loader: Any = GlobalHydra.instance().config_loader()
        return list(loader.repository.get_group_options(group))  # its own copies all, for 4 ms
    return sorted(path.stem for path in Path(str(files(CONF))).joinpath(group).glob("*.yaml"))


@cache
def _groups() -> frozenset[str]:
    folder = Path(str(files(CONF)))
    return frozenset(path.name for path in folder.iterdir() if path.is_dir())


@cache
def _top_level() -> frozenset[str]:
    return frozenset(name for kind in KINDS.values() for name in kind.__dataclass_fields__)


def parsed(cfg: DictConfig, entry: str, overrides: Sequence[str] = (), sweep: bool = False) -> Any:
    """Return the typed tree of a composed configuration.

    Args:
        cfg: what Hydra composed.
        entry: the command.
        overrides: what was typed.
        sweep: the runs of a sweep share what was typed, so a setting that one of them uses may be
            given to another.
    """
    for item in overrides:
        if item.endswith(f"={MISSING}"):
            raise ConfigError(f"{item.removeprefix('++')}: expected a value")
    try:
        # Settings may refer to the default of a class.
        whole = OmegaConf.create(with_defaults(OmegaConf.to_container(cfg, resolve=False)))
        content: Any = OmegaConf.to_container(whole, resolve=True)
    except InterpolationKeyError as error:
        missing = re.search("'[^']+'", str(error))
        raise ConfigError(
            f"{error.full_key} takes its value from {missing and missing.group()}, which is not "
            "there: do variant, task, scenario and reward fit each other?"
        ) from None
    except OmegaConfBaseException as error:  # a reference in a circle
        raise ConfigError(" ".join(str(error).split())) from None
    if "agent" in content and not _learns(content):
        content["agent"] = None
    leave_out_foreign(content, overrides)
    if "inputs" in content:
        raise ConfigError("inputs: a run notes itself which files it reads; remove the setting")
    try:
        tree = parse_config(content, KINDS[entry])
    except ConfigError as error:  # of a class that has no such setting; another choice may
        found = re.match(r"unknown setting of (\w+) \(", str(error))
        group = found.group(1) if found else ""
        if not group or not choices(group):
            raise
        raise ConfigError(f"{error} Other choices: {group}={'|'.join(choices(group))}") from None
    for name in NEEDED:
        if getattr(tree, name, TARGET) is None:
            raise ConfigError(f"{name}: expected a node with {TARGET}, got None")
    check_used(tree, overrides, sweep)
    return with_inputs(tree)


def with_inputs(cfg: Any) -> Any:
    """Note in a configuration which files it reads, as they are now; return it."""
    cfg.inputs = inputs_of(as_plain(cfg))
    return cfg


def _learns(content: Mapping[str, Any]) -> bool:
    """Whether there is an agent, and vehicles whose controller carries out its actions."""
    agent, scenario = content.get("agent"), content.get("scenario", {})
    if not isinstance(agent, dict) or TARGET not in agent:  # a recipe's settings of an agent
        return False
    if "string" in scenario and not parse_string(scenario["string"]).count(AUTOMATED):
        return False
    driver = scenario.get("controllers", {})
    if not isinstance(driver, Mapping) or AUTOMATED not in driver:
        return True
    return takes_action(as_nodes(driver[AUTOMATED], AUTO))


def leave_out_foreign(content: dict[str, Any], overrides: Sequence[str]) -> None:
    """Remove the settings of a class that was replaced on the command line by another one.

    After ``scenario.controllers.automated._target_=mine.Rule`` the settings that a file gives for
    the former class stay if the new one has them, too; what was typed always stays.

    Args:
        content: a configuration as plain containers, changed in place.
        overrides: what was typed.
    """
    typed = set()
    for item in overrides:
        key, _, value = item.lstrip("+~").partition("=")
        inside = re.findall(r"(\w+)\s*:", value) if value.startswith("{") else []
        typed |= {key, *(f"{key}.{name}" for name in inside)}
    for place in (key.removesuffix(f".{TARGET}") for key in typed if key.endswith(f".{TARGET}")):
        node: Any = content
        for part in place.split("."):
            node = node.get(part) if isinstance(node, dict) else None
        if not isinstance(node, dict) or TARGET not in node:
            continue
        known = settings_of(find_target(str(node[TARGET]), place))
        for key in [key for key in node if known is not None and key != TARGET]:
            if key not in (known or ()) and f"{place}.{key}" not in typed:
                del node[key]


def is_sweep() -> bool:
    """Whether this process does a run of a sweep; False outside Hydra, too."""
    return HydraConfig.initialized() and HydraConfig.get().mode is RunMode.MULTIRUN


def explained(error: Exception, overrides: Sequence[str] = ()) -> ConfigError:
    """Return what Hydra refused in one line, with the nearest choice that exists."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        if group == "hydra/launcher" and name in EXTRAS:
            return ConfigError(f"{group}/{name} is not installed: {how_to_install(EXTRAS[name])}")
        known = error.options or ()
        if not group:
            return unknown_name("option", name, known)
        error = unknown_name(f"choice of {group}", name, known)
        return ConfigError(f"{error} {own_file(group, name)}")
    if isinstance(error, OverrideParseException):
        key, equals, value = str(error.override).lstrip("+").partition("=")
        if not equals:
            return ConfigError(f"{key}: settings are written key=value; -h shows the help")
        typed = next((word for word in overrides if key_of(word) == key), f"{key}={value}")
        names = NAMES_HINT if key == "compare" and "{" in value else ""
        return ConfigError(
            f"{typed}: cannot be read as a setting. Brackets must be closed, and text "
            f"with spaces, commas or signs needs quotes within quotes: \"{key}='…'\"{names}"
        )
    found = re.search(
        r"Could not (?:override|append to config|delete from config)\S* '([^']+)'", str(error)
    )
    if found is not None:
        return _unknown_option(found.group(1))
    cause = error.__cause__
    text = f"{error}: {cause}" if isinstance(error, HydraException) and cause else str(error)
    words = [*overrides, *text.partition("See https://")[0].split()]
    return ConfigError(" ".join(words))


def _unknown_option(name: str) -> ConfigError:
    """Return the error for an option that does not exist; many belong into a section."""
    places = {key: at for at, kind in SECTIONS.items() for key in settings_of(kind) or ()}
    root, known = name.partition(".")[0], _top_level() | _groups()
    if root in places:
        return ConfigError(f"unknown option {name!r}: it is {places[root]}.{name}")
    if root in known:
        return ConfigError(f"this command has no option {root!r}, as others have: -h shows its own")
    error = unknown_name("option", name, known)
    return ConfigError(f"{error}; hydra.run.dir=… sets the folder") if root == "out" else error


def check_own_files() -> None:
    """Refuse files of ``--config-dir`` that Hydra passes over: the package's of that name is read.

    Raises:
        ConfigError: naming the file.
    """
    for source in HydraConfig.get().runtime.config_sources:
        folder = Path(source.path)
        for path in folder.rglob("*.yaml") if source.provider == "command-line" else ():
            if files(CONF).joinpath(*path.relative_to(folder).parts).is_file():
                raise ConfigError(f"{path}: the package has a file of this name: choose another")


def own_file(group: str, name: str) -> str:
    """Return what makes a file of the user's own a choice."""
    return f"A file of your own, {group}/{name}.yaml, needs --config-dir <its folder>."


def config_hash(content: Any) -> str:
    """Return a short hash of plain settings, independent of the order of their keys."""
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def identity(cfg: Any, *unused: str, changed: bool = False) -> str:
    """Return the hash of everything in a configuration that determines the results.

    Args:
        cfg: the configuration.
        *unused: further keys of settings that do not.
        changed: only what differs from the defaults of the classes counts.
    """
    content = without_defaults(cfg) if changed else as_plain(cfg, places=False)
    for key in (*NOT_IDENTITY, *unused, *LATER):
        *path, last = key.split(".")
        node = content
        for part in path:
            node = node.get(part) or {}
        if key not in LATER or not node.get(last):
            node.pop(last, None)
    if not any((content.get("inputs") or {}).values()):
        content.pop("inputs", None)
    return config_hash(content)
