#!/usr/bin/env bash
# scipy `solve_ivp` with LSODA or Radau and default settings does not see a leader that brakes for
# two seconds: the step has grown in steady traffic and goes over it (scipy 1.17.0).
# Guess before: RK45, the default, misses it too.
# Seen: of 24 times of braking LSODA and Radau miss nearly all (the follower keeps 20.00 m/s;
# true: 17.98), RK45 a third; no message, success is True.
# Hurt: who integrates driver models with a recorded or scripted leader; remedy: max_step.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq scipy==1.17.0 numpy==2.4.1 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import sys

import numpy as np
from scipy.integrate import solve_ivp

np.seterr(all="ignore")
a, b, v0, s0, T = 1.5, 2.0, 30.0, 2.0, 1.5
start_gap = (s0 + T * 20) / np.sqrt(1 - (20 / v0) ** 4)


def lowest_speed(method, brakes_at, **options):
    def rates(t, state):
        position, speed, ahead = state
        leader = 20 - 2 * np.clip(t - brakes_at, 0, 2) + 2 * np.clip(t - brakes_at - 2, 0, 2)
        wanted = s0 + max(0, T * speed + speed * (speed - leader) / (2 * np.sqrt(a * b)))
        return speed, a * (1 - (speed / v0) ** 4 - (wanted / (ahead - position)) ** 2), leader

    found = solve_ivp(rates, (0, 300), [0, 20, start_gap], method=method, **options)
    assert found.success
    return found.y[1].min()


times = np.linspace(40, 270, 24)
true = lowest_speed("RK45", 150, max_step=0.1)
missed = {m: sum(lowest_speed(m, t) > 19.9 for t in times) for m in ("RK45", "LSODA", "Radau")}
print(f"lowest speed of the follower, max_step=0.1: {true:.2f} m/s")
for method, count in missed.items():
    print(f"{method}: braking not seen in {count} of {len(times)} runs")
few = missed["RK45"] < missed["LSODA"] / 2
sys.exit(0 if few and missed["LSODA"] > 16 and missed["Radau"] > 16 else 1)
EOF
