#!/usr/bin/env bash
# SUMO's netconvert 1.28 reads OpenDRIVE limits of lanes, not of roads: a road whose <type> says
# 130 km/h, as scenariogeneration 0.16.7 writes it, has 50 km/h in the network.
# Guess before: the road's limit holds where a lane has none. A trial of slopes showed another one.
# Seen: 13.89 m/s for each limit, unit and kind of road, "Success." and no warning; the same limit
# at the lanes is read. Its page names lanes' limits and, without them, defaults of 80 km/h.
# Hurt: travel times, energy and speed advice on maps that were drawn for driving simulators.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        eclipse-sumo==1.28.0 scenariogeneration==0.16.7 numpy==2.4.6 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import re
import subprocess
import sys
from pathlib import Path

import sumo
from scenariogeneration import xodr

netconvert = f"{sumo.SUMO_HOME}/bin/netconvert"


def read(limit: float, unit: str, kind: xodr.RoadType, at_lanes: bool) -> tuple[set, str]:
    """Write a kilometre of straight road, return the limits in its network and the messages."""
    road = xodr.create_road([xodr.Line(1000)], id=1, left_lanes=0, right_lanes=2)
    if not at_lanes:
        road.add_type(kind, 0, speed=limit, speed_unit=unit)
    file = xodr.OpenDrive("map")
    file.add_road(road)
    file.adjust_roads_and_lanes()
    file.write_xml("map.xodr")
    text = Path("map.xodr").read_text()
    if at_lanes:  # the package has no limits of lanes
        speed = f'<speed sOffset="0" max="{limit}" unit="{unit}"/>'
        text = re.sub(r"(<width .*/>)", rf"\1{speed}", text)
        Path("map.xodr").write_text(text)
    assert text.count(f'max="{limit}" unit="{unit}"') == (2 if at_lanes else 1), text
    done = subprocess.run([netconvert, "--opendrive", "map.xodr", "-o", "map.net.xml"],
                          capture_output=True, text=True, check=True)
    lanes = re.findall(r'<lane [^>]*speed="([\d.]+)"', Path("map.net.xml").read_text())
    return set(map(float, lanes)), (done.stdout + done.stderr).strip()


found = {}
for limit, unit, kind in (
    (130, "km/h", xodr.RoadType.motorway),
    (60, "mph", xodr.RoadType.rural),
    (8.33, "m/s", xodr.RoadType.town),
):
    for at_lanes in (False, True):
        found[limit, at_lanes], said = read(limit, unit, kind, at_lanes)
        print(f"{limit} {unit} of the {'lanes' if at_lanes else 'road '}: read as",
              *found[limit, at_lanes], f"m/s; {said!r}")
        assert "arning" not in said
roads = [found[limit, False] for limit in (130, 60, 8.33)]
lanes = [found[limit, True] for limit in (130, 60, 8.33)]
sys.exit(0 if roads == [{13.89}] * 3 and lanes == [{36.11}, {26.82}, {8.33}] else 1)
EOF
