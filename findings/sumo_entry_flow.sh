#!/usr/bin/env bash
# SUMO 1.28: how many cars an hour enter a lane with departSpeed="max" depends on the driver model
# and on the step (one kind of car, limit 30 m/s, defaults, sigma 0, demand 3,600 veh/h).
# Guess before: 1,600 to 1,800 veh/h for IDM at 0.1 s. Seen: IDM 1,370, Krauss 2,800, at a step of
# 1 s 1,490 and 2,130.
# Hurt: who raises demand or the share of automated cars and reads the flow behind the entrance.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        eclipse-sumo==1.28.0 libsumo==1.28.0 numpy==2.4.1 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import subprocess
import sys

import libsumo

open("n.nod.xml", "w").write(
    '<nodes><node id="a" x="0" y="0"/><node id="b" x="6000" y="0"/></nodes>')
open("n.edg.xml", "w").write(
    '<edges><edge id="e" from="a" to="b" numLanes="1" speed="30"/></edges>')
subprocess.run(["venv/bin/netconvert", "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "n.net.xml"],
               check=True, stdout=subprocess.DEVNULL)


def entered(model, step):
    """Return vehicles per hour of a demand of 3,600."""
    open("r.rou.xml", "w").write(
        f'<routes><vType id="F" speedDev="0" sigma="0" carFollowModel="{model}"/>'
        '<route id="r" edges="e"/><flow id="f" type="F" route="r" begin="0" end="600" '
        'period="1" departSpeed="max"/></routes>')
    libsumo.start(["sumo", "-n", "n.net.xml", "-r", "r.rou.xml", "--step-length", str(step),
                   "--no-step-log", "--no-warnings", "true"])
    count = 0
    while libsumo.simulation.getTime() < 600:
        libsumo.simulationStep()
        count += libsumo.simulation.getDepartedNumber()
    libsumo.close()
    return 6 * count


expected = {("IDM", 0.1): 1374, ("IDM", 1.0): 1488, ("Krauss", 0.1): 2802, ("Krauss", 1.0): 2130}
found = {case: entered(*case) for case in expected}
for (model, step), flow in found.items():
    print(f"{model:7} step {step} s: {flow} veh/h enter")
sys.exit(0 if all(abs(found[c] / f - 1) < 0.05 for c, f in expected.items()) else 1)
EOF
