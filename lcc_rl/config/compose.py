"""Composes configurations by Hydra and parses them once into typed trees."""

from __future__ import annotations

import hashlib
import json
import logging
import re
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from copy import deepcopy
from functools import cache, lru_cache
from importlib.resources import files
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from itertools import combinations
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
from lcc_rl.config.schemas import AUTO, KINDS, SECTIONS, TrainingConfig, parse_config
from lcc_rl.config.unused import check_used, refuse
from lcc_rl.config.words import key_of, typed_keys
from lcc_rl.errors import ConfigError, how_to_install, require, require_known, unknown_name
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, parse_string
from lcc_rl.settings import TARGET, find_target

log = logging.getLogger("lcc_rl")

CONF = "lcc_rl.conf"
# Settings that change no row of a result.
NOT_IDENTITY = (
    *("resume", "jobs", "sweep", "logger", "trust", "figure_formats", "table", "unit"),
    "training.keep_every",
)
# Extras that install launchers.
EXTRAS = {"joblib": "sweeps", "submitit_local": "sweeps", "submitit_slurm": "sweeps", "ray": "ray"}
NEEDED = ("data", "split", "drivers", "observation", "calibration")  # required nodes of commands
# Text with =, alone, in a list or behind a name.
NAMED = re.compile(r"(?:(?<=[\[,])|(?<=: )|^)( *)((?:(?!: )[^\[\],{}])*=[^\[\],{}]*)")
# Hint on Hydra's keys, which have no quotes.
NAMES_HINT = (
    "; names before a colon consist of letters, digits, spaces and _-+./%*@?|, begin with a letter "
    "and have no quotes; lcc_rl.compare accepts any name"
)
OPTIONAL = ("learning", "surrogates")  # groups that Hydra lets choose a missing file
# Groups that no file of the package chooses.
ADDED = ("event", "faults", "filter", "fleet", "knowledge", "slope")
OF_NODE = re.compile(r"([\w.: ]+): expected a node with .*, got (?:'(\w+)'|{.*)$")
WITHOUT_TARGET = re.compile(r"scenario\.pieces: unknown name '(\w+)', which has no ")
OWN_FILES = re.compile(r"path=(?!pkg://|structured://)")  # in Hydra's search path
HYDRA_ERRORS = (HydraException, OmegaConfBaseException)


def find_conf() -> None:
    """Make :data:`CONF` importable if a clone hides the installed package."""
    cloned = Path(__file__).parents[2] / "conf" / "__init__.py"
    if find_spec(CONF) is None and cloned.is_file():
        spec: Any = spec_from_file_location(CONF, cloned)
        sys.modules[CONF] = module = module_from_spec(spec)
        spec.loader.exec_module(module)


def conf_folder() -> Path:
    """Return the folder of the package's configuration files."""
    return Path(str(files(CONF)))


def terms_of_energy(string: Any) -> float:
    """Return how many vehicles count in the energy of an automated one: itself and those behind."""
    plain = OmegaConf.to_container(string) if OmegaConf.is_config(string) else string
    roles = parse_string(plain)
    return 1.0 + roles.count(HUMAN) / max(roles.count(AUTOMATED), 1)


find_conf()
OmegaConf.register_new_resolver("lcc.either", lambda so, yes, no: yes if so else no, replace=True)
OmegaConf.register_new_resolver("lcc.sum", lambda *values: sum(values), replace=True)
OmegaConf.register_new_resolver("lcc.pairs", lambda a, b: len(a) * len(b), replace=True)
OmegaConf.register_new_resolver("lcc.energies", terms_of_energy, replace=True)


def load(entry: str, overrides: Sequence[str] = ()) -> Any:
    """Compose a configuration in Python as the command line does.

    Args:
        entry: ``"train"``, ``"evaluate"``, ``"calibrate"`` or ``"pipeline"``.
        overrides: the words after the command.

    Returns:
        The typed tree, see :mod:`lcc_rl.config.schemas`.

    Raises:
        ConfigError: if an override is unknown, of the wrong type or out of range.
    """
    require_known("command", entry, KINDS)
    if isinstance(overrides, str) or not all(isinstance(word, str) for word in overrides):
        raise ConfigError(f"expected a list of settings, such as ['seed=1'], got {overrides!r}")
    return parsed(composed(entry, overrides), entry, overrides)


def composed(entry: str | None, overrides: Sequence[str] = ()) -> DictConfig:
    """Return the configuration that Hydra composes; without an entry point, of the choices only."""
    hydra, meant = GlobalHydra.instance(), as_meant(overrides)
    try:
        where = str(hydra.config_loader().get_search_path()) if hydra.is_initialized() else ""
        chosen = tuple(filter(_is_choice, meant))
        user_files = OWN_FILES.search(where) or any("searchpath" in word for word in chosen)
        compose = _composed.__wrapped__ if user_files else _composed  # own files change
        cfg = deepcopy(compose(entry, chosen, where))
        read = OverridesParser.create().parse_overrides([x for x in meant if not _is_choice(x)])
        ConfigLoaderImpl.validate_sweep_overrides_legal(read, RunMode.RUN, from_shell=False)
        ConfigLoaderImpl._apply_overrides_to_config(read, cfg)
        return cfg
    except (*HYDRA_ERRORS, ValueError, TypeError) as error:  # Hydra raises some plain ones
        raise explained(error, overrides) from None


@lru_cache(maxsize=512)  # Hydra takes 0.1 s to read and merge the files, settings a hundredth
def _composed(entry: str | None, chosen: tuple[str, ...], where: str) -> DictConfig:
    """Compose files; ``where`` is Hydra's search path, empty if Hydra is not initialised."""
    with nullcontext() if where else initialize_config_module(CONF, version_base="1.3"):
        return compose(entry, overrides=list(chosen))


def as_meant(overrides: Sequence[str]) -> list[str]:
    """Return overrides in the form for Hydra; a list of choices of a group with one is refused.

    Hydra accepts only settings of a file, so ``++`` is added; the typed tree checks names. Names of
    variants, which papers write in capitals, are converted to lower case.

    Examples:
        >>> as_meant(["variant=ALCC,HCFS", "reward.terms.safety.margin=0", "agent=td3"])
        ['variant=alcc,hcfs', '++reward.terms.safety.margin=0', 'agent=td3']
        >>> as_meant(["compare=[idm,outputs/seed=0_1f]"])
        ['++compare=[idm,"outputs/seed=0_1f"]']
        >>> as_meant(["compare={a: outputs/seed=0, b: idm}"])
        ['++compare={a: "outputs/seed=0", b: idm}']
        >>> as_meant(["compare=['a=1,b=2_1f']"])
        ["++compare=['a=1,b=2_1f']"]
    """
    converted = []
    for item in overrides:
        key, equals, value = item.partition("=")
        group = key.lstrip("+").partition("@")[0]
        single = group not in (*ADDED, "experiment") and (conf_folder() / group).is_dir()
        if single and re.match(r"\[.+,", value):
            raise ConfigError(
                f"{item}: {group} takes one choice; for a run of each: -m {key}={value.strip('[]')}"
            )
        if group == "experiment" and value.startswith("["):
            check_recipes(item, [name.strip() for name in value.strip("[]").split(",")])
        if key.lstrip("+") in ("variant", "variants"):
            converted.append(f"{key}{equals}{value.lower()}")
        elif key in ("compare", "policy", "resume"):  # folders of a sweep: seed=0_…
            quoted = "'" in value or '"' in value
            meant = value if quoted else NAMED.sub(r'\1"\2"', value)
            converted.append(f"++{key}{equals}{meant}")
        else:
            setting = key.partition(".")[0] in _top_level() and not _is_choice(item)
            converted.append(f"++{item}" if equals and setting else item)
    return converted


def check_recipes(word: str, names: Sequence[str]) -> None:
    """Refuse a recipe after one that is built on it, of which Hydra makes a mixture of both."""
    for name, other in combinations(names, 2):
        message = (
            f"{word}: {name} is built on {other}: choose one, and single settings of the other"
        )
        require(other not in _built_on(name), message)


def check_optional(word: str) -> None:
    """Refuse an unknown choice of a group whose file may be missing, which Hydra passes over."""
    group, names = key_of(word).partition("@")[0], word.partition("=")[2].strip("[]")
    for name in names.split(",") if names and group in OPTIONAL and "${" not in names else ():
        if name.strip() not in (known := choices(group)):
            raise unknown_choice(group, name.strip(), known)


def unknown_choice(group: str, name: str, options: Sequence[str]) -> ConfigError:
    """Return the error for a choice that no file of a group has."""
    return ConfigError(
        f"{unknown_name(f'choice of {group}', name, options)} {own_file(group, name)}"
    )


def _built_on(recipe: str) -> set[str]:
    """Return the shipped recipes that a shipped recipe is built on."""
    path = conf_folder() / "experiment" / f"{recipe}.yaml"
    content: Any = OmegaConf.load(path) if path.is_file() else {}
    names = {name for name in content.get("defaults", ()) if isinstance(name, str)}
    return names.union(*map(_built_on, names))


def _is_choice(override: str) -> bool:
    """Whether an override chooses files or sets Hydra's own settings; others are applied later."""
    key, _, value = override.lstrip("+~").partition("=")
    group = key.partition("@")[0]
    return "/" in group or group.startswith("hydra") or (value[:1] != "{" and bool(choices(group)))


def choices(group: str) -> list[str]:
    """Return the names of a group's files, including those of ``--config-dir``."""
    if GlobalHydra.instance().is_initialized():
        loader: Any = GlobalHydra.instance().config_loader()
        return list(loader.repository.get_group_options(group))  # its own copies all, for 4 ms
    return shipped_files(group)


def shipped_files(group: str) -> list[str]:
    """Return the names of a group's files in the package."""
    return sorted(path.stem for path in conf_folder().joinpath(group).glob("*.yaml"))


@cache
def _top_level() -> frozenset[str]:
    return frozenset(name for kind in KINDS.values() for name in kind.__dataclass_fields__)


def parsed(cfg: DictConfig, entry: str, overrides: Sequence[str] = (), sweep: bool = False) -> Any:
    """Return the typed tree of a composed configuration.

    Args:
        cfg: the composed configuration.
        entry: the command.
        overrides: the words after the command.
        sweep: allow settings that this run does not use, because the runs of a sweep share them.
    """
    for item in overrides:
        require(not item.endswith(f"={MISSING}"), f"{item.removeprefix('++')}: expected a value")
        check_optional(item)
    try:
        # Settings may refer to defaults of classes.
        written = OmegaConf.to_container(cfg, resolve=False)
        complete = OmegaConf.create(with_defaults(written))
        content: Any = OmegaConf.to_container(complete, resolve=True)
    except InterpolationKeyError as error:
        missing = re.search("'[^']+'", str(error))
        raise ConfigError(
            f"{error.full_key} takes its value from {missing and missing.group()}, which does not "
            "exist: do variant, task, scenario and reward fit each other?"
        ) from None
    except OmegaConfBaseException as error:  # a circular reference
        raise ConfigError(" ".join(str(error).split())) from None
    if "agent" in content and not _learns(content):
        content["agent"] = None
    leave_out_foreign(content, overrides)
    leave_out_terms(content.get("reward"), () if sweep else overrides)
    if "inputs" in content:
        raise ConfigError("inputs: runs record the files that they read; remove the setting")
    try:
        tree = parse_config(content, KINDS[entry])
    except ConfigError as error:  # another choice of the group may have the setting
        if (found := OF_NODE.match(str(error))) and (hint := _file_of(*found.groups())):
            raise ConfigError(f"{error}; {hint}") from None
        if (found := WITHOUT_TARGET.match(str(error))) and found[1] in choices("knowledge"):
            text = f"+knowledge={found[1]} adds it, knowledge=[…,{found[1]}] beside a task's"
            raise ConfigError(f"{error}; {text}") from None
        if TARGET not in (content.get("deployed") or (TARGET,)):
            refuse(overrides, {"deployed.": "it belongs to variant=hcfs"})
        key = re.match(rf"unknown setting of {re.escape(AUTO)} \(\w+\) '(\w+)'", str(error))
        after = (content.get("deployed") or {}).get(TARGET)  # the controller after training
        if key and after and key[1] in (settings_of(find_target(after, "deployed")) or ()):
            raise ConfigError(f"{error} It is deployed.{key[1]}.") from None
        key = re.match(r"([\w.]+) must ", str(error))
        if key and key[1] not in set().union(*map(typed_keys, overrides)):
            typed = " ".join(overrides).replace("++", "") or "the files"
            raise ConfigError(f"{error}; it follows from {typed}: do these fit?") from None
        match = re.match(r"unknown setting of (\w+) \(", str(error))
        group = match.group(1) if match else ""
        if not group or not choices(group):
            raise
        raise ConfigError(f"{error} Other choices: {group}={'|'.join(choices(group))}") from None
    for name in NEEDED:
        if getattr(tree, name, TARGET) is None:
            raise ConfigError(f"{name}: expected a node with {TARGET}, got None")
    check_used(tree, overrides, sweep, written)
    if entry == "train" and tree.learns:
        _report_rounded(content["training"]["episodes"], tree.training)
    return with_inputs(tree)


def _report_rounded(asked: Any, training: TrainingConfig) -> None:
    """Warn if a training has more episodes than asked for."""
    if training.episodes != float(asked):
        text = "training.episodes=%s is rounded up to %d, whole batches of %d environments"
        log.warning(text, asked, training.episodes, training.environments)


def with_inputs(cfg: Any) -> Any:
    """Return a configuration with the present hashes of its input files."""
    return cfg.with_(inputs=inputs_of(as_plain(cfg)))


def _learns(content: Mapping[str, Any]) -> bool:
    """Whether there is an agent, and a controller that executes its actions."""
    agent, scenario = content.get("agent"), content.get("scenario", {})
    if not isinstance(agent, dict) or TARGET not in agent:  # a recipe's settings without an agent
        return False
    if "string" in scenario and not parse_string(scenario["string"]).count(AUTOMATED):
        return False
    driver = scenario.get("controllers", {})
    if not isinstance(driver, Mapping) or AUTOMATED not in driver:
        return True
    return takes_action(as_nodes(driver[AUTOMATED], AUTO))


def leave_out_terms(reward: Any, overrides: Sequence[str] = ()) -> None:
    """Remove the terms of ``reward.without``, which a sweep can vary, from a reward.

    Args:
        reward: the section as plain containers, changed in place.
        overrides: overrides of the command line, of which none may set a removed term.

    Raises:
        ConfigError: naming a term that the reward lacks, or an override.
    """
    given = reward.pop("without", None) if isinstance(reward, dict) else None
    names = [given] if isinstance(given, str) else given or []
    if names:
        terms = reward.get("terms") or {}
        require_known("term of the reward in reward.without", names, terms)
        reward["terms"] = {name: term for name, term in terms.items() if name not in names}
    why = "reward.without leaves the term out"
    refuse(overrides, {f"reward.terms.{name}": why for name in names})


def leave_out_foreign(content: dict[str, Any], overrides: Sequence[str]) -> None:
    """Remove settings of classes that the command line replaces.

    After ``scenario.controllers.automated._target_=mine.Rule`` the file's settings of the former
    class are kept if the new class has them; those of the command line are always kept.

    Args:
        content: a configuration as plain containers, changed in place.
        overrides: overrides of the command line.
    """
    typed = set().union(*map(typed_keys, overrides))
    for path in (key.removesuffix(f".{TARGET}") for key in typed if key.endswith(f".{TARGET}")):
        node: Any = content
        for step in path.split("."):
            node = node.get(step) if isinstance(node, dict) else None
        if not isinstance(node, dict) or TARGET not in node:
            continue
        names = settings_of(find_target(str(node[TARGET]), path))
        for key in [key for key in node if names is not None and key != TARGET]:
            if key not in (names or ()) and f"{path}.{key}" not in typed:
                del node[key]


def is_sweep() -> bool:
    """Whether this process executes a run of a sweep; False outside Hydra."""
    return HydraConfig.initialized() and HydraConfig.get().mode is RunMode.MULTIRUN


def explained(error: Exception, overrides: Sequence[str] = ()) -> ConfigError:
    """Return an error of Hydra in one line, with the nearest choice."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        if group == "hydra/launcher" and name in EXTRAS:
            return ConfigError(f"{group}/{name} is not installed: {how_to_install(EXTRAS[name])}")
        options = error.options or ()
        if not group:
            return unknown_name("option", name, options)
        return unknown_choice(group, name, options)
    if isinstance(error, OverrideParseException):
        key, equals, value = str(error.override).lstrip("+").partition("=")
        if not equals or key.startswith("-"):
            return ConfigError(f"{key}: settings are written key=value; -h shows the help")
        typed = next((word for word in overrides if key_of(word) == key), f"{key}={value}")
        names = NAMES_HINT if key == "compare" and "{" in value else ""
        return ConfigError(
            f"{typed}: cannot be read as a setting. Brackets must be closed, and text "
            f"with spaces, commas or signs needs quotes within quotes: \"{key}='…'\"{names}"
        )
    match = re.search(
        r"Could not (override|append to config|delete from config)\S* '([^']+)'", str(error)
    )
    if match is not None and match.group(1).startswith("delete"):
        return ConfigError(f"~{match.group(2)}: no file sets it: there is nothing to leave out")
    if match is not None:
        return _unknown_option(match.group(2))
    if match := re.search(r"Ambiguous value for argument '\+*([^']+?)=([^']+)'", str(error)):
        key, value = match.groups()
        return ConfigError(
            f"{key}={value}: several values are runs of a sweep, -m; a list is {key}=[{value}]"
        )
    if found := re.match(r"(?:Multiple values for )?(\w+)\S* (?:To over|appears more)", str(error)):
        group = found.group(1)
        pairs = [word.partition("=")[::2] for word in overrides]
        several = dict.fromkeys(value.strip("[]") for key, value in pairs if key == f"+{group}")
        remedy = "leave one out, or write it without +"
        if group in ADDED and len(several) > 1:
            remedy = f"a list takes several, '+{group}=[{','.join(several)}]'"
        return ConfigError(f"{' '.join(overrides)}: {group} is chosen twice: {remedy}")
    gone = next((word for word in overrides if word.startswith("~")), "")
    if gone and "Error resolving interpolation" in str(error):
        return ConfigError(f"{gone}: other choices depend on it; write {gone[1:]}=null")
    cause = error.__cause__
    text = f"{error}: {cause}" if isinstance(error, HydraException) and cause else str(error)
    tokens = [*overrides, *text.partition("See https://")[0].split()]
    return ConfigError(" ".join(tokens))


def _groups() -> set[str]:
    folder = conf_folder()
    return {path.parts[len(folder.parts)] for path in folder.glob("*/**/*.yaml")}


def _file_of(key: str, name: str | None) -> str:
    """Return how a file of a group is chosen for a node, if there is one of this name."""
    if name is None:  # settings without a choice
        return f"choose one, too: {key}={'|'.join(choices(key))}" if choices(key) else ""
    group = next((group for group in sorted(_groups()) if name in choices(group)), "")
    choice = f"{group}@{key.replace(': ', '.')}={name}"
    choice = f"+{group}={name}" if group in ADDED else f"{choice}, or +{choice}"
    return f"the file of {group} is chosen by {choice}" if group else ""


def _unknown_option(name: str) -> ConfigError:
    """Return the error for an unknown option, with its section if there is one."""
    places = {key: at for at, kind in SECTIONS.items() for key in settings_of(kind) or ()}
    root, names = name.partition(".")[0], _top_level() | _groups()
    if root in places:
        return ConfigError(f"unknown option {name!r}: it is {places[root]}.{name}")
    if root in ADDED:
        return ConfigError(f"{root} is added: write +{root}=…")
    if root in names:
        return ConfigError(f"this command has no option {root!r}, as others have: -h shows its own")
    error = unknown_name("option", name, names)
    return ConfigError(f"{error}; hydra.run.dir=… sets the folder") if root == "out" else error


def check_own_files() -> None:
    """Refuse files of ``--config-dir`` with the name of a file of the package, which Hydra ignores.

    Raises:
        ConfigError: naming the file.
    """
    for source in HydraConfig.get().runtime.config_sources:
        folder = Path(source.path)
        for path in folder.rglob("*.yaml") if source.provider == "command-line" else ():
            if (conf_folder() / path.relative_to(folder)).is_file():
                raise ConfigError(f"{path}: the package has a file of this name: choose another")


def own_file(group: str, name: str) -> str:
    """Return a hint on user's files."""
    return f"A file of your own, {group}/{name}.yaml, needs --config-dir <its folder>."


def config_hash(content: Any) -> str:
    """Return a short hash of plain settings, independent of the order of their keys."""
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def identity(cfg: Any, *unused: str) -> str:
    """Return the hash of everything in a configuration that determines the results.

    Defaults of classes do not count, so settings of later versions change no hash.

    Args:
        cfg: a typed tree.
        *unused: keys of further settings that do not count.
    """
    content = without_defaults(cfg)
    for key in (*NOT_IDENTITY, *unused):
        *path, last = key.split(".")
        node = content
        for name in path:
            node = node.get(name) or {}
        node.pop(last, None)
    return config_hash(content)
