"""What a stored configuration may name: code of this package, and no place to write."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.nodes import TARGET, find_target, forget_places, settings_at
from lcc_rl.schemas import parse_config

# Packages whose classes a stored configuration may name, and the one whose functions it may.
ROOMS = "agents data drivers energy evaluation functional pieces runs.loggers synthetic"
REGISTRY = tuple(f"lcc_rl.{room}" for room in ROOMS.split())
FUNCTIONS = "lcc_rl.drivers.population"


def trusted(
    content: dict[str, Any], where: str, trust: Sequence[str] = ()
) -> tuple[Any, list[str]]:
    """Return a stored configuration that can be built without harm.

    Args:
        content: the configuration as plain containers.
        where: the file it comes from, for messages.
        trust: modules outside this package that it may name.

    Returns:
        The configuration, in which nothing names a place to write and nothing is trusted but
        ``trust``; and what named a place, as ``key=value``.

    Raises:
        ResultsError: naming the key at fault.
    """
    for key, _, value in settings_at(content):
        if isinstance(value, str) and "${" in value:
            raise ResultsError(f"{where}: {key} refers to {value!r}; expected plain values")
    check_targets(content, where, trust)
    places = forget_places(content)
    if "trust" in content:
        content["trust"] = list(trust)
    try:
        return parse_config(content), places
    except ConfigError as error:
        raise ResultsError(f"{where}: not the configuration of a run: {error}") from error


def check_targets(content: Mapping[str, Any], where: str, trust: Sequence[str] = ()) -> None:
    """Check that a stored configuration names no code outside :data:`REGISTRY`.

    Building a node of it imports and calls what it names.

    Args:
        content: the configuration as plain containers.
        where: the file it comes from, for the message.
        trust: further modules that may be named, e.g. ``["mine"]``.

    Raises:
        ResultsError: naming the target, or a reference instead of a value.
    """
    for key, _, value in settings_at(content):
        if key.rpartition(".")[2] == TARGET and not is_registered(str(value), where, trust):
            module = str(value).rpartition(".")[0]
            raise ResultsError(
                f"{where}: {key} names {value!r}, which is not part of lcc_rl; if you trust it, "
                f"say trust=[{module}] (of lcc-rl export: --trust {module})"
            )


def is_registered(target: str, where: str, trust: Sequence[str] = ()) -> bool:
    """Whether a target is defined in :data:`REGISTRY` or in a trusted module.

    Functions of the registry may write files; only those that make a population may be named.

    Raises:
        ResultsError: if a module of the registry has no such target.
    """
    module = target.rpartition(".")[0]
    if module in trust:
        return True
    if not _within_registry(module):
        return False
    # A module also holds what it imports, such as import_module.
    try:
        found = find_target(target, where)
    except ConfigError as error:
        raise ResultsError(f"{error}; of another release, or damaged") from error
    home = str(getattr(found, "__module__", ""))
    return _within_registry(home) and (inspect.isclass(found) or home == FUNCTIONS)


def _within_registry(module: str) -> bool:
    return any(module == room or module.startswith(f"{room}.") for room in REGISTRY)
