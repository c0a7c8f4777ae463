"""Simulation of followers compiled by numba, for calibrations on a CPU (A3, A4, A6)."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cache, partial
from types import FunctionType
from typing import Any

import numba
import numpy as np

log = logging.getLogger("lcc_rl")


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


@cache
def compiled(dtype: str) -> Callable[..., None]:
    """Return :func:`squared_errors` for one precision; numba compiles it at its first call.

    numba keeps the machine code beside this file or, where that is read-only, in the user's cache
    folder (``NUMBA_CACHE_DIR``). If it cannot be kept or read, the function is compiled for this
    process. Each precision is a function of its own name: processes that compile at the same time
    would mix up the files of one.

    Args:
        dtype: name of the precision, ``float32`` or ``float64``.
    """
    name = f"squared_errors_{dtype}"
    function = FunctionType(squared_errors.__code__, squared_errors.__globals__, name)
    # Sums may be fused with products; nothing else is changed for speed.
    compile_it = partial(numba.njit, fastmath={"contract"}, error_model="numpy", nogil=True)
    uncached = compile_it()(function)
    try:
        chosen = compile_it(cache=True)(function)
    except RuntimeError as error:  # there is no place for the code
        log.info("compiling the drivers' simulation for this run only: %s", error)
        return uncached

    def call(*arguments: Any) -> None:
        nonlocal chosen
        try:
            chosen(*arguments)
        except Exception as error:  # a damaged file raises whatever unpickling it meets
            log.info("compiling the drivers' simulation for this run only: %r", error)
            chosen = uncached
            chosen(*arguments)

    return call
