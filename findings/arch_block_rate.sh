#!/usr/bin/env bash
# arch 8.0.0: a stationary bootstrap of a drive's mean speed with `optimal_block_length`, from logs
# of 1, 10 and 100 Hz of the same 20 minutes.
# Guess before: blocks of as many seconds and intervals as wide, since the finer logs add nothing.
# Seen: 52, 27 and 10 s; of 100 intervals of 95 %, 90, 85 and 74 hold the true mean. Blocks end at
# 3 sqrt(n) samples, a limit without a warning or a word in the function's docstring.
# Hurt: who compares mean speeds, gaps or energies of controllers by logs of 10 Hz or CAN logs.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        arch==8.0.0 numpy==2.4.6 scipy==1.17.1 pandas==3.1.1 || exit 2
cd "$folder"
OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 venv/bin/python -W error - <<'EOF'
import sys

import numpy as np
from arch.bootstrap import StationaryBootstrap, optimal_block_length
from scipy.signal import lfilter

RATE, DRIVES = 100, 100
random = np.random.default_rng(0)
speeds = random.normal(size=(DRIVES, 1400 * RATE))
for lag in (20, 2):  # [s]: swings of a minute or two, accelerations of 0.5 m/s2
    kept = np.exp(-1 / (RATE * lag))
    speeds = lfilter([1], [1, -kept], speeds)
speeds = 20 + 3 * (speeds / speeds.std())[:, 200 * RATE :]
print(f"acceleration {np.diff(speeds).std() * RATE:.2f} m/s2 (standard deviation)")
need = np.ptp(np.quantile(speeds.mean(1), [0.025, 0.975]))
print(f"95 % of the drives' means lie within {need:.2f} m/s")
held, blocks, widths = {}, {}, {}
for rate in (1, 10, 100):
    logs = speeds[:, :: RATE // rate]
    lengths = [optimal_block_length(log)["stationary"].iloc[0] for log in logs]
    ends = np.array([
        StationaryBootstrap(length, log, seed=1).conf_int(np.mean, 200, method="percentile").ravel()
        for length, log in zip(lengths, logs, strict=True)
    ])
    blocks[rate], widths[rate] = np.mean(lengths) / rate, np.ptp(ends, axis=1).mean()
    held[rate] = int(((ends[:, 0] < 20) & (ends[:, 1] > 20)).sum())
    print(f"{rate:3} Hz: blocks of {blocks[rate]:.1f} s, intervals {widths[rate]:.2f} m/s wide;",
          f"{held[rate]} of {DRIVES} hold the true mean")
same = np.isclose(blocks[100], np.ceil(3 * np.sqrt(1200 * 100)) / 100) and blocks[1] > 40
same &= held[1] >= 85 and held[100] <= 80 and held[10] <= held[1]
sys.exit(0 if same and widths[100] < widths[10] < widths[1] and widths[100] < 0.8 * need else 1)
EOF
