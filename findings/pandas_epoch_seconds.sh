#!/usr/bin/env bash
# pandas 3.1.1: `to_datetime(milliseconds, unit="ms").astype("int64") / 1e9`, the usual way to
# seconds, gives a thousandth of them: the unit is no longer always nanoseconds.
# Guess before: nanoseconds. Seen: microseconds for whole numbers, nanoseconds for floating ones,
# milliseconds in pandas 3.0.0: a step of 0.1 s becomes 0.0001 s.
# Hurt: who differentiates Global_Time of NGSIM or logger times: accelerations 1,000 times too
# large.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq pandas==3.1.1 numpy==2.4.1 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import sys

import pandas as pd

milliseconds = pd.Series([1113433135100 + 100 * k for k in range(4)])
speed = pd.Series([10.0, 10.1, 10.2, 10.3])
whole = pd.to_datetime(milliseconds, unit="ms")
floating = pd.to_datetime(milliseconds / 1000, unit="s")
found = {}
for name, time in (("whole milliseconds", whole), ("floating seconds", floating)):
    seconds = time.astype("int64") / 1e9
    found[name] = (speed.diff() / seconds.diff()).mean()
    step = seconds.diff().mean()
    print(f"{name}: {time.dtype}, step {step:.4f} s, acceleration {found[name]:.1f} m/s²")
right = (speed.diff() / whole.diff().dt.total_seconds()).mean()
print(f"by dt.total_seconds(): {right:.1f} m/s²")
changed = abs(found["whole milliseconds"] - 1000) > 1 or abs(found["floating seconds"] - 1) > 0.01
sys.exit(1 if changed or abs(right - 1) > 0.01 else 0)
EOF
