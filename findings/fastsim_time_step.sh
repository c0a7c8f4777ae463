#!/usr/bin/env bash
# FASTSim's car with an engine drives the UDDS at 1 Hz, not interpolated to 2 or 10 Hz (fastsim
# 3.1.0). Guess before: energies at 0.1 s are those at 1 s within 1 %.
# Seen: so for a battery car and a hybrid (0.3 %). The 2012 Ford Fusion "failed to meet speed
# trace": 75 W of 27 kW are missing after 197 s. Its engine's power rises too slowly.
# Hurt: who prices simulated drives of 0.1 s.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq fastsim==3.1.0 numpy==2.4.6 || exit 2
cd "$folder"
venv/bin/python -W ignore - <<'EOF'
import sys

import fastsim
import numpy as np

CARS = {
    "2012_Ford_Fusion": "veh.pt_type.Conv.fc.history.energy_fuel_joules",
    "2016_TOYOTA_Prius_Two": "veh.pt_type.HEV.fc.history.energy_fuel_joules",
    "2022_Renault_Zoe_ZE50_R135": "veh.pt_type.BEV.res.history.energy_out_chemical_joules",
}


def energy(car, column, step):
    given = fastsim.Cycle.from_resource("udds.csv").to_pydict()
    time, speed = (np.array(given[x]) for x in ("time_seconds", "speed_meters_per_second"))
    fine = np.arange(0.0, time[-1] + 1e-9, step)
    rest = {name: x for name, x in given.items() if not isinstance(x, list) and name != "len"}
    speeds = np.interp(fine, time, speed).tolist()
    cycle = {"time_seconds": fine.tolist(), "speed_meters_per_second": speeds}
    cycle = fastsim.Cycle.from_pydict({**rest, **cycle, "grade": [0.0] * len(fine)})
    drive = fastsim.SimDrive(fastsim.Vehicle.from_resource(f"{car}.yaml"), cycle)
    try:
        drive.walk()
    except Exception as error:
        return next(x for x in str(error).splitlines() if "failed to meet" in x)
    return float(drive.to_dataframe()[column].iloc[-1]) / 1e6


found = {car: [energy(car, x, step) for step in (1.0, 0.5, 0.1)] for car, x in CARS.items()}
for car, values in found.items():
    shown = (x if isinstance(x, str) else f"{x:.2f} MJ" for x in values)
    print(car, dict(zip(("1 s", "0.5 s", "0.1 s"), shown)))
engine, *others = found.values()
same = all(max(x) / min(x) < 1.01 for x in others)
sys.exit(0 if isinstance(engine[0], float) and isinstance(engine[2], str) and same else 1)
EOF
