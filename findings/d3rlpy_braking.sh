#!/usr/bin/env bash
# d3rlpy: a driver cloned from logged accelerations of -3 to 2 m/s2 never brakes by more than
# 1 m/s2 (d3rlpy 2.8.1): without an `action_scaler` all actions are between -1 and 1.
# Guess before: an error or a warning about actions outside of its range, or a policy that brakes.
# Seen: no word of it; with a scaler the same network, data and steps brake by 3 m/s2.
# Hurt: who learns from recorded drivers (behaviour cloning, offline RL) in m/s2.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        d3rlpy==2.8.1 torch==2.13.0 gymnasium==1.0.0 numpy==2.4.1 || exit 2
cd "$folder"
cat >clone.py <<'EOF'
import sys
import warnings

import d3rlpy
import numpy as np

scaled = sys.argv[1] == "scaled"
draw = np.random.default_rng(0).uniform
speed, gap, closing = draw(0.0, 30.0, 4000), draw(2.0, 80.0, 4000), draw(-5.0, 5.0, 4000)
logged = np.clip(0.2 * (gap - 2.0 - 1.4 * speed) - 0.8 * closing, -3.0, 2.0)
seen = np.stack([speed, gap, closing], 1).astype(np.float32)
ends = np.arange(4000) % 100 == 99
drives = d3rlpy.dataset.MDPDataset(seen, logged[:, None].astype(np.float32), logged, ends)
driver = d3rlpy.algos.BCConfig(
    observation_scaler=d3rlpy.preprocessing.StandardObservationScaler(),
    action_scaler=d3rlpy.preprocessing.MinMaxActionScaler() if scaled else None,
).create(device="cpu")
silent = d3rlpy.logging.NoopAdapterFactory()
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    driver.fit(drives, 500, 500, show_progress=False, logger_adapter=silent)
braking = driver.predict(seen).min()
print(f"logged {logged.min():.2f}, cloned ({sys.argv[1]}) {braking:.2f} m/s2")
assert not [x for x in said if "action" in str(x.message)]
sys.exit(0 if (braking < -2.5 if scaled else -1.0 <= braking < -0.9) else 1)
EOF
export OMP_NUM_THREADS=1
for kind in plain scaled; do
    venv/bin/python -W ignore clone.py "$kind" >"$kind.log" 2>&1 || { cat "$kind.log"; exit 1; }
    grep logged "$kind.log"
    grep -i "out of range\|clipped" "$kind.log" && exit 1
done
exit 0
