#!/usr/bin/env bash
# lmfit gives a parameter on a bound a small standard error (lmfit 1.3.4). An IDM driver, v0 =
# 33 m/s, in traffic of 5 to 11 m/s, gaps with errors of 0.3 m; the search allows v0 up to 20 m/s.
# Guess before: v0 ends on the bound, its standard error is None or large.
# Seen: 20 m/s ± 0.01 to 2.7 m/s, "Fit succeeded.": the error is scaled by the slope of the
# transformation that keeps a parameter inside, and on the bound there is none.
# Hurt: intervals of calibrated drivers; v0 looks known where the data say nothing.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq lmfit==1.3.4 numpy==2.4.6 scipy==1.17.0 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import sys

import lmfit
import numpy as np

TRUE = {"v0": 33.0, "T": 1.3, "s0": 2.0, "a": 1.2, "b": 1.6}
time = np.arange(600) / 10
leader = 8 + 3 * np.sin(2 * np.pi * time / 25)


def gaps(v0, T, s0, a, b):
    speed, gap, found = leader[0], 14.0, [14.0]
    for now, later in zip(leader[:-1], leader[1:]):
        desired = s0 + max(0.0, speed * T + speed * (speed - now) / (2 * np.sqrt(a * b)))
        command = a * (1 - (speed / v0) ** 4 - (desired / max(gap, 0.1)) ** 2)
        reached = max(0.0, speed + 0.1 * command)
        gap += 0.05 * (now + later - speed - reached)
        speed = reached
        found.append(gap)
    return np.array(found)


away = []
for seed in range(6):
    measured = gaps(**TRUE) + 0.3 * np.random.default_rng(seed).standard_normal(600)
    start = lmfit.Parameters()
    start.add("v0", 18.0, min=5.0, max=20.0)
    start.add("T", 1.0, min=0.3, max=3.0)
    start.add("s0", 2.5, min=0.5, max=5.0)
    start.add("a", 1.0, min=0.3, max=3.0)
    start.add("b", 1.5, min=0.3, max=5.0)
    fit = lmfit.minimize(lambda x: gaps(**x.valuesdict()) - measured, start)
    v0 = fit.params["v0"]
    error = float("inf") if v0.stderr is None else v0.stderr
    away.append((33.0 - v0.value) / error)
    print(f"{fit.message} v0 = {v0.value:.3f} ± {error:.3f} m/s, {away[-1]:.0f} errors from 33")
sys.exit(0 if np.median(away) > 4 else 1)
EOF
