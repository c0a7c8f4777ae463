"""Benchmark of ``lcc_rl.simulate``, beside SUMO and a loop compiled by numba."""

from __future__ import annotations

from argparse import Namespace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numba
import numpy as np

from benchmarks.harness import Row, Run, agree, alternate, rows_of
from benchmarks.sumo import start
from lcc_rl.config import load
from lcc_rl.data.profiles import resample
from lcc_rl.data.speed_records import read_speed_record
from lcc_rl.evaluation.simulation import simulate as simulated
from lcc_rl.interfaces.sumo import load_sumo

OWN, SUMO, NUMBA = "simulate", "libsumo", "numba loop"
SIZES = ((10, 1), (200, 1), (10, 64), (200, 64))  # vehicles behind the leader, episodes
TIME_STEP, FIRST, APART = 0.1, 300, 50  # [s]; the first step of the first leader; steps between two
AROUND, PLACE = 24_000.0, 12_000.0  # a ring too long to matter, and the leader's place on it [m]
IDM = ["drivers=fixed", "scenario.controllers.human.noise=0"]  # as SUMO's own


@numba.njit
def drive(leader: Any, speed: Any, gap: Any, dt: float, driver: Any) -> None:
    """Write speeds and gaps of IDM drivers, ``[time, episodes, n]``, from the first ones on."""
    maximum, comfort, desired_speed, headway, min_gap = driver
    root = 2.0 * (maximum * comfort) ** 0.5
    for step in range(len(speed) - 1):
        for episode in range(speed.shape[1]):
            ahead, ahead_after = leader[step, episode], leader[step + 1, episode]
            for car in range(speed.shape[2]):
                v, s = speed[step, episode, car], gap[step, episode, car]
                wish = min_gap + max(0.0, v * (headway + (v - ahead) / root))
                load = (v / desired_speed) ** 4 + (wish / max(s, 0.1)) ** 2
                after = max(0.0, v + max(maximum * (1.0 - load), -9.0) * dt)
                speed[step + 1, episode, car] = after
                gap[step + 1, episode, car] = s + 0.5 * dt * (ahead + ahead_after - v - after)
                ahead, ahead_after = v, after


def by_sumo(cfg: Any, leader: Any, gaps: Any) -> tuple[Any, Any]:
    """Drive a string in SUMO from its first gaps; return speeds and gaps, ``[time, n + 1]``."""
    sumo, names = load_sumo(), [f"car{number}" for number in range(len(gaps) + 1)]
    lengths = np.array([0.0, *gaps + cfg.scenario.vehicle_length]).cumsum()
    speed, way = np.empty((2, len(leader), len(names)))
    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as name:
        start(cfg, Path(name), AROUND, (PLACE - lengths).tolist(), float(leader[0]))
        sumo.vehicle.setSpeedMode("car0", 0)
        for step, ahead in enumerate([*leader[1:].tolist(), 0.0]):
            speed[step] = [sumo.vehicle.getSpeed(car) for car in names]
            way[step] = [sumo.vehicle.getDistance(car) for car in names]
            sumo.vehicle.setSpeed("car0", ahead)
            sumo.simulationStep()
        sumo.close()
    return speed, gaps - np.diff(way)


def simulate(options: Namespace) -> list[Row]:
    """Return the seconds of the processor for 4,000 steps, as a user calls the function.

    All tables are made. SUMO drives its own IDM, and its speeds and positions are read at every
    step; the loop in numba keeps speeds and gaps. All are first checked to move alike.
    """
    steps, sizes = (60, ((3, 1), (3, 2))) if options.quick else (4000, SIZES)
    record, rows = resample(*read_speed_record("hwfet"), TIME_STEP), list[Row]()
    for count, episodes in sizes:
        leaders = [record[FIRST + APART * x :][: steps + 1].numpy() for x in range(episodes)]
        own: Run = partial(simulated, leaders, f"human*{count}", overrides=IDM)
        kept = own().steps[["speed_mps", "gap_m"]].to_numpy().reshape(episodes, steps + 1, -1, 2)
        speed, gap = kept.astype(float).transpose(3, 1, 0, 2)
        words = [*IDM[:1], f"scenario.string=human*{count}", f"scenario.time_step={TIME_STEP}"]
        cfg = load("evaluate", ["variant=idm", *words])
        names = ("acceleration", "deceleration", "desired_speed", "time_gap", "min_gap")
        driver = tuple(float(cfg.drivers.settings[name]) for name in names)
        args = [np.stack(leaders, 1).astype(float), speed[..., 1:].copy(), gap[..., 1:].copy()]

        def looped(args: Any = args, driver: Any = driver) -> None:
            leader, *first = args
            found = [np.empty_like(x) for x in first]
            for each, x in zip(found, first, strict=True):
                each[0] = x[0]
            drive(leader, *found, TIME_STEP, driver)
            args[1:] = found

        looped()
        agree("the loop's speed [m/s]", args[1], speed[..., 1:], 1e-2)
        agree("the loop's gap [m]", args[2], gap[..., 1:], 1e-1)
        runs = {OWN: own, NUMBA: looped}
        if episodes == 1 and find_spec("libsumo") is not None:
            runs[SUMO] = partial(by_sumo, cfg, leaders[0], gap[0, 0, 1:])
            theirs = runs[SUMO]()
            agree("SUMO's speed [m/s]", theirs[0][:, 1:], speed[:, 0, 1:], 1e-2)
            agree("SUMO's gap [m]", theirs[1], gap[:, 0, 1:], 1e-1)
        spent = alternate(runs, options.repeats, "processor")
        against = {OWN: [SUMO, NUMBA]}
        named = {f"{name}, {count} vehicles": x for name, x in spent.items()}
        against = {f"{OWN}, {count} vehicles": [f"{x}, {count} vehicles" for x in (SUMO, NUMBA)]}
        rows += rows_of(named, "s of the processor", against, episodes)
    return rows
