"""A ring of one lane in SUMO, for the benchmark of strings and the tests of the bridge."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from lcc_rl.config.schemas import StudyConfig
from lcc_rl.functional.pattern import parse_string
from lcc_rl.interfaces.sumo import load_sumo
from lcc_rl.io.atomic import atomic_path

HUMAN = "human"
SPEED_LIMIT, CORNERS, AROUND = 40.0, 32, 100  # of the road [m/s]; of a half; rounds of a route
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
        ElementTree.SubElement(vehicle, "route", edges=" ".join(edges), repeat=str(AROUND))
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
