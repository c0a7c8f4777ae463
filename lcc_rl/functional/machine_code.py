"""Compiles generated source to machine code by numba."""

from __future__ import annotations

import ctypes
import hashlib
import logging
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numba
import numpy as np
from numba.extending import get_cython_function_address

log = logging.getLogger("lcc_rl")


@numba.njit
def pick(condition: Any, one: Any, other: Any) -> Any:
    """Return one of two numbers; a function, so that the loop has no branches."""
    return one if condition else other


@numba.njit(boundscheck=True)
def read(table: Any, place: Any) -> Any:
    """Return an entry of a table.

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


SCOPE = {
    "pick": pick,
    "layer": layer,
    "read": read,
    "ndtri": ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double)(
        get_cython_function_address("scipy.special.cython_special", "ndtri")
    ),
    "f32": np.float32,
    "f64": np.float64,
    "i64": np.int64,
    "flag": np.bool_,
    "np": np,
    "inf": np.inf,
    "nan": np.nan,
}


@cache
def compiled(source: str) -> Callable[..., None]:
    """Return the function ``kernel`` of a source as machine code, shared by equal sources."""
    return numba.njit(error_model="numpy")(_made(source, "<recorded>", "kernel"))


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
    if "ndtri(" in source:  # a pointer into this process
        return compiled(source)
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
