#!/usr/bin/env bash
# statsmodels 0.15.0's robust `lowess` (it=3) of a car that stands at a signal, then drives off.
# Guess before: how long it stands first changes nothing in the smoothed speeds of its drive.
# Seen: after 58 of 120 s they are up to 9 m/s off, with 44 m/s2; after 61 s they are those put in.
# No warning, no NaN. Speeds of exactly 0 leave no residual; their median is the scale of outliers.
# Hurt: who smooths drives with long stops before calibrating a model to their accelerations.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        statsmodels==0.15.0 numpy==2.4.6 scipy==1.17.1 pandas==3.1.1 || exit 2
cd "$folder"
venv/bin/python -W error - <<'EOF'
import sys

import numpy as np
from statsmodels.nonparametric.smoothers_lowess import lowess

time = np.arange(1200) / 10  # two minutes at 10 Hz
error = np.random.default_rng(0).normal(0, 0.3, len(time))


def smooth(standing: int, robust: int) -> tuple[float, float, float]:
    """Return largest error [m/s], largest acceleration [m/s2] and share of raw speeds."""
    true = np.clip(time - standing, 0, 12)  # 1 m/s2 up to 12 m/s
    seen = np.where(true > 0, true + error, 0)
    found = lowess(seen, time, frac=0.02, it=robust, return_sorted=False)
    drive = time > standing + 2
    acceleration = np.abs(np.gradient(found, 0.1))[drive].max()
    return np.abs(found - true)[drive].max(), acceleration, np.mean((found == seen)[drive])


found = {}
for robust in (0, 3):
    for standing in (40, 56, 58, 59, 60, 61):
        found[robust, standing] = off, acceleration, raw = smooth(standing, robust)
        print(f"it={robust}, standing for {standing} s: {off:.2f} m/s off, at most",
              f"{acceleration:.1f} m/s2, {raw:.0%} raw")
usual = [(0, 40), (0, 56), (0, 58), (0, 59), (0, 60), (0, 61), (3, 40)]
same = all(found[key][0] < 0.5 and found[key][2] < 0.01 for key in usual)
worst = np.max([found[3, standing] for standing in (58, 59, 60)], axis=0)
same &= worst[0] > 4 and worst[1] > 20
sys.exit(0 if same and found[3, 61][2] == 1 else 1)
EOF
