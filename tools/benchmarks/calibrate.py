"""Benchmark of the calibration, beside scipy driver by driver."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Sequence
from typing import Any

import numba
import numpy as np
from scipy.optimize import differential_evolution

from benchmarks.harness import Row, Run, agree, alternate, rows_of, stream
from benchmarks.plain_numba import KNOWN
from lcc_rl.data.sources import EpisodesSource
from lcc_rl.drivers.calibrator import Calibrator
from lcc_rl.drivers.observed import Observed, observe
from lcc_rl.drivers.parameters import DEFAULT_BOUNDS
from lcc_rl.functional.idm import IDMConstants

NAMES = ("desired_speed", "time_gap")
OURS, PYTHON, NUMBA = "fit", "scipy, scaled from few", "scipy and numba"
Objective = Callable[[Any], float]


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
        known: the values of :data:`benchmarks.plain_numba.KNOWN`.
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


def objective(observed: Observed, index: int, compiled: Any = None) -> Objective:
    """Return the RMSPE (0.07 is 7 %) of one driver as a function of (v0, T).

    Args:
        observed: the episodes.
        index: which of them.
        compiled: :func:`squared_error` as numba compiled it; None: in plain Python.
    """
    part = slice(int(observed.samples[index]))
    speeds = [x[part, index].numpy() for x in (observed.leader_speed, observed.follower_speed)]
    norm = float((speeds[1] ** 2).sum())
    if compiled is None:
        speeds = [speed.tolist() for speed in speeds]
    settings: tuple[Any, ...] = (
        *speeds,
        float(observed.gaps[0, index]),
        observed.time_step,
        tuple(getattr(IDMConstants(), name) for name in KNOWN),
    )
    function = compiled or squared_error
    return lambda candidate: float((function(candidate, *settings) / norm) ** 0.5)


def calibrate(options: Namespace) -> list[Row]:
    """Return the seconds to fit (v0, T) of every driver, beside scipy driver by driver.

    scipy's differential evolution runs with its own defaults: with an objective that numba
    compiled (before the clock starts) for every driver, and with one in plain Python for a few,
    scaled to all by the number of samples. Ours is the default search, compiled in the untimed run
    before. The mean RMSPE of each way is a row, too.
    """
    source = EpisodesSource(path=options.episodes) if options.episodes else stream(options.quick)
    observed = observe(source.load().episodes)
    few = np.linspace(0, observed.count - 1, 2 if options.quick else 6).round().astype(int)
    compiled = numba.njit(fastmath=True, error_model="numpy")(squared_error)
    objectives = [objective(observed, index, compiled) for index in range(observed.count)]
    objectives[0](np.array([20.0, 1.0]))  # compiles
    found: dict[str, Any] = {}
    plain = [objective(observed, int(index)) for index in few]
    runs = {
        OURS: ours(found, observed),
        PYTHON: scipy(found, PYTHON, plain, options.quick),
        NUMBA: scipy(found, NUMBA, objectives, options.quick),
    }
    spent = alternate(runs, options.repeats)
    spent[PYTHON] = spent[PYTHON] * (observed.samples.sum() / observed.samples[few].sum())
    fitted = found[OURS][["desired_speed_mps", "time_gap_s", "rmspe"]].to_numpy()
    for own, (*parameters, error) in zip(plain, fitted[few], strict=True):
        agree("our objective", error, own(parameters))
    rows = rows_of(spent, "s", {OURS: [PYTHON, NUMBA], NUMBA: [PYTHON]}, observed.count)
    errors = fitted[:, 2]
    for other, own, count in (
        (PYTHON, errors[few], len(few)),
        (NUMBA, errors, observed.count),
    ):
        means = {OURS: np.array([100 * own.mean()]), other: np.array([100 * found[other].mean()])}
        rows += rows_of(means, "% RMSPE", {OURS: [other]}, count)
    return rows


def ours(found: dict[str, Any], observed: Observed) -> Run:
    """Return the fit of every driver at once."""

    def run() -> None:
        drivers = Calibrator()(observed).drivers.set_index("episode")
        found[OURS] = drivers.loc[observed.identity["episode"]]

    return run


def scipy(found: dict[str, Any], name: str, objectives: Sequence[Objective], quick: bool) -> Run:
    """Return the fit of drivers one by one."""
    bounds = [DEFAULT_BOUNDS[parameter] for parameter in NAMES]
    limit = {"maxiter": 2} if quick else {}

    def run() -> None:
        results = [differential_evolution(x, bounds, seed=0, **limit) for x in objectives]
        found[name] = np.array([result.fun for result in results])

    return run
