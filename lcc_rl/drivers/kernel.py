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
    idm: Any,
    ovm: Any,
    exponent: Any,
    apart: Any,
    leader: Any,
    follower: Any,
    gaps: Any,
    samples: Any,
    parameters: Any,
    settings: Any,
    total: Any,
) -> None:
    """Sum up the squared errors of speed and gap of followers, for many candidates of each driver.

    The formulas are those of :func:`lcc_rl.functional.idm.simulate_follower`. The inner loop runs
    over the candidates of one driver, in which it becomes vector instructions: numba drops the
    branches for arguments that are None. Comparisons are such that what is not a number stays so.

    Args:
        idm: None unless the drivers are of the IDM.
        ovm: None unless they are of optimal velocities; with both None, of Gipps' model.
        exponent: of the IDM; None for 4.
        apart: None unless the errors of the gap are summed up; else they are zero.
        leader: observed speeds, ``[drivers, time]`` [m/s].
        follower: the same of the followers [m/s].
        gaps: observed gaps, ``[drivers, time]`` [m].
        samples: number of samples, ``[drivers]``.
        parameters: six, each ``[drivers, candidates]``; see
            :data:`lcc_rl.drivers.fit_error.READY`.
        settings: gap floor, braking limit, acceleration limit, time step, half of it and the
            numbers 0, 1, 2, 0.025 and 1e-12: literals would be of double precision.
        total: is overwritten with the sums of speed and gap, ``[2, drivers, candidates]``.
    """
    floor, braking, limit, time_step, half, zero, one, two, slow, tiny = settings
    speed, gap = np.empty_like(total[0, 0]), np.empty_like(total[0, 0])
    for driver in range(total.shape[1]):
        p0, p1, p2 = parameters[0][driver], parameters[1][driver], parameters[2][driver]
        p3, p4, p5 = parameters[3][driver], parameters[4][driver], parameters[5][driver]
        error, distance = total[0, driver], total[1, driver]
        speed[:], gap[:] = follower[driver, 0], gaps[driver, 0]
        error[:], distance[:] = zero, zero
        for step in range(samples[driver] - 1):
            ahead, truth = leader[driver, step], follower[driver, step + 1]
            seen, advance = gaps[driver, step + 1], half * (ahead + leader[driver, step + 1])
            for i in range(len(speed)):
                if idm is not None:
                    wish = speed[i] * (p1[i] + (speed[i] - ahead) * p3[i])
                    wish = (zero if wish < zero else wish) + p4[i]
                    ratio = wish / (floor if gap[i] < floor else gap[i])
                    free = speed[i] * p0[i]
                    free = free * free * (free * free) if exponent is None else free**exponent
                    command = p2[i] * (one - free - ratio * ratio)
                elif ovm is not None:
                    optimal = p0[i] * np.tanh(gap[i] * p1[i] - p2[i]) + p3[i]
                    command = p4[i] * (optimal - speed[i]) + p5[i] * (ahead - speed[i])
                else:
                    share, brake = speed[i] * p0[i], p2[i] * p3[i]
                    free = p1[i] * (one - share) * np.sqrt(slow + share)
                    room = p2[i] * (two * (gap[i] - p4[i]) - speed[i] * p3[i])
                    root = brake * brake + room + p5[i] * ahead * ahead
                    root = np.sqrt(tiny if root < tiny else root)
                    over = free - (root - brake - speed[i]) / p3[i]
                    command = free - (zero if over < zero else over)
                command = -braking if command < -braking else command
                command = limit if command > limit else command
                reached = speed[i] + time_step * command
                reached = zero if reached < zero else reached
                gap[i] += advance - half * (speed[i] + reached)
                speed[i] = reached
                error[i] += (reached - truth) * (reached - truth)
                if apart is not None:
                    distance[i] += (gap[i] - seen) * (gap[i] - seen)


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
