"""Checks that functions change no inputs in place, store nothing, and mix no episodes."""

from __future__ import annotations

import inspect
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor, compiler, nn

from lcc_rl.errors import ConfigError, require

LIBRARIES = {"None", "lcc_rl", "torch", "torchrl", "tensordict"}  # whose functions are not examined
AS_ENTRY = (
    "a state must be an entry, which a controller of a class names in remembers, see "
    "docs/controllers.md"
)


def unchanged(
    function: Callable[..., Any], values: Sequence[Tensor], title: str, names: Sequence[str]
) -> Any:
    """Return the result of a function that must not change its inputs in place.

    Compiled code is not checked: when an environment is built, all its pieces run uncompiled.

    Raises:
        ConfigError: naming the function by its ``title``, and the tensor by its name.
    """
    if compiler.is_compiling():
        return function(*values)
    before = changes(values)
    found = function(*values)
    for name, first, last in zip(names, before, changes(values), strict=True):
        if first != last:
            raise changed(title, name)
    return found


def changes(values: Sequence[Tensor]) -> list[int]:
    """Return how often each tensor was changed in place; 0 in torch's inference mode."""
    return [0 if value.is_inference() else value._version for value in values]


def changed(title: str, name: str) -> ConfigError:
    """Return the error for a class that changes its inputs."""
    return ConfigError(
        f"{title} changes {name} in place, and so the state of the vehicles; use "
        "gap.clamp(…) instead of gap.clamp_(…), or change a clone"
    )


def check_independent(title: str, entry: str, beside: Tensor, alone: Tensor, again: Tensor) -> None:
    """Refuse numbers of an episode that depend on others, on earlier calls or on chance.

    Args:
        title: what computed them.
        entry: their name.
        beside: those of the episode beside another.
        alone: those without another.
        again: those without another, a second time.

    Raises:
        ConfigError: naming the title and the entry.
    """
    first, second, third = (x.nan_to_num().double() for x in (beside, alone, again))
    require(
        torch.equal(second, third) and torch.allclose(first, second, rtol=1e-3, atol=1e-4),
        f"{title} gives an episode other {entry} alone, or in the same step again: it must not mix "
        "episodes (mean() of a batch), remember, or draw random numbers but by the episode's seed",
    )


def _kept(item: Any) -> dict[str, list[Any]]:
    """Return what an object may remember in, with counts or items that show changes."""
    kept: dict[str, Any] = {}
    modules = item.named_modules() if isinstance(item, nn.Module) else [("", item)]
    for path, module in modules:
        attributes = {**vars(module), **vars(module).get("_buffers", {})}
        attributes.pop("_buffers", None)
        at = f"{path}." if path else ""
        kept |= {f"attribute '{at}{name}'": value for name, value in attributes.items()}
        kept |= {f"variable {name!r}": value for name, value in _variables(module).items()}
    return {name: _contents(value) for name, value in kept.items()}


def _contents(value: Any) -> list[Any]:
    """Return a value, its items, and numbers that change with its array or tensors."""
    values = [value]
    if isinstance(value, Mapping):
        values += value.values()
    elif isinstance(value, (list, set, deque)):
        values += value
    elif isinstance(value, np.ndarray):
        values.append(hash(value.tobytes()))
    return values + changes([x for x in values if isinstance(x, Tensor)])


def _variables(module: Any) -> dict[str, Any]:
    """Return the variables outside of a user's functions that these read, by name."""
    holders = (module, *type(module).__mro__)
    waiting, found = [x for of in holders for x in vars(of).values()], {}
    while waiting:
        function = getattr(item := waiting.pop(), "__func__", item)  # of a static method
        home = getattr(function, "__module__", None)
        if not isinstance(function, FunctionType) or str(home).partition(".")[0] in LIBRARIES:
            continue
        known = inspect.getclosurevars(function)
        for name, value in {**known.globals, **known.nonlocals}.items():
            if name in found or isinstance(value, ModuleType):
                continue
            found[name] = value
            if home in (getattr(value, "__module__", ""), type(value).__module__):
                waiting.append(value)  # a function of the same module
                found |= {f"{name}.{key}": x for key, x in getattr(value, "__dict__", {}).items()}
    return found


def check_forgets(
    pieces: Sequence[Any], play: Callable[[int], object], remedy: str = AS_ENTRY
) -> None:
    """Refuse pieces, or driver models, that store state where all episodes would share it.

    Args:
        play: lets them act on values that differ by a number, 0 and 1.
        remedy: what to do instead.

    Raises:
        ConfigError: naming the piece, and the attribute or variable that changes.
    """
    play(0)
    before = [_kept(piece) for piece in pieces]  # what the first step stored may be kept
    play(1)
    for piece, kept in zip(pieces, before, strict=True):
        for name, values in _kept(piece).items():
            old = kept.get(name, [])
            if len(values) != len(old) or not all(
                new is stored or (isinstance(new, int) and new == stored)
                for new, stored in zip(values, old, strict=True)
            ):
                title = getattr(piece, "title", type(piece).__name__)
                where = f"{title} remembers in its {name}, which all episodes share"
                raise ConfigError(f"{where}; {remedy}")
