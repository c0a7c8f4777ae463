#!/usr/bin/env bash
# pandas 3.1.1: `rolling`, `expanding` and `ewm` take infinity for a missing value, which `min`,
# `max`, `median` and `cummax` do not. Times to collision of an IDM driver, inf if not closing in.
# Guess before: infinity is a number: the mean or the largest of a window that has one is inf.
# Seen: `rolling(100).min() < 4` finds 540 of 2,060 windows of 10 s, the others are NaN;
# `rolling("10s")` finds all, but its medians are of the closing samples only: 79 s, not 133.
# Hurt: conflicts counted by the smallest TTC; gaps and time gaps, if no leader is written as inf.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq pandas==3.1.1 numpy==2.4.6 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import sys

import numpy as np
import pandas as pd

time = np.arange(6000) / 10
leader = np.interp(time % 30, [0, 10, 12.4, 24, 30], [20, 20, 8, 20, 20])
speed, gap, gaps, closing = 20.0, 32.0, [], []
for now in leader:  # an IDM driver; the leader brakes by 5 m/s² every 30 s
    gaps.append(gap)
    closing.append(speed - now)
    desired = 2 + max(0.0, speed * 1.2 + speed * closing[-1] / (2 * np.sqrt(1.2 * 2.0)))
    reached = max(0.0, speed + 0.1 * 1.2 * (1 - (speed / 33) ** 4 - (desired / gap) ** 2))
    gap += 0.1 * (now - (speed + reached) / 2)
    speed = reached
closing = np.array(closing)
ttc = np.divide(gaps, closing, out=np.full(len(time), np.inf), where=closing > 0)

series = pd.Series(ttc, pd.to_timedelta(time, unit="s"))
windows = np.lib.stride_tricks.sliding_window_view(ttc, 100)
conflicts = int((windows.min(axis=1) < 4).sum())
by_number = int((series.rolling(100).min() < 4).sum())
by_time = int((series.rolling("10s").min().iloc[99:] < 4).sum())
print(f"windows with a TTC below 4 s: {conflicts}; rolling(100) {by_number}, "
      f"rolling('10s') {by_time}")
true_median = np.median(np.median(windows, axis=1))
median = series.rolling("10s").median().iloc[99:].median()
print(f"typical median of a window: {true_median:.0f} s; rolling('10s') {median:.0f} s")
smoothed = series.ewm(halflife=10).mean().iloc[-1]
largest = series.cummax().iloc[-1], series.expanding().max().iloc[-1], smoothed
print("largest so far: cummax {} s, expanding().max() {:.0f} s; ewm {:.0f} s".format(*largest))
same = (conflicts, by_number, by_time) == (2060, 540, 2060) and np.isinf(largest[0])
sys.exit(0 if same and median < 0.7 * true_median and np.isfinite(largest[1:]).all() else 1)
EOF
