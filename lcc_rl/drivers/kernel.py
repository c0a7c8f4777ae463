"""Simulation of followers compiled by numba, for calibrations on a CPU (A3, A4, A6)."""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

log = logging.getLogger("lcc_rl")

FOLDER = "lcc_rl"  # in the user's cache folder


def squared_errors(
    leader: Any,
    follower: Any,
    first_gap: Any,
    samples: Any,
    parameters: Any,
    settings: Any,
    total: Any,
) -> None:
    """Sum up the squared speed errors of IDM followers, for many candidates of every driver.

    The formulas are those of :func:`lcc_rl.functional.idm.simulate_follower`. The inner loop runs
    over the candidates of one driver, in which it becomes vector instructions. Comparisons are
    such that what is not a number stays so.

    Args:
        leader: observed speeds, ``[drivers, time]`` [m/s].
        follower: the same of the followers [m/s].
        first_gap: ``[drivers]`` [m].
        samples: number of samples, ``[drivers]``.
        parameters: 1/v0, T, a, 1/(2√(ab)) and s0, each ``[drivers, candidates]``.
        settings: gap floor, braking limit, acceleration limit, exponent, time step, half of it
            and the numbers 0, 1 and 4: literals would be of double precision.
        total: is overwritten with the sums, ``[drivers, candidates]``.
    """
    floor, braking, limit, exponent, time_step, half, zero, one, four = settings
    slownesses, time_gaps, maxima, inverse_roots, min_gaps = parameters
    squared = exponent == four
    speed, gap = np.empty_like(total[0]), np.empty_like(total[0])
    for driver in range(len(total)):
        slowness, time_gap, maximum = slownesses[driver], time_gaps[driver], maxima[driver]
        inverse_root, min_gap, error = inverse_roots[driver], min_gaps[driver], total[driver]
        speed[:], gap[:], error[:] = follower[driver, 0], first_gap[driver], zero
        for step in range(samples[driver] - 1):
            ahead, truth = leader[driver, step], follower[driver, step + 1]
            advance = half * (ahead + leader[driver, step + 1])
            for i in range(len(speed)):
                wish = speed[i] * (time_gap[i] + (speed[i] - ahead) * inverse_root[i])
                wish = (zero if wish < zero else wish) + min_gap[i]
                ratio = wish / (floor if gap[i] < floor else gap[i])
                free = speed[i] * slowness[i]
                free = free * free * (free * free) if squared else free**exponent
                command = maximum[i] * (one - free - ratio * ratio)
                command = -braking if command < -braking else command
                command = limit if command > limit else command
                reached = speed[i] + time_step * command
                reached = zero if reached < zero else reached
                gap[i] += advance - half * (speed[i] + reached)
                speed[i] = reached
                error[i] += (reached - truth) * (reached - truth)


class Kernel:
    """:func:`squared_errors`, compiled by numba for one precision at its first call.

    The machine code is kept in the user's cache folder. Where it cannot be read or written, one
    line of the log says so and the function is compiled for this process.

    Args:
        dtype: name of the precision, ``float32`` or ``float64``.
    """

    def __init__(self, dtype: str) -> None:
        try:
            self.function = _compiled(_cache_folder(dtype))
        except (OSError, RuntimeError) as error:  # RuntimeError: there is no home folder
            self._uncached(error)

    def __call__(self, *arguments: Any) -> None:
        """Call :func:`squared_errors`."""
        try:
            self.function(*arguments)
        except Exception as error:  # a damaged file raises whatever unpickling it meets
            self._uncached(error)
            self.function(*arguments)

    def _uncached(self, error: Exception) -> None:
        log.info("compiling the drivers' simulation for this run only: %r", error)
        self.function = _compiled(None)


@cache
def kernel_of(dtype: str) -> Kernel | None:
    """Return the compiled simulation in a precision; None where numba is not installed."""
    try:
        import numba  # noqa: F401
    except ImportError as error:
        log.info("without numba, calibrations are several times slower: %s", error)
        return None
    return Kernel(dtype)


def _compiled(folder: Path | None) -> Callable[..., None]:
    """The function for numba to compile; its code is kept in a folder, None: is not kept."""
    import numba

    before = numba.config.CACHE_DIR
    try:
        numba.config.CACHE_DIR = "" if folder is None else str(folder)
        # Sums may be fused with products; nothing else is changed for speed.
        return numba.njit(
            squared_errors,
            cache=folder is not None,
            fastmath={"contract"},
            error_model="numpy",
            nogil=True,
        )
    finally:
        numba.config.CACHE_DIR = before


def _cache_folder(dtype: str) -> Path:
    """The folder of the code for this source, precision, processor and numba, made and writable.

    numba writes an index and the code, each at once but not both together. In a folder of its own
    the one always belongs to the other, whoever else compiles at the same time.
    """
    import llvmlite
    import numba
    from llvmlite import binding

    processor = f"{binding.get_host_cpu_name()} {binding.get_host_cpu_features().flatten()}"
    parts = (numba.__version__, llvmlite.__version__, np.__version__, processor, dtype)
    key = hashlib.sha256(Path(__file__).read_bytes() + "\n".join(parts).encode()).hexdigest()
    given = numba.config.CACHE_DIR or os.environ.get("XDG_CACHE_HOME")
    folder = Path(given or Path.home() / ".cache") / FOLDER / f"kernel-{key[:16]}"
    folder.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=folder).close()
    return folder
