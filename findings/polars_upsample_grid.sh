#!/usr/bin/env bash
# polars `upsample(…).interpolate()` discards samples that are not on the grid (polars 1.44.2). A
# log of 10 Hz whose clock, in ms, scatters by 10 ms: a car brakes from 20 to 8 m/s by 6 m/s².
# Guess before: a value on the grid is interpolated between the samples on both sides of it.
# Seen: 4 % of the samples are kept. The braking becomes 1.2 m/s², speeds are wrong by 7 m/s, only
# the last second is missing. pandas 3.1.1 (`resample("100ms").interpolate()`) is right to 0.3 m/s.
# Hurt: logs that are brought to a raster before drivers are fitted or energies are computed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq polars==1.44.2 pandas==3.1.1 numpy==2.4.6 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import sys
from datetime import datetime, timedelta

import numpy as np
import pandas as pd
import polars as pl


def driven(time):
    return np.interp(time, [0, 30, 32, 40, 200], [20, 20, 8, 20, 20])


rng = np.random.default_rng(0)
time = np.round(np.arange(1200) / 10 + np.r_[0.0, rng.normal(0.0, 0.01, 1199)], 3)
start = datetime(2026, 1, 1)
stamps = [start + timedelta(milliseconds=round(1e3 * x)) for x in time]
log = pl.DataFrame({"time": stamps, "speed": driven(time)})
grid = log.upsample("time", every="100ms")
whole = grid.interpolate()
found = whole.drop_nulls()
true = driven(np.array([(x - start).total_seconds() for x in found["time"]]))
speed = found["speed"].to_numpy()
wrong, hardest = np.abs(speed - true).max(), np.diff(speed).min() / 0.1
other = pd.Series(driven(time), pd.to_datetime(stamps)).resample("100ms").interpolate()
seconds = (other.index - other.index[0]).total_seconds().to_numpy()
print(f"polars: {1 - grid['speed'].null_count() / len(grid):.1%} of the grid filled, "
      f"{len(whole) - len(found)} missing at the end, error {wrong:.2f} m/s, "
      f"hardest braking {hardest:.2f} m/s²")
print(f"pandas: error {np.abs(other.to_numpy() - driven(seconds)).max():.2f} m/s")
sys.exit(0 if wrong > 5 and hardest > -2 and len(whole) - len(found) < 20 else 1)
EOF
