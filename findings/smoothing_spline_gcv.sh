#!/usr/bin/env bash
# scipy `make_smoothing_spline` chooses its smoothing by generalised cross-validation, which takes
# the errors of a trajectory for motion if neighbouring samples share them (scipy 1.17.0).
# Guess before: accelerations within a factor of two of the best choice.
# Seen: as guessed for independent errors (0.3 m/s at 10 Hz); with a correlation time of 1 s, as
# of GPS and video, the error is 0.8 m/s², twenty times the best and hardly below no smoothing.
# Hurt: energy from such data.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq scipy==1.17.0 numpy==2.4.1 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import sys

import numpy as np
from scipy.interpolate import make_smoothing_spline

time = np.arange(600) / 10
speed = 12 + 4 * np.sin(2 * np.pi * time / 40)
true = 4 * 2 * np.pi / 40 * np.cos(2 * np.pi * time / 40)


def errors(correlation, rng):
    noise = rng.standard_normal(600)
    keep = np.exp(-0.1 / correlation) if correlation else 0.0
    for k in range(1, 600):
        noise[k] = keep * noise[k - 1] + np.sqrt(1 - keep**2) * noise[k]
    return 0.3 * noise


def off(noise, lam=None):
    return np.std(make_smoothing_spline(time, speed + noise, lam=lam).derivative()(time) - true)


ratios = {}
for correlation in (0.0, 1.0):
    rng = np.random.default_rng(0)
    cases = [errors(correlation, rng) for _ in range(8)]
    chosen = np.mean([off(noise) for noise in cases])
    lambdas = 10.0 ** np.arange(0, 5, 0.5)
    best = min(np.mean([off(noise, lam) for noise in cases]) for lam in lambdas)
    raw = np.mean([np.std(np.gradient(speed + noise, 0.1) - true) for noise in cases])
    ratios[correlation] = chosen / best
    print(f"correlation {correlation} s: error {chosen:.2f} m/s², best {best:.2f}, "
          f"unsmoothed {raw:.2f}")
sys.exit(0 if ratios[0.0] < 2 and ratios[1.0] > 5 else 1)
EOF
