"""The task ``ring-22`` in SUMO: human drivers by SUMO's IDM, one vehicle by a policy or rule.

    python tools/sumo_ring.py pretrained/ring-22 --from-s 300

The first vehicle alone may be automated, and all humans are the driver of ``drivers=fixed``.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd

from lcc_rl.cli.guard import main_guard
from lcc_rl.config import load
from lcc_rl.config.schemas import StudyConfig, as_plain
from lcc_rl.errors import ConfigError
from lcc_rl.figures.drawing import save
from lcc_rl.figures.space_time import space_time
from lcc_rl.functional.pattern import parse_string
from lcc_rl.interfaces.sumo import Bridge, load_sumo
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import write_parquet

HUMAN, FIRST = "human", "car0"
LAST_S, CALM = 60.0, 0.5  # final speeds are of [s]; spread of the speeds without a wave [m/s]
SPEED_LIMIT, CORNERS, AROUND = 40.0, 32, 10_000  # of the road [m/s]; of a half; rounds of a route
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


def write_vehicles(path: Path, cfg: StudyConfig, around: float) -> None:
    """Write the vehicles, evenly spread; each follows the one of the number before."""
    scenario, driver = cfg.scenario, cfg.drivers
    count = len(parse_string(scenario.string).roles)
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
    for number in range(count):
        place = around * (1.0 - (number + 0.5) / count)
        edges = ("east", "west") if place < 0.5 * around else ("west", "east")
        start = {"departPos": f"{place % (0.5 * around):.6f}", "depart": "0"}
        start |= {"id": f"car{number}", "type": HUMAN, "departSpeed": str(scenario.initial_speed)}
        start["insertionChecks"] = "none"  # they are where the task puts them, however near
        vehicle = ElementTree.SubElement(root, "vehicle", start)
        ElementTree.SubElement(vehicle, "route", edges=" ".join(edges), repeat=str(AROUND))
    _write(root, path)


def _write(root: ElementTree.Element, path: Path) -> None:
    ElementTree.indent(root)
    with atomic_path(path) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)


def start(cfg: StudyConfig, folder: Path, around: float) -> None:
    """Start SUMO with all vehicles on the ring, ``around`` [m]; its files go into a folder."""
    sumo, step = load_sumo(), cfg.scenario.time_step
    write_network(folder / "ring.net.xml", around)
    write_vehicles(folder / "ring.rou.xml", cfg, around)
    words = ["sumo", "-n", f"{folder}/ring.net.xml", "-r", f"{folder}/ring.rou.xml"]
    words += ["--step-length", str(step), "--step-method.ballistic", "true", "--no-step-log"]
    sumo.start([*words, "--collision.action", "warn", "--no-warnings", "true"])
    sumo.simulationStep()


def simulate(
    cfg: StudyConfig, driver: str | None, folder: Path, seconds: float, from_s: float, seed: int
) -> pd.DataFrame:
    """Simulate the ring in SUMO.

    Args:
        cfg: a configuration with ``scenario=ring`` and ``drivers=fixed``.
        driver: who drives the first vehicle from ``from_s`` [s] on, see :class:`Bridge`; None:
            SUMO's IDM.
        folder: where SUMO's files are written.
        seconds: how long [s].
        seed: of the random walk of the humans' speeds.

    Returns:
        Rows as in steps.parquet, and the number of vehicles in collisions at each step.
    """
    sumo, step, around = load_sumo(), cfg.scenario.time_step, cfg.scenario.circumference
    if around is None:
        raise ConfigError("SUMO's ring needs scenario.circumference")
    start(cfg, folder, around)
    try:
        bridge = None if driver is None else Bridge(driver, FIRST, seed=seed, trust=list(cfg.trust))
        noise = np.random.default_rng(seed)
        rows = []
        for number in range(round(seconds / step)):
            drives = bridge is not None and number * step >= from_s
            if bridge is not None:
                bridge.command(drives)
            rows.append({"time_s": number * step, **_row(sumo, driver is not None)})
            sumo.simulationStep()
            _disturb(sumo, noise, float(cfg.scenario.controllers["human"]["wiener"]), step, drives)
    finally:
        sumo.close()
    return pd.DataFrame(rows).assign(
        strategy=driver or HUMAN, profile=0, driver_id=0, training_seed=np.nan
    )


def _disturb(sumo: Any, noise: np.random.Generator, wiener: float, step: float, but: bool) -> None:
    """Add a random walk [m/s per √s] to the speeds of the human drivers: SUMO's have no noise."""
    cars = sumo.vehicle
    draws = wiener * step**0.5 * noise.standard_normal(cars.getIDCount())
    for number, draw in enumerate(draws[but:], int(but)):
        cars.setPreviousSpeed(f"car{number}", max(cars.getSpeed(f"car{number}") + draw, 0.0))


def _row(sumo: Any, automated: bool) -> dict[str, float]:
    """Return speed, gap and acceleration of every vehicle, named as in steps.parquet."""
    cars, found = sumo.vehicle, {}
    for number in range(cars.getIDCount()):
        car, behind = f"car{number}", number + 1 - automated
        name = f"hdv{behind}" if behind else "cav"
        found[f"{name}_speed"] = cars.getSpeed(car)
        found[f"{name}_gap"] = cars.getLeader(car, 1e3)[1] + cars.getMinGap(car)
        found[f"{name}_acceleration"] = cars.getAcceleration(car)
    return {**found, "collisions": sumo.simulation.getCollidingVehiclesNumber()}


def measured(rows: pd.DataFrame, from_s: float) -> dict[str, float]:
    """Return what happens from ``from_s`` [s] on.

    The damping time is how long after it the spread of the speeds over the vehicles last exceeds
    0.5 m/s, NaN where it still does at the end; final speeds are those of the last minute, the
    smallest gap is that of the first vehicle.
    """
    rows = rows.dropna(axis=1, how="all")
    rows = rows[rows["time_s"] >= from_s]
    speeds, time = rows.filter(regex="_speed$"), rows["time_s"]
    spread, final = speeds.std(axis=1, ddof=0), time >= time.max() - LAST_S
    lasting = spread.iloc[-1] > CALM
    return {
        "damping_s": math.nan if lasting else time[spread > CALM].max() - from_s,
        "final_speed_mps": speeds[final].mean(axis=None),
        "final_spread_mps": spread[final].mean(),
        "min_gap_m": rows["cav_gap" if "cav_gap" in rows else "hdv1_gap"].min(),
        "collisions": rows["collisions"].sum(),
    }


def main(words: Sequence[str] | None = None) -> int:
    """Simulate the ring without and with a policy; write trajectories and a figure."""
    parser = argparse.ArgumentParser(description="The ring road of task=ring-22 in SUMO.")
    parser.add_argument("driver", help="run folder, policy.pt, pretrained/<name> or a rule")
    parser.add_argument("overrides", nargs="*", help="settings, as scenario.circumference=230")
    parser.add_argument("--from-s", type=float, default=300.0, help="start of its driving [s], 300")
    parser.add_argument("--seconds", type=float, default=600.0, help="duration [s], 600")
    parser.add_argument("--seed", type=int, default=0, help="seed of the humans' noise, 0")
    parser.add_argument("--folder", type=Path, default=Path("outputs/sumo"))
    options = parser.parse_intermixed_args(words)
    if options.seconds <= options.from_s:
        raise ConfigError(f"--seconds={options.seconds:g} must exceed --from-s={options.from_s:g}")
    cfg = load("evaluate", ["variant=alcc", "task=ring-22", *options.overrides])
    options.folder.mkdir(parents=True, exist_ok=True)
    fixed = (options.folder, options.seconds, options.from_s, options.seed)
    parts = [simulate(cfg, driver, *fixed) for driver in (None, options.driver)]
    steps = pd.concat(parts, ignore_index=True)
    write_parquet(steps, options.folder / "steps.parquet")
    figure = space_time(steps, [HUMAN, options.driver], as_plain(cfg))
    assert figure is not None
    figure.axes[1].axvline(options.from_s, color="black", linestyle=":", linewidth=1.0)
    title = f"{options.driver}, from {options.from_s:g} s on"
    figure.axes[1].set_title(title, fontsize=figure.axes[0].title.get_fontsize())
    save(figure, options.folder / "space_time.png", dpi=150)
    rows = [measured(part, options.from_s) for part in parts]
    print(pd.DataFrame(rows, [HUMAN, options.driver]).round(2).to_string())
    print(f"{options.folder}: steps.parquet, space_time.png, ring.net.xml, ring.rou.xml")
    return 0


if __name__ == "__main__":
    main_guard(main)()
