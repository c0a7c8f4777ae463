#!/usr/bin/env bash
# scipy's two ways to a coarser raster change a constant speed: `decimate` by -1.1 % everywhere,
# `resample_poly` by -40 % at both ends (scipy 1.17.1).
# Guess before: a car that drives 30 m/s all the time drives 30 m/s afterwards, too.
# Seen: 29.66 m/s for every factor, 2.3 % less kinetic energy; 18.0 m/s first, then 145 m/s2.
# Hurt: who brings a log of 50 Hz to the 10 Hz of a car-following model and sums up energy.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        scipy==1.17.1 numpy==2.4.1 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import sys

import numpy as np
from scipy.signal import decimate, resample_poly

log = np.full(3000, 30.0)  # a minute at 50 Hz
found = []
for factor in (2, 5, 10):
    speed = decimate(log, factor)
    found.append(speed.mean() / 30.0 - 1.0)
    print(f"decimate by {factor}: {speed.min():.2f} to {speed.max():.2f} m/s ({found[-1]:+.2%})")
speed = resample_poly(log, 1, 5)
rise = (speed[1] - speed[0]) / 0.1
print(f"resample_poly: begins with {speed[0]:.1f}, {speed[1]:.1f} m/s ({rise:.0f} m/s2)")
print(f"resample_poly: ends with {speed[-2]:.1f}, {speed[-1]:.1f} m/s")
same = np.allclose(found, 10.0 ** (-0.1 / 20.0) - 1.0, atol=1e-6)  # 0.05 dB, forth and back
sys.exit(0 if same and abs(speed[0] - 18.0) < 0.1 and abs(rise - 145.0) < 1.0 else 1)
EOF
