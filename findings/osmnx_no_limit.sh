#!/usr/bin/env bash
# OSMnx: speeds and travel times of a motorway, part of it without a speed limit (2.1.1).
# Guess before: `maxspeed=none` becomes the mean of the other motorways, without a mark.
# Seen: such parts get the mean of the limited parts of all motorways: 90 km/h between roadworks of
# 80 and 100; a lane at walking pace gets the 30 km/h of the streets around it. Nothing tells these
# speeds from signed ones.
# Hurt: who prices routes, or takes desired speeds of drivers from maps.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        osmnx==2.1.1 || exit 2
cd "$folder"
venv/bin/python -W error - <<'EOF'
import sys

import networkx
import osmnx

ROADS = [  # kind of road, its tag maxspeed, length [m]
    ("motorway", "none", 20_000.0),
    ("motorway", "100", 1_000.0),
    ("motorway", "80", 1_000.0),
    ("residential", "30", 500.0),
    ("living_street", "walk", 100.0),
    ("living_street", "30", 500.0),
]
graph = networkx.MultiDiGraph(crs="epsg:4326")
for place, (kind, limit, length) in enumerate(ROADS):
    graph.add_node(place, x=9.0 + 0.01 * place, y=50.0)
    graph.add_node(place + 1, x=9.01 + 0.01 * place, y=50.0)
    graph.add_edge(place, place + 1, osmid=place, highway=kind, maxspeed=limit, length=length)
timed = osmnx.routing.add_edge_travel_times(osmnx.routing.add_edge_speeds(graph))
found = []
for *_, edge in timed.edges(data=True):
    found.append(edge["speed_kph"])
    print(
        f"{edge['highway']:<14}{edge['maxspeed']:>5}: {edge['speed_kph']:.0f} km/h, "
        f"{edge['travel_time']:.0f} s"
    )
sys.exit(0 if found[0] == 90.0 and found[4] == 30.0 else 1)
EOF
