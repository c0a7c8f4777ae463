#!/usr/bin/env bash
# python-control: the H-infinity norm of a string of equal cars depends on how the product is kept.
# (control 0.10.2, scipy 1.17.1, numpy 2.4.6)  Each car amplifies a wave by 1.24 at most.
# Guess before: poles() of the product scatter, and its step response diverges; the norm is right.
# Seen: poles scatter, responses are right; the norm of 20 cars is 1.5, in state space 73; no word.
# Hurt: who judges string stability by the norm: 15 cars that amplify 25 times have 0.8, "stable".
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        control==0.10.2 scipy==1.17.1 numpy==2.4.6 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import sys

import control
import numpy as np

# Speed of a car to that ahead: 0.1 1/s² for the gap, 0.25 1/s for closing, 0.1 1/s for the speed.
car = control.tf([0.25, 0.1], [1.0, 0.35, 0.1])
peak = np.abs(car(1j * np.linspace(0.01, 2.0, 20_000))).max()
wrong = []
for count in (5, 20):
    chain = control.ss(car)
    for _ in range(count - 1):
        chain = control.ss(car) * chain
    product, states = (control.norm(x, "inf") for x in (car**count, chain))
    print(f"{count} cars: {product:.2f} of the product, {states:.2f} in state space,")
    print(f"  {peak**count:.2f} by frequency; slowest pole {(car**count).poles().real.max():.3f}")
    assert abs(states / peak**count - 1.0) < 1e-3
    wrong.append(bool(abs(product / peak**count - 1.0) > 0.5))
sys.exit(0 if wrong == [False, True] else 1)
EOF
