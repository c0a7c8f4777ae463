#!/usr/bin/env bash
# SUMO 1.28: its three models of electric cars do not agree on what one wave costs: driven at a
# steady speed the same kilometre takes 8 % (HBEFA4/PC_BEV), 19 % (Energy) or 25 % (MMPEVEM) less.
# Guess before: 35, 30 and 30 %.
# Seen: a factor of three, in the other order (defaults; wave 20-5-20 m/s at 1 m/s²).
# Hurt: who reports the saving of smoother driving for electric cars from one of them.
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
    '<node id="b" x="3000" y="0"/></nodes>')
open("n.edg.xml", "w").write(
    '<edges><edge id="e" from="a" to="b" '
    'numLanes="1" speed="30"/></edges>')
subprocess.run(["venv/bin/netconvert", "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "n.net.xml"],
               check=True, stdout=subprocess.DEVNULL)
MEAN = 20 - 15 * 25 / 70  # of the wave below over 70 s


def energy(model, wave):
    """Return kJ/km over 70 s."""
    open("r.rou.xml", "w").write(
        f'<routes><vType id="F" speedDev="0" emissionClass="{model}"/><route id="r" edges="e"/>'
        '<vehicle id="0" type="F" route="r" depart="0" departPos="100" departSpeed="20"/></routes>')
    libsumo.start(["sumo", "-n", "n.net.xml", "-r", "r.rou.xml", "--step-length", "0.1",
                   "--no-step-log", "--no-warnings", "true", "--device.battery.probability", "1"])
    car = libsumo.vehicle
    libsumo.simulationStep()
    car.setSpeedMode("0", 0)
    wh = start = 0.0
    for step in range(-20, 700):
        t = max(0, 0.1 * step)
        speed = 20 - min(max(t - 10, 0), 15) + min(max(t - 35, 0), 15)
        car.setSpeed("0", speed if wave else MEAN)
        libsumo.simulationStep()
        if step < 0:
            start = car.getDistance("0")
        else:
            wh += 0.1 * car.getElectricityConsumption("0")
    distance = car.getDistance("0") - start
    libsumo.close()
    return 3600 * wh / distance


expected = {"HBEFA4/PC_BEV": 8, "Energy/unknown": 19, "MMPEVEM": 25}
found = {}
for model in expected:
    wave, steady = energy(model, True), energy(model, False)
    found[model] = 100 * (1 - steady / wave)
    print(f"{model:15} wave {wave:.0f}, steady {steady:.0f} kJ/km: saved {found[model]:.0f} %")
sys.exit(0 if all(abs(found[m] - e) < 2 for m, e in expected.items()) else 1)
EOF
