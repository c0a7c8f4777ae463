"""Types and numbers of settings: what a constructor's annotations promise, and finite numbers."""

from __future__ import annotations

import dataclasses
import inspect
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lcc_rl.errors import LARGEST, ConfigError

SIMPLE: dict[Any, tuple[type, ...]] = {
    float: (float, int),
    int: (int,),
    bool: (bool,),
    str: (str,),
    Path: (str, Path),
    type(None): (type(None),),
}
NAMES = {type(None): "null", Path: "str"}


def check_numbers(value: Any, where: str) -> None:
    """Refuse numbers that are not finite or too large, in lists and mappings, too.

    Raises:
        ConfigError: naming the setting.
    """
    if isinstance(value, float) and not abs(value) <= LARGEST:
        raise ConfigError(
            f"{where} must be a finite number of size {LARGEST:g} at most, got {value}"
        )
    if isinstance(value, int) and not abs(value) < 2**63:
        raise ConfigError(f"{where} must be a number of 63 bits, got one of {value.bit_length()}")
    if isinstance(value, Mapping):
        for key, item in value.items():
            check_numbers(item, f"{where}.{key}" if where else str(key))
    elif isinstance(value, (list, tuple)):
        for place, item in enumerate(value):
            check_numbers(item, f"{where}[{place}]")


def check_types(target: Any, given: Mapping[str, Any], where: str) -> None:
    """Check arguments against the annotations of a class or function.

    Args:
        target: what is called with them; arguments without annotation may be anything.
        given: the arguments by name.
        where: their place in the configuration.

    Raises:
        ConfigError: naming the setting, the type expected and the value.
    """
    function = target
    # The generated constructor of a dataclass does not know the names of its module.
    if inspect.isclass(target) and not dataclasses.is_dataclass(target):
        function = target.__init__
    try:
        hints = typing.get_type_hints(function)
    except (NameError, TypeError, AttributeError):
        return
    for key, value in given.items():
        if key in hints and not _fits(value, hints[key]):
            raise ConfigError(f"{where}.{key} must be {_described(hints[key])}, got {value!r}")


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value has the type of an annotation; of one that is not known, yes."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, part) for part in parts)
    if hint in SIMPLE:
        # bool is an int to Python, but not to a reader of a configuration.
        return isinstance(value, SIMPLE[hint]) and (hint is bool or not isinstance(value, bool))
    if origin in (Sequence, list, tuple):
        return isinstance(value, (list, tuple)) and all(_fits(item, parts[0]) for item in value)
    if origin in (Mapping, dict):
        return isinstance(value, Mapping) and all(_fits(x, parts[1]) for x in value.values())
    # What takes an object takes any that does its part; but numbers and text are none.
    plain = isinstance(value, (int, float, str, list, Mapping, type(None)))
    if not plain or not inspect.isclass(hint):
        return not plain or origin is not Callable
    return hint is Any or (not getattr(hint, "_is_protocol", False) and isinstance(value, hint))


def _described(hint: Any) -> str:
    """Return what an annotation asks for in a configuration's words."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(sorted({_described(part) for part in parts}))
    if origin in (Sequence, list, tuple):
        return f"list of {_described(parts[0])}"
    if origin in (Mapping, dict):
        return f"mapping of {_described(parts[1])}"
    if hint in SIMPLE:
        return NAMES.get(hint, hint.__name__)
    return f"{getattr(hint, '__name__', hint)} (a node with _target_)"
