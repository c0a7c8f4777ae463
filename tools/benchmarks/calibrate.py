"""Benchmark of the calibration, beside scipy driver by driver."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import astuple
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import differential_evolution

from benchmarks.harness import TOLERANCE, Row, Run, alternate, installed, rows_of, stream
from lcc_rl.data.sources import EpisodesSource
from lcc_rl.drivers.fit import fit
from lcc_rl.drivers.observed import Observed, observe
from lcc_rl.drivers.parameters import DEFAULT_BOUNDS
from lcc_rl.functional.idm import IDMConstants

NAMES = ("desired_speed", "time_gap")
IDENTITY = "episode"
OURS, PYTHON, NUMBA = "fit", "scipy, scaled from few", "scipy and numba"


def squared_error(
    candidate: Any, leader: Any, follower: Any, gap: float, dt: float, known: Any
) -> float:
    """Sum of squared speed errors of one driver with (v0, T), plain Python numbers (A3, A6).

    Args:
        candidate: desired speed and time gap.
        leader: observed speeds of the leader [m/s].
        follower: those of the follower [m/s].
        gap: the first gap [m].
        dt: sampling interval [s].
        known: the values of :class:`IDMConstants`, in order.
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


class Problem:
    """RMSPE of one driver as a function of (v0, T).

    Args:
        observed: the episodes.
        index: which of them.
        compiled: :func:`squared_error` as numba compiled it; None: in plain Python.
    """

    def __init__(
        self, observed: Observed, index: int, compiled: Callable[..., float] | None = None
    ) -> None:
        part = slice(int(observed.samples[index]))
        speeds = [x[part, index].numpy() for x in (observed.leader_speed, observed.follower_speed)]
        norm = float((speeds[1] ** 2).sum())
        if compiled is None:
            speeds = [speed.tolist() for speed in speeds]
        known = astuple(IDMConstants())
        settings: tuple[Any, ...] = (*speeds, float(observed.gap[index]), observed.time_step, known)
        self.function: Callable[..., float] = compiled or squared_error
        self.settings, self.norm = settings, norm

    def __call__(self, candidate: Any) -> float:
        """Return the error; 0.07 is 7 %."""
        return float((self.function(candidate, *self.settings) / self.norm) ** 0.5)


def calibrate(options: Namespace) -> list[Row]:
    """Seconds to fit (v0, T) of every driver, beside scipy driver by driver.

    scipy's differential evolution runs with its own defaults: with an objective that numba
    compiled (before the clock starts) for every driver, and with one in plain Python for a few,
    scaled to all by the number of samples. Ours is the default search, compiled in the untimed run
    before.
    """
    source = EpisodesSource(path=options.episodes) if options.episodes else stream(options.quick)
    observed = observe(source.load().episodes)
    found: dict[str, Any] = {}
    few = np.linspace(0, observed.count - 1, 2 if options.quick else 6).round().astype(int)
    limit = {"maxiter": 2} if options.quick else {}
    runs: dict[str, Run] = {OURS: partial(ours, found, observed, options)}
    runs[PYTHON] = partial(scipy, found, PYTHON, [Problem(observed, int(i)) for i in few], limit)
    if installed("numba"):
        runs[NUMBA] = partial(scipy, found, NUMBA, numba_problems(observed), limit)
    spent = alternate(runs, options.repeats)
    spent[PYTHON] = spent[PYTHON] * (observed.samples.sum() / observed.samples[few].sum())
    check_objective(found[OURS], observed, few)
    rows = rows_of("calibrate", spent, "s", PYTHON, observed.count)
    if NUMBA in spent:
        pair = {OURS: spent[OURS], NUMBA: spent[NUMBA]}
        rows += rows_of("calibrate", pair, "s", NUMBA, observed.count)[:1]
    return rows + errors(found, few, observed.count)


def ours(found: dict[str, Any], observed: Observed, options: Namespace) -> None:
    """Fit every driver at once."""
    result = fit(observed, device=options.device)
    found[OURS] = result.drivers.set_index(IDENTITY).loc[observed.identity[IDENTITY]]


def scipy(
    found: dict[str, Any], name: str, problems: Sequence[Problem], limit: dict[str, int]
) -> None:
    """Fit drivers one by one."""
    bounds = [DEFAULT_BOUNDS[parameter] for parameter in NAMES]
    results = [differential_evolution(p, bounds, seed=0, **limit) for p in problems]
    found[name] = np.array([result.fun for result in results])


def numba_problems(observed: Observed) -> list[Problem]:
    """Every driver's problem with a compiled objective."""
    import numba

    compiled = numba.njit(squared_error)
    problems = [Problem(observed, index, compiled) for index in range(observed.count)]
    problems[0](np.array([20.0, 1.0]))  # compiles
    return problems


def check_objective(fitted: pd.DataFrame, observed: Observed, few: np.ndarray) -> None:
    """Hold our error against the plain objective at the parameters found."""
    columns = ["desired_speed_mps", "time_gap_s", "rmspe"]
    for index in few:
        desired_speed, headway, rmspe = fitted[columns].iloc[index].tolist()
        off = abs(Problem(observed, int(index))((desired_speed, headway)) - rmspe)
        if not off <= TOLERANCE:
            raise RuntimeError(f"the objectives differ by {off:g}")


def errors(found: dict[str, Any], few: np.ndarray, count: int) -> list[Row]:
    """Mean RMSPE of every way, of the few and of all drivers."""

    def mean(values: Any) -> np.ndarray:
        return np.array([100 * np.mean(values)])

    fitted = found[OURS]["rmspe"].to_numpy()
    some = {OURS: mean(fitted[few]), PYTHON: mean(found[PYTHON])}
    rows = rows_of("calibrate", some, "% RMSPE", PYTHON, len(few))
    whole = {OURS: mean(fitted)}
    whole |= {NUMBA: mean(found[NUMBA])} if NUMBA in found else {}
    return rows + rows_of("calibrate", whole, "% RMSPE", NUMBA if NUMBA in found else None, count)
