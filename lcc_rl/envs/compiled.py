"""A function of the environment, compiled where there is a compiler."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

from torch import compile
from torch._dynamo.exc import TorchDynamoException
from torch._inductor.exc import InductorError

log = logging.getLogger("lcc_rl")

COMPILER_ERRORS = (TorchDynamoException, InductorError)
# Where an object whose method is compiled keeps the environment and its pieces.
CONSTANT = ("self.env", "self.step", "self.first")


class Compiled:
    """A function compiled at its first call; where there is no compiler, the plain function.

    What the object of a method keeps under the names of :data:`CONSTANT` must not change between
    calls, but for the values of its tensors.

    Args:
        function: what to compile, for one size of its arguments.
        what: its name in the line of the log that says that it is not compiled.
        compiled: False for the plain function.
    """

    def __init__(self, function: Callable[..., Any], what: str, compiled: bool) -> None:
        self.plain, self.what, self.function = function, what, function
        if compiled:
            self.function = _compiled(function)

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        if self.function is self.plain:
            return self.plain(*arguments)
        try:
            return self.function(*arguments)
        except COMPILER_ERRORS as error:
            log.info("not compiling %s: %s", self.what, str(error).strip().splitlines()[0])
            self.function = self.plain
            return self.plain(*arguments)


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function, apart from all other objects' compilations of the same code.

    One graph for each size: a graph for any size would be slower.
    """
    options: Any = {"guard_filter_fn": _checked}
    return compile(function, dynamic=False, isolate_recompiles=True, options=options)


def _checked(guards: Sequence[Any]) -> list[bool]:
    """Return which of a graph's guards to check before each use.

    Pieces do not change (lcc_rl.envs.checks refuses those that do); to check a thousand settings
    of them takes 0.1 ms, as long as a step of a small batch. Arguments, the policy, and whether
    gradients are kept are checked.
    """
    return [
        not guard.is_global and not any(name in guard.name for name in CONSTANT) for guard in guards
    ]
