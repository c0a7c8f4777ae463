"""Checks of stored configurations: they may name code of this package and no path to write."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lcc_rl.config.nodes import as_plain, settings_at, with_defaults
from lcc_rl.config.schemas import parse_config
from lcc_rl.config.words import DOTTED, FILTERED, YAML, module_named
from lcc_rl.errors import ConfigError, ResultsError, raised_as
from lcc_rl.io.settings import parse_yaml, read_text
from lcc_rl.settings import find_target

# Packages of classes that a stored configuration may name, and the module of functions.
ROOMS = "agents data drivers energy evaluation functional pieces runs.loggers synthetic"
REGISTRY = tuple(f"lcc_rl.{room}" for room in ROOMS.split())
FUNCTIONS = "lcc_rl.drivers.population"
LOGS = "logger.where"  # the setting that names a path to write to
RETIRED = ("objective",)  # removed settings that changed no row


def trusted(content: dict[str, Any], where: str, trust: Sequence[str]) -> tuple[Any, list[str]]:
    """Return a stored configuration that can be built safely.

    Args:
        content: the configuration as plain containers.
        where: its file, for messages.
        trust: modules outside this package that it may name.

    Returns:
        The configuration, without paths to write to and with ``trust`` only; and the removed paths
        as ``key=value``.

    Raises:
        ResultsError: naming the wrong key.
    """
    for key, _, value in settings_at(content):
        if isinstance(value, str) and "${" in value:
            raise ResultsError(f"{where}: {key} refers to {value!r}; expected plain values")
    check_targets(content, where, trust)
    content = {key: value for key, value in content.items() if key not in RETIRED}
    if "trust" in content:
        content["trust"] = list(trust)
    removed, logger = [], content.get("logger")
    if isinstance(logger, Mapping) and logger.get("where") is not None:
        content["logger"], removed = {**logger, "where": None}, [f"{LOGS}={logger['where']}"]
    with raised_as(ResultsError, f"{where}: not the configuration of a run", ConfigError):
        return parse_config(with_defaults(content)), removed


def check_targets(content: Mapping[str, Any], where: str, trust: Sequence[str]) -> None:
    """Check that a stored configuration names no code outside :data:`REGISTRY`.

    Building a node imports and calls its class, ``law`` and ``model``, as does a controller in
    ``compare`` by path or file. Functions of the registry may write files; only functions that
    return a population may be named.

    Args:
        content: the configuration as plain containers.
        where: its file, for the message.
        trust: further modules that may be named, e.g. ``["mine"]``.

    Raises:
        ResultsError: naming the target.
    """
    for key, value, module in _named(content):
        if module in trust:
            continue
        try:
            target = find_target(value, where) if _within_registry(module) else None
        except ConfigError as error:
            raise ResultsError(f"{error}; of another release, or damaged") from error
        # A module also contains its imports, such as import_module.
        home = str(getattr(target, "__module__", ""))
        if not _within_registry(home) or not (inspect.isclass(target) or home == FUNCTIONS):
            raise ResultsError(
                f"{where}: {key} names {value!r}, which is no class of lcc_rl that may be stored; "
                f"if you trust it, add trust=[{module}], or --trust {module} to commands with flags"
            )


def _named(content: Any) -> Iterator[tuple[str, str, str]]:
    """Yield key, value and module of all modules, classes and functions that settings name."""
    for key, _, value in settings_at(content):
        single = not isinstance(value, (list, Mapping))
        if single and (module := module_named(key, str(value))):
            yield key, str(value), module
        elif key.partition(".")[0] == "compare" and isinstance(value, str):
            path = Path(value.removesuffix(FILTERED))
            if path.suffix in YAML and path.is_file():
                yield from _named(parse_yaml(read_text(path), str(path)))
            elif DOTTED.fullmatch(str(path)) and not path.exists():
                yield key, str(path), str(path).rpartition(".")[0]


def own_modules(cfg: Any) -> list[str]:
    """Return the modules outside :data:`REGISTRY` in a configuration, sorted."""
    modules = {module for *_, module in _named(as_plain(cfg))}
    return sorted(module for module in modules if not _within_registry(module))


def trust_option(cfg: Any) -> str:
    """Return the option with the modules outside the registry for a command that resumes a run."""
    modules = own_modules(cfg)
    return f" trust=[{','.join(modules)}]" if modules else ""


def _within_registry(module: str) -> bool:
    return any(module == room or module.startswith(f"{room}.") for room in REGISTRY)
