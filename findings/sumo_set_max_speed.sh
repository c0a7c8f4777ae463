#!/usr/bin/env bash
# SUMO 1.28, `vehicle.setMaxSpeed(id, 20)` of a car at 30 m/s: it brakes at its emergencyDecel of
# 9 m/s², not at decel, with Krauss and IDM, alone on the road.
# Guess before: at most decel, 4.5 m/s².
# Seen: 9 m/s² for 1.1 s and a warning on the console; `slowDown(id, 20, 10)` brakes at 1.2.
# Hurt: who gives a speed advice (variable limits, eco-driving) by setMaxSpeed and counts energy,
# emergency braking or collisions behind it.
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
    '<nodes><node id="a" x="0" y="0"/>'
    '<node id="b" x="6000" y="0"/></nodes>')
open("n.edg.xml", "w").write(
    '<edges><edge id="e" from="a" to="b" '
    'numLanes="1" speed="33"/></edges>')
subprocess.run(["venv/bin/netconvert", "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "n.net.xml"],
               check=True, stdout=subprocess.DEVNULL)


def hardest(model, advise):
    """Return the hardest braking [m/s²] and the speed after 20 s [m/s]."""
    open("r.rou.xml", "w").write(
        f'<routes><vType id="F" speedDev="0" sigma="0" decel="4.5" carFollowModel="{model}"/>'
        '<route id="r" edges="e"/><vehicle id="0" type="F" route="r" depart="0" departPos="100" '
        'departSpeed="30"/></routes>')
    libsumo.start(["sumo", "-n", "n.net.xml", "-r", "r.rou.xml", "--step-length", "0.1",
                   "--no-step-log"])
    libsumo.simulationStep()
    lowest = 0.0
    for step in range(250):
        if step == 50:
            advise(libsumo.vehicle)
        libsumo.simulationStep()
        lowest = min(lowest, libsumo.vehicle.getAcceleration("0"))
    speed = libsumo.vehicle.getSpeed("0")
    libsumo.close()
    return lowest, speed


found = {}
for model in ("Krauss", "IDM"):
    found[model], speed = hardest(model, lambda car: car.setMaxSpeed("0", 20))
    print(f"{model:7} setMaxSpeed: hardest braking {found[model]:.2f} m/s², then {speed:.1f} m/s")
gentle, _ = hardest("IDM", lambda car: car.slowDown("0", 20, 10))
print(f"IDM     slowDown over 10 s: hardest braking {gentle:.2f} m/s²")
sys.exit(0 if all(abs(a + 9) < 0.2 for a in found.values()) and gentle > -2 else 1)
EOF
