"""Checks that a function changes no inputs in place, and of each episode depends on that alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, compiler

from lcc_rl.errors import ConfigError, require


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
