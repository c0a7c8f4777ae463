"""What the nodes of a configuration name: classes, functions, and the places they write to."""

from __future__ import annotations

import dataclasses
import inspect
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from typing import Any

from lcc_rl.errors import ConfigError

TARGET = "_target_"
SIMPLE: dict[Any, tuple[type, ...]] = {float: (float, int), int: (int,), bool: (bool,), str: (str,)}


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


def check_types(target: Any, given: Mapping[str, Any], where: str) -> None:
    """Check numbers, flags and text against the annotations of a constructor.

    Raises:
        ConfigError: naming the setting, what it must be, and what it is.
    """
    function = target
    # The generated constructor of a dataclass does not know the names of its module.
    if inspect.isclass(target) and not dataclasses.is_dataclass(target):
        function = target.__init__
    try:
        hints = typing.get_type_hints(function)
    except (NameError, TypeError):
        return
    for key, value in given.items():
        accepted = _accepted(hints.get(key))
        # bool is an int to Python, but not to a reader of a configuration.
        wrong = isinstance(value, bool) and bool not in accepted
        if accepted and (wrong or not isinstance(value, accepted)):
            wanted = " or ".join(sorted({kind.__name__ for kind in accepted}))
            raise ConfigError(f"{where}.{key} must be {wanted}, got {value!r}")


def _accepted(hint: Any) -> tuple[type, ...]:
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        parts = [_accepted(part) for part in typing.get_args(hint)]
        return tuple(kind for part in parts for kind in part) if all(parts) else ()
    if hint is type(None):
        return (type(None),)
    if typing.get_origin(hint) is Sequence:
        return (list,)
    return SIMPLE.get(hint, ())
