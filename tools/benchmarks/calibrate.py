"""Benchmark of the calibration, beside scipy driver by driver."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from scipy.optimize import differential_evolution

from benchmarks.harness import Row, agree, alternate, rows_of, stream
from lcc_rl.drivers.calibrator import Calibrator
from lcc_rl.drivers.observed import Observed, observe
from lcc_rl.drivers.parameters import DEFAULT_BOUNDS
from lcc_rl.functional.idm import IDMConstants

NAMES = ("desired_speed", "time_gap")
OURS, SCIPY = "fit", "scipy and numba"
# The order in which squared_error reads the parameters of IDMConstants.
KNOWN = (
    *("acceleration", "deceleration", "min_gap", "exponent", "gap_floor"),
    *("braking_limit", "acceleration_limit"),
)
Objective = Callable[..., float]


def squared_error(
    candidate: Any, leader: Any, follower: Any, gap: float, dt: float, known: Any
) -> float:
    """Return the sum of squared speed errors of one driver with (v0, T), plain numbers (A3, A6).

    Args:
        candidate: desired speed and time gap.
        leader: observed speeds of the leader [m/s].
        follower: those of the follower [m/s].
        gap: the first gap [m].
        dt: sampling interval [s].
        known: the values of :data:`KNOWN`.
    """
    maximum, comfort, min_gap, _, floor, braking, limit = known
    desired_speed, headway, speed, total = candidate[0], candidate[1], follower[0], 0.0
    root = 2.0 * (maximum * comfort) ** 0.5
    for step in range(len(leader) - 1):
        ahead, ahead_reached = leader[step], leader[step + 1]
        wish = min_gap + max(0.0, speed * (headway + (speed - ahead) / root))
        load = (speed / desired_speed) ** 4 + (wish / max(gap, floor)) ** 2
        command = min(max(maximum * (1.0 - load), -braking), limit)
        reached = max(0.0, speed + command * dt)
        gap += 0.5 * dt * (ahead - speed + ahead_reached - reached)
        speed = reached
        total += (speed - follower[step + 1]) ** 2
    return total


def objective(observed: Observed, index: int, error: Objective) -> Objective:
    """Return the RMSPE (0.07 is 7 %) of one driver as a function of (v0, T).

    Args:
        index: which of them.
        error: :func:`squared_error` as numba compiled it.
    """
    part = slice(int(observed.samples[index]))
    speeds = [x[part, index].numpy() for x in (observed.leader_speed, observed.follower_speed)]
    norm = float((speeds[1] ** 2).sum())
    known = tuple(getattr(IDMConstants(), name) for name in KNOWN)
    settings = (*speeds, float(observed.gaps[0, index]), observed.time_step, known)
    return lambda candidate: float((error(candidate, *settings) / norm) ** 0.5)


def calibrate(options: Namespace) -> list[Row]:
    """Return the seconds to fit (v0, T) of every driver, beside scipy driver by driver.

    scipy's differential evolution runs with its own defaults and an objective that numba compiles
    before the clock starts. Ours is the default search, compiled in the untimed run before. The
    mean RMSPE of each is a row, too.
    """
    observed = observe(stream(options.quick).load().episodes)
    error = numba.njit(fastmath=True, error_model="numpy")(squared_error)
    objectives = [objective(observed, index, error) for index in range(observed.count)]
    objectives[0](np.array([20.0, 1.0]))  # compiles
    found: dict[str, Any] = {}
    bounds = [DEFAULT_BOUNDS[parameter] for parameter in NAMES]
    limit = {"maxiter": 2} if options.quick else {}

    def ours() -> None:
        drivers = Calibrator()(observed).drivers.set_index("episode")
        found[OURS] = drivers.loc[observed.identity["episode"]]

    def scipy() -> None:
        results = [differential_evolution(x, bounds, seed=0, **limit) for x in objectives]
        found[SCIPY] = np.array([100 * result.fun for result in results])

    spent = alternate({OURS: ours, SCIPY: scipy}, options.repeats)
    fitted = found[OURS][["desired_speed_mps", "time_gap_s", "rmspe"]].to_numpy()
    for function, (*parameters, own) in zip(objectives, fitted, strict=True):
        agree("our objective", own, function(np.array(parameters)))
    errors = {OURS: 100 * fitted[:, 2], SCIPY: found[SCIPY]}
    means = {name: np.array([each.mean()]) for name, each in errors.items()}
    against = {OURS: [SCIPY]}
    rows = rows_of(spent, "s", against, observed.count)
    return rows + rows_of(means, "% RMSPE", against, observed.count)
