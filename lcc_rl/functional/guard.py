"""Checks that functions change no inputs in place, store nothing, and mix no episodes."""

from __future__ import annotations

import inspect
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
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
BY_SEED = "remember, or draw random numbers but by the episode's seed"
BESIDE, ALONE = 64, 6  # episodes with drawn inputs, and how many of them play alone


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


def check_independent(
    title: str,
    names: Sequence[str],
    function: Callable[..., Sequence[Tensor]],
    inputs: Sequence[Tensor],
    remedy: str = BY_SEED,
    near: float = 1e-4,
) -> None:
    """Refuse a function whose numbers of an episode depend on others, earlier calls or chance.

    It is called with the given inputs and with drawn ones, because an ``if`` may have the same
    outcome for all given episodes. Drawn inputs that it does not accept are passed over.

    Args:
        title: what computes the numbers.
        names: those of the function's results, in order.
        function: maps inputs to results; the first dimension of each is that of the episodes.
        inputs: those of some episodes.
        remedy: what to do instead.
        near: largest difference that counts as none.

    Raises:
        ConfigError: naming the title and the numbers.
    """
    for given in (inputs, *_examples(inputs)):
        rows = (*range(min(len(given[0]), ALONE)), 0)
        try:
            with torch.random.fork_rng(devices=[]), warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # of numbers that no car has
                alone = [function(*(x[row : row + 1].clone() for x in given)) for row in rows]
                beside = function(*(x.clone() for x in given))
            several = zip(names, beside, zip(*alone, strict=True), strict=True)
            wrong = [name for name, found, each in several if not _same(found, each, near)]
        except Exception:
            if given is inputs:
                raise
            continue
        text = f"{title} gives an episode other {', '.join(wrong)} alone, or in the same step again"
        mixing = "mix episodes (mean() of a batch; if with any(): use torch.where)"
        require(not wrong, f"{text}: it must not {mixing}, {remedy}")


def _same(beside: Tensor, alone: Sequence[Tensor], near: float) -> bool:
    """Whether rows alone, and the first of them a second time, are the first ones of all rows."""
    *rows, again = (x.nan_to_num().double() for x in alone)
    first, both = beside[: len(rows)].nan_to_num().double(), torch.cat(rows)
    same = torch.equal(rows[0], again) and first.shape == both.shape
    return same and torch.allclose(first, both, rtol=1e-3, atol=near)


def _examples(inputs: Sequence[Tensor]) -> Iterator[list[Tensor]]:
    """Yield inputs of drawn episodes: numbers are scaled by 0 or 0.02 to 12, then shifted, too."""
    generator = torch.Generator().manual_seed(0)
    for shift in (0.0, 3.0):
        # All numbers of an episode share a part of the scale.
        found, shared = [], 3.0 * torch.rand(BESIDE, generator=generator) - 2.0
        for given in inputs:
            x = given.detach()[torch.arange(BESIDE) % len(given)]
            chance, scale = torch.rand((2, *x.shape), generator=generator)
            moved = shift * torch.randn(x.shape, generator=generator)
            scale = (shared.reshape(-1, *[1] * (x.ndim - 1)) + 3.5 * scale - 2.0).exp()
            if x.is_floating_point():
                x = x * (scale * (chance > 0.1)).to(x) + moved.to(x)
            found.append((chance > 0.5).to(x.device) if x.dtype == torch.bool else x)
        yield found


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
        pieces: the pieces, or models.
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
