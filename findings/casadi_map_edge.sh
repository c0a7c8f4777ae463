#!/usr/bin/env bash
# CasADi 3.8.2 `interpolant`, an efficiency map, outside of its grid: "linear" extrapolates on all
# sides, "bspline" is 0 from the edge on; no warning.
# Guess before: both keep the value of the edge, as numpy.interp does.
# Seen: a map from 20 to 160 Nm and 2,000 to 8,000 rpm has 1.08 at 700 Nm, and 0.32 instead of 0.60
# at 1 Nm and 300 rpm; as a spline it is 0 at 19.9 Nm and at 160.1 Nm.
# Hurt: optimal speed profiles: power is torque times speed over efficiency, at low load infinite.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq casadi==3.8.2 numpy==2.4.1 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import sys

import casadi
import numpy as np

TORQUE, SPEED = [20.0, 40.0, 80.0, 160.0], [2000.0, 4000.0, 8000.0]  # Nm, rpm
MAP = np.array([[0.60, 0.66, 0.70], [0.82, 0.85, 0.86], [0.90, 0.92, 0.91], [0.92, 0.94, 0.93]])
values = MAP.ravel(order="F")
linear = casadi.interpolant("linear", "linear", [TORQUE, SPEED], values)
spline = casadi.interpolant("spline", "bspline", [TORQUE, SPEED], values, {"degree": [3, 1]})
found = {}
for torque, speed in ((60, 4000), (700, 4000), (1, 300), (19.9, 4000), (160.1, 4000), (60, 8100)):
    edge = [min(max(x, axis[0]), axis[-1]) for x, axis in ((torque, TORQUE), (speed, SPEED))]
    found[torque, speed] = [float(f([torque, speed])) for f in (linear, spline)]
    kept = float(linear(edge))
    print(f"{torque:6g} Nm, {speed:5g} rpm: linear {found[torque, speed][0]:6.3f}, "
          f"bspline {found[torque, speed][1]:6.3f}, edge of the map {kept:.3f}")
beyond = [pair for place, pair in found.items() if place != (60, 4000)]
same = found[700, 4000][0] > 1 and found[1, 300][0] < 0.35
sys.exit(0 if same and all(pair[1] == 0 for pair in beyond) and found[60, 4000][1] > 0 else 1)
EOF
