#!/usr/bin/env bash
# cvxpy 1.9.3: a solver that runs out of time or iterations raises nothing and leaves values in
# the variables, as if solved; the status is `user_limit`, and a warning is printed.
# Guess before: a SolverError.
# Seen: with OSQP and a time limit the plan is all zeros: no braking, 130 m through the car ahead.
# Hurt: who runs model predictive control in real time and tests the variable against None.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq cvxpy==1.9.3 osqp==1.1.3 numpy==2.4.1 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import sys
import warnings

import cvxpy as cp
import numpy as np

steps, dt = 30, 0.5
gap, speed, leader = 20.0, 25.0, 15.0


def solve(limit):
    """Return status, first acceleration [m/s²] and smallest gap [m] of a plan of 15 s."""
    plan = cp.Variable(steps)
    speeds = speed + dt * cp.cumsum(plan)
    gaps = gap + leader * dt * np.arange(1, steps + 1) - dt * cp.cumsum(speeds)
    cost = cp.sum_squares(plan) + 0.01 * cp.sum_squares(speeds - leader)
    problem = cp.Problem(cp.Minimize(cost), [plan >= -6, plan <= 2, gaps >= 2, speeds >= 0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        problem.solve(solver="OSQP", **limit)
    return problem.status, float(plan.value[0]), float(gaps.value.min())


limits = {"no limit": {}, "iterations": {"max_iter": 25}, "time": {"time_limit": 1e-6}}
found = {name: solve(limit) for name, limit in limits.items()}
for name, (status, first, smallest) in found.items():
    print(f"{name:10} status {status}, first {first:.2f} m/s², smallest gap {smallest:.1f} m")
same = found["no limit"][0] == "optimal" and found["no limit"][2] > 1.9
same &= found["iterations"][0] == found["time"][0] == "user_limit"
sys.exit(0 if same and found["time"][1] == 0 and found["time"][2] < -100 else 1)
EOF
