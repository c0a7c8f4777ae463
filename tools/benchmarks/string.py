"""Benchmarks of long strings of vehicles and of ``lcc_rl.simulate``, beside SUMO and numba.

Tests of the bridge use the ring of one lane in SUMO, too.
"""

from __future__ import annotations

import math
import time
from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree import ElementTree

import numba
import numpy as np
from tensordict import TensorDict

from benchmarks.env import ways
from benchmarks.harness import Row, Run, agree, alternate, endings, rates, rows_of
from lcc_rl.config import load
from lcc_rl.config.schemas import StudyConfig
from lcc_rl.data.profiles import resample
from lcc_rl.data.speed_records import read_speed_record
from lcc_rl.envs import build_env, load_inputs
from lcc_rl.evaluation import simulation
from lcc_rl.evaluation.rollout import Player
from lcc_rl.functional.pattern import parse_string
from lcc_rl.interfaces.sumo import load_sumo
from lcc_rl.io.atomic import atomic_path

HUMAN = "human"
SPEED_LIMIT, CORNERS, ROUNDS = 40.0, 32, 100  # of the road [m/s]; of a half; rounds of a route
HALVES = {"east": ("south", "north", -0.5), "west": ("north", "south", 0.5)}


def write_network(path: Path, circumference: float) -> None:
    """Write a ring of one lane as a network of SUMO: two halves, without crossings."""
    radius = 0.5 * circumference / math.pi
    root = ElementTree.Element("net", version="1.20")
    bounds = f"{-radius:.2f},{-radius:.2f},{radius:.2f},{radius:.2f}"
    where = {"convBoundary": bounds, "origBoundary": bounds, "projParameter": "!"}
    ElementTree.SubElement(root, "location", {"netOffset": "0.00,0.00", **where})
    for name, (begin, end, turn) in HALVES.items():
        angles = math.pi * (turn + np.linspace(0.0, 1.0, CORNERS))
        points = (f"{radius * math.cos(x):.3f},{radius * math.sin(x):.3f}" for x in angles)
        edge = ElementTree.SubElement(root, "edge", {"id": name, "from": begin, "to": end})
        lane = {"id": f"{name}_0", "index": "0", "speed": f"{SPEED_LIMIT}"}
        lane |= {"length": f"{0.5 * circumference}", "shape": " ".join(points)}
        ElementTree.SubElement(edge, "lane", lane)
    for name, (_, end, turn) in HALVES.items():
        place = {"x": "0.00", "y": f"{-2.0 * turn * radius:.2f}"}
        node = {"id": end, "type": "priority", "incLanes": f"{name}_0", "intLanes": "", "shape": ""}
        junction = ElementTree.SubElement(root, "junction", node | place)
        ElementTree.SubElement(junction, "request", index="0", response="0", foes="0", cont="0")
    for begin, end in (("east", "west"), ("west", "east")):
        lanes = {"fromLane": "0", "toLane": "0", "dir": "s", "state": "M"}
        ElementTree.SubElement(root, "connection", {"from": begin, "to": end, **lanes})
    _write(root, path)


def write_vehicles(path: Path, cfg: StudyConfig, around: float, places: Sequence[float]) -> None:
    """Write the vehicles at their places; each follows the one of the number before."""
    scenario, driver = cfg.scenario, cfg.drivers.settings
    root = ElementTree.Element("routes")
    of_type = {
        "carFollowModel": "IDM",
        "length": scenario.vehicle_length,
        "tau": driver["time_gap"],
    }
    of_type |= {"accel": driver["acceleration"], "decel": driver["deceleration"]}
    of_type |= {"minGap": driver["min_gap"], "maxSpeed": driver["desired_speed"]}
    fixed = {"id": HUMAN, "speedFactor": "1", "speedDev": "0"}
    text = {key: str(value) for key, value in of_type.items()}
    ElementTree.SubElement(root, "vType", fixed | text)
    for number, place in enumerate(places):
        edges = ("east", "west") if place < 0.5 * around else ("west", "east")
        start = {"departPos": f"{place % (0.5 * around):.6f}", "depart": "0"}
        start |= {"id": f"car{number}", "type": HUMAN, "departSpeed": str(scenario.initial_speed)}
        start["insertionChecks"] = "none"  # they are where the task puts them, however near
        vehicle = ElementTree.SubElement(root, "vehicle", start)
        ElementTree.SubElement(vehicle, "route", edges=" ".join(edges), repeat=str(ROUNDS))
    _write(root, path)


def _write(root: ElementTree.Element, path: Path) -> None:
    ElementTree.indent(root)
    with atomic_path(path) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)


def start(cfg: StudyConfig, folder: Path, around: float, places: Sequence[float] = ()) -> None:
    """Start SUMO on a ring, ``around`` [m], with vehicles at places [m], by default evenly spread.

    Its files go into a folder.
    """
    count = len(parse_string(cfg.scenario.string).roles)
    places = places or [around * (1.0 - (number + 0.5) / count) for number in range(count)]
    sumo, step = load_sumo(), cfg.scenario.time_step
    write_network(folder / "ring.net.xml", around)
    write_vehicles(folder / "ring.rou.xml", cfg, around, places)
    words = ["sumo", "-n", f"{folder}/ring.net.xml", "-r", f"{folder}/ring.rou.xml"]
    words += ["--step-length", str(step), "--step-method.ballistic", "true", "--no-step-log"]
    sumo.start([*words, "--collision.action", "warn", "--no-warnings", "true"])
    sumo.simulationStep()


# -- strings ---------------------------------------------------------------------------------------

SIZE, SUMO = 100, "libsumo"


def string(options: Namespace) -> list[Row]:
    """Return vehicle-steps per second of strings of 100 vehicles.

    First a batch behind automated vehicles that keep their speed, with the estimate of every
    driver and the reward, by the training's collector, beside the same physics as one function of
    tensors. Then a single ring of human drivers by the evaluation's player, which keeps speeds and
    gaps, beside SUMO, which drives its own IDM and keeps nothing.
    """
    return [*batch(options), *ring(options)]


def batch(options: Namespace) -> list[Row]:
    """Return the rows of many strings side by side."""
    count, steps = (4, 10) if options.quick else (1024, 30)
    rows: list[Row] = []
    for ending in endings(options):
        own, other = f"StringCollector{ending}", f"plain loop{ending}"
        every = ways(options, count, steps, ending, SIZE - 1)
        runs = {name: every[name] for name in (own, other)}
        moved = count * steps * SIZE
        rows += rates(options, runs, "vehicle-steps/s", moved, {own: [other]}, count)
    return rows


def ring(options: Namespace) -> list[Row]:
    """Return the rows of one ring; both are first checked to reach the same speeds."""
    steps, around = 20 if options.quick else 600, 23.0 * SIZE
    size = [f'scenario.string="human*{SIZE}"', f"scenario.circumference={around}"]
    fixed = [f"scenario.horizon={steps}"]
    fixed += [f"scenario.controllers.human.{noise}=0" for noise in ("noise", "wiener")]
    cfg = load("evaluate", ["variant=idm", "scenario=ring", "drivers=fixed", *size, *fixed])
    inputs, key = load_inputs(cfg), ("vehicles", "speed")
    runs: dict[str, Run] = {}
    for ending in endings(options):
        env = build_env(cfg, inputs.evaluation, inputs.population, 1)
        player = Player(env, None, [key, ("vehicles", "gap")], compiled=bool(ending))
        runs[f"Player{ending}"] = partial(player.play, TensorDict(batch_size=[1]))
    against = {name: [SUMO] for name in runs}
    speed = player.play(TensorDict(batch_size=[1]))[0][key][-1]
    how = "vehicle-steps/s", steps * SIZE, against, 1
    if find_spec("libsumo") is None:
        return rates(options, runs, *how)
    sumo = load_sumo()

    def simulate() -> None:
        for _ in range(steps):
            sumo.simulationStep()

    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as name:
        start(cfg, Path(name), around)
        try:
            simulate()
            theirs = [sumo.vehicle.getSpeed(f"car{number}") for number in range(SIZE)]
            agree("SUMO's speed [m/s]", theirs, speed.flatten(), 1e-3)
            return rates(options, {**runs, SUMO: simulate}, *how)
        finally:
            sumo.close()


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
        spent, (case, *peers) = alternate(named, options.repeats, time.process_time), named
        rows += rows_of(spent, "s of the processor", {case: peers}, episodes)
    return rows
