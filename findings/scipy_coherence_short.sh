#!/usr/bin/env bash
# scipy's coherence of two cars that have nothing to do with each other, 30 s at 10 Hz, is 1 at
# every frequency, without a warning (scipy 1.17.1): 300 samples hold one segment of 256.
# Guess before: 1 for 30 s, as one segment has nothing to differ from; 0.4 for a minute.
# Seen: 1.000 for 26 to 38 s; for a minute the highest value below 0.5 Hz is 0.75 on average, for
# five minutes 0.15. matplotlib's `cohere` refuses less than 51 s.
# Hurt: who asks at which frequencies a car follows its leader: every short pair seems to.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        scipy==1.17.1 numpy==2.4.1 matplotlib==3.11.2 || exit 2
cd "$folder"
venv/bin/python -W error - <<'EOF'
import sys

import numpy as np
from matplotlib import mlab
from scipy.signal import coherence

generator = np.random.default_rng(0)


def speed(samples: int) -> np.ndarray:
    """Return a speed whose accelerations are independent of everything [m/s]."""
    return 15.0 + np.cumsum(generator.normal(0.0, 0.1, samples))


found = {}
for seconds in (26, 30, 38, 60, 300):
    lowest, highest = [], []
    for _ in range(100):
        first, second = speed(10 * seconds), speed(10 * seconds)
        frequencies, value = coherence(first, second, fs=10.0)
        slow = value[(frequencies > 0.0) & (frequencies < 0.5)]
        lowest.append(slow.min())
        highest.append(slow.max())
    found[seconds] = min(lowest), np.mean(highest)
    try:
        answer = f"mean {mlab.cohere(first, second, Fs=10.0)[0].mean():.2f}"
    except ValueError:
        answer = "refused"
    print(f"{seconds} s: below 0.5 Hz at least {min(lowest):.3f}, highest on average "
          f"{found[seconds][1]:.3f}; matplotlib: {answer}")
short = all(np.isclose(found[seconds][0], 1.0) for seconds in (26, 30, 38))
sys.exit(0 if short and found[60][1] > 0.6 and found[300][1] < 0.25 else 1)
EOF
