"""Compiles generated source to machine code by numba."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numba
import numpy as np
from llvmlite import binding
from numba import types
from numba.extending import get_cython_function_address

log = logging.getLogger("lcc_rl")


@numba.njit
def pick(condition: Any, one: Any, other: Any) -> Any:
    """Return one of two numbers; a function, so that the loop has no branches."""
    return one if condition else other


@numba.njit(boundscheck=True)
def read(table: Any, place: Any) -> Any:
    """Return an entry of a table, or of a tuple.

    Raises:
        IndexError: if there is none at that place.
    """
    return table[place]


@numba.njit
def layer(weights: Any, bias: Any, inputs: Any) -> Any:
    """Return ``bias`` and the sum of the rows of ``weights``, each times one of the inputs."""
    found = bias.copy()
    for place, value in enumerate(inputs):
        for unit in range(len(found)):
            found[unit] += value * weights[place, unit]
    return found


@numba.njit
def rectified(values: Any) -> Any:
    """Return the values of an array with zero instead of negative ones."""
    found = values.copy()
    for place, value in enumerate(values):
        found[place] = pick(value < 0, np.float32(0), value)
    return found


# By name: machine code with an address in it could not be kept for later processes.
NDTRI = "lcc_rl_ndtri"
binding.add_symbol(NDTRI, get_cython_function_address("scipy.special.cython_special", "ndtri"))
SCOPE = {
    "pick": pick,
    "layer": layer,
    "rectified": rectified,
    "read": read,
    "ndtri": types.ExternalFunction(NDTRI, types.float64(types.float64)),
    "f32": np.float32,
    "f64": np.float64,
    "i64": np.int64,
    "flag": np.bool_,
    "np": np,
    "inf": np.inf,
    "nan": np.nan,
}


def _made(source: str, file: str, name: str) -> Callable[..., None]:
    scope: dict[str, Any] = {**SCOPE, "__name__": __name__}
    exec(compile(source.replace("def kernel(", f"def {name}("), file, "exec"), scope)
    return scope[name]


@cache
def kept(source: str, fused: bool = False) -> Callable[..., None]:
    """Return the function ``kernel`` of a source as machine code that is cached on disk.

    With ``fused``, a product and a sum may be rounded once; nothing else is relaxed.

    numba keeps the machine code beside this file or, where that is read-only, in the user's cache
    folder (``NUMBA_CACHE_DIR``), under a name that contains a hash of the source. If it cannot be
    kept or read, the function is compiled for this process.
    """
    fastmath = {"contract"} if fused else False
    compile_it = partial(numba.njit, fastmath=fastmath, error_model="numpy", nogil=True)
    name = f"{'fused' if fused else 'kernel'}_{hashlib.sha256(source.encode()).hexdigest()[:16]}"
    function = _made(source, __file__, name)
    uncached = compile_it()(function)
    try:
        chosen = compile_it(cache=True)(function)
    except RuntimeError as error:  # no folder to write the code to
        log.info("compiling a simulation for this run only: %s", error)
        return uncached
    return _Kept((source, fused), chosen, uncached)


class _Kept:
    """Calls cached machine code; compiles anew if its file is damaged."""

    def __init__(self, made_of: tuple[str, bool], chosen: Any, uncached: Any) -> None:
        self.made_of, self.chosen, self.uncached = made_of, chosen, uncached

    def __call__(self, *arguments: Any) -> None:
        try:
            self.chosen(*arguments)
        except Exception as error:  # a damaged file raises whatever unpickling it meets
            log.info("compiling a simulation for this run only: %r", error)
            self.chosen = self.uncached
            self.chosen(*arguments)

    def __reduce__(self) -> tuple[Any, ...]:
        return kept, self.made_of
