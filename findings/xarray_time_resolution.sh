#!/usr/bin/env bash
# xarray: acceleration and distance of logged speeds by `differentiate`, `integrate` (2026.9.0).
# Guess before: a factor of 1,000 from one resolution of stored times to the next, no warning.
# Seen: with times in s a braking of 2 m/s², in ms 0.002, in µs, as pandas 3 makes them, 2e-6, in ns
# 2e-9, without a word; 64 m become 64 million.
# Hurt: who derives accelerations or adds up distances of logs read by different readers.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        xarray==2026.9.0 pandas==3.1.1 numpy==2.4.6 || exit 2
cd "$folder"
venv/bin/python -W error - <<'EOF'
import sys

import numpy as np
import pandas as pd
import xarray as xr

braking = pd.Series(
    [20.0, 18.0, 16.0, 14.0, 12.0], pd.date_range("2026-05-01 08:00:00", periods=5, freq="1s")
)  # speed [m/s], a sample a second
braking.index.name = "time"
found = {}
for unit in ("s", "ms", "us", "ns"):
    log = braking.copy()
    log.index = log.index.as_unit(unit)
    speed = log.to_xarray()
    found[unit] = float(speed.differentiate("time")[2])
    print(f"{unit:>2}: {found[unit]:g} m/s², {float(speed.integrate('time')):g} m")
made = np.datetime_data(braking.index.dtype)[0]
print(f"pandas {pd.__version__} itself makes {made}")
factor = found["s"] / np.array([found[unit] for unit in ("ms", "us", "ns")])
sys.exit(0 if found["s"] == -2.0 and np.allclose(factor, [1e3, 1e6, 1e9]) else 1)
EOF
