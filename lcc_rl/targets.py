"""What the nodes of a configuration name: classes, functions, and the places they write to."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Any

from lcc_rl.errors import ConfigError

TARGET = "_target_"


def find_target(target: str, where: str) -> Any:
    """Return the class or function that a ``_target_`` names.

    Raises:
        ConfigError: if there is none, or importing its module fails.
    """
    module, _, name = target.rpartition(".")
    try:
        found = getattr(import_module(module), name)
    except Exception as error:  # a module of the user's own may raise anything
        raise ConfigError(f"{where}.{TARGET}: cannot find {target!r}: {error}") from error
    if not callable(found):
        raise ConfigError(f"{where}.{TARGET}: {target!r} is no class or function")
    return found


def parameters_of(target: Any, where: str) -> Mapping[str, inspect.Parameter]:
    """Return the parameters of a class or function.

    Raises:
        ConfigError: if it does not tell, as some builtins.
    """
    try:
        return inspect.signature(target).parameters
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{where}.{TARGET}: cannot be built from settings: {error}") from error


def settings_at(content: Any, where: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield every value in nested mappings and lists: its dotted key, what holds it, and itself."""
    if isinstance(content, (Mapping, list)):
        items = content.items() if isinstance(content, Mapping) else enumerate(content)
        for key, value in items:
            name = f"{where}.{key}" if where else str(key)
            yield name, content, value
            yield from settings_at(value, name)


def forget_places(content: Mapping[str, Any]) -> list[str]:
    """Set every setting that names a place to write to null; a class lists them as ``WRITES``.

    Args:
        content: a configuration as plain containers, changed in place.

    Returns:
        The settings that named one, as ``key=value``.
    """
    found = []
    for key, node, target in list(settings_at(content)):
        if key.rpartition(".")[2] != TARGET:
            continue
        where = key.removesuffix(TARGET)
        try:
            names = getattr(find_target(str(target), where), "WRITES", ())
        except ConfigError:  # said where it is built
            continue
        for name in names:
            if node.get(name) is not None:
                found.append(f"{where}{name}={node[name]}")
                node[name] = None
    return found
