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
from lcc_rl.evaluation import simulation
from lcc_rl.interfaces.sumo import load_sumo

SIZES = ((10, 1), (200, 1), (10, 64), (200, 64))  # vehicles behind the leader, episodes
FIRST, APART = 300, 50  # the first step of the first leader; steps between two leaders
AROUND, PLACE, LENGTH = 24_000.0, 12_000.0, 5.0  # of SUMO's ring, the leader, a vehicle [m]
IDM = ["drivers=fixed", "scenario.controllers.human.noise=0"]  # as SUMO's own
DRIVER = ("acceleration", "deceleration", "desired_speed", "time_gap", "min_gap")


@numba.njit
def drive(leader: Any, speed: Any, gap: Any, driver: Any) -> None:
    """Write speeds and gaps, ``[time, episodes, n]``, of IDM drivers from the first ones on."""
    maximum, comfort, desired_speed, headway, min_gap = driver
    root = 2.0 * (maximum * comfort) ** 0.5
    for step in range(len(speed) - 1):
        for episode in range(speed.shape[1]):
            ahead, ahead_after = leader[step, episode], leader[step + 1, episode]
            for car in range(speed.shape[2]):
                v, s = speed[step, episode, car], gap[step, episode, car]
                wish = min_gap + max(0.0, v * (headway + (v - ahead) / root))
                load = (v / desired_speed) ** 4 + (wish / max(s, 0.1)) ** 2
                after = max(0.0, v + 0.1 * max(maximum * (1.0 - load), -9.0))
                speed[step + 1, episode, car] = after
                gap[step + 1, episode, car] = s + 0.05 * (ahead + ahead_after - v - after)
                ahead, ahead_after = v, after


def by_numba(driver: Any, leaders: Any, gaps: Any) -> tuple[Any, Any]:
    """Return speeds and gaps of strings that begin at their leaders' speeds."""
    speed, gap = np.empty((2, len(leaders), *gaps.shape))
    speed[0], gap[0] = leaders[0][:, None], gaps
    drive(leaders, speed, gap, driver)
    return speed, gap


def by_sumo(cfg: Any, leaders: Any, gaps: Any) -> tuple[Any, Any]:
    """Return speeds and gaps of one string that SUMO's own IDM drives."""
    sumo, cars = load_sumo(), [f"car{number}" for number in range(gaps.size + 1)]
    speed, way = np.empty((2, len(leaders), len(cars)))
    places = PLACE - np.array([0.0, *gaps[0] + LENGTH]).cumsum()
    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as name:
        start(cfg, Path(name), AROUND, places.tolist())
        sumo.vehicle.setSpeedMode("car0", 0)
        for step, ahead in enumerate([*leaders[1:, 0].tolist(), 0.0]):
            speed[step] = [sumo.vehicle.getSpeed(car) for car in cars]
            way[step] = [sumo.vehicle.getDistance(car) for car in cars]
            sumo.vehicle.setSpeed("car0", ahead)
            sumo.simulationStep()
        sumo.close()
    return speed[:, None, 1:], (gaps - np.diff(way))[:, None]


def simulate(options: Namespace) -> list[Row]:
    """Return the seconds of the processor for 4,000 steps with all tables, as a user calls it.

    SUMO's speeds and positions are read at every step; the loop keeps speeds and gaps. All three
    are first checked to move alike.
    """
    steps, sizes = (60, ((3, 1), (3, 2))) if options.quick else (4000, SIZES)
    record, rows = resample(*read_speed_record("hwfet"), 0.1), list[Row]()
    for count, episodes in sizes:
        each = [record[FIRST + APART * x :][: steps + 1].numpy() for x in range(episodes)]
        own: Run = partial(simulation.simulate, each, f"human*{count}", overrides=IDM)
        kept = own().steps[["speed_mps", "gap_m"]].to_numpy(float)
        motion = kept.reshape(episodes, steps + 1, -1, 2).transpose(3, 1, 0, 2)[..., 1:]
        cfg = load("evaluate", ["variant=idm", IDM[0], f"scenario.string=human*{count}"])
        cfg = cfg.with_(scenario={"initial_speed": float(each[0][0])})
        driver = tuple(float(cfg.drivers.settings[name]) for name in DRIVER)
        args = np.stack(each, 1).astype(float), motion[1, 0].copy()
        others: dict[str, Run] = {"numba loop": partial(by_numba, driver, *args)}
        if episodes == 1 and find_spec("libsumo") is not None:
            others["libsumo"] = partial(by_sumo, cfg, *args)
        for name, run in others.items():
            for what, found, ours in zip(("speed", "gap"), run(), motion, strict=True):
                agree(f"the {what} of {name}", found, ours, 2e-2)
        named = {f"{name}, {count}": run for name, run in {"simulate": own, **others}.items()}
        spent, (case, *peers) = alternate(named, options.repeats, "processor"), named
        rows += rows_of(spent, "s of the processor", {case: peers}, episodes)
    return rows
