"""A check that a function leaves the tensors that it reads as they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor, compiler

from lcc_rl.errors import ConfigError


def unchanged(
    function: Callable[..., Any], values: Sequence[Tensor], title: str, names: Sequence[str]
) -> Any:
    """Return what a function returns for tensors that it must not change in place.

    Compiled code is not checked: when an environment is built, all its pieces run uncompiled.

    Raises:
        ConfigError: naming the function by its ``title``, and the tensor by its name.
    """
    if compiler.is_compiling():
        return function(*values)
    try:
        before = [value._version for value in values]
    except RuntimeError:  # tensors of torch's inference mode do not count their changes
        return function(*values)
    found = function(*values)
    if [value._version for value in values] != before:
        name = next(
            x for x, value, n in zip(names, values, before, strict=True) if n != value._version
        )
        raise ConfigError(
            f"{title} changes {name} in place, and so the state of the vehicles; use "
            "gap.clamp(…) instead of gap.clamp_(…) and the like, or change a clone"
        )
    return found
