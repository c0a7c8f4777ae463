#!/usr/bin/env bash
# polars `join_asof(on=..., by=...)`: rows of a sensor that are not sorted by time within a
# vehicle are no error, as without `by`; the result has wrong or missing matches (polars 2.1.0).
# Guess before: an error, as in pandas and as without `by`.
# Seen: of four cars' times one is matched, with a row that is two seconds older than the right
# one; one general warning, which a sorted table gives as well.
# Hurt: who adds radar or CAN samples to trajectories by vehicle.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq polars==2.1.0 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import sys
import warnings

import polars as pl

car = pl.DataFrame({"id": ["a"] * 4, "time": [0.0, 1.0, 2.0, 3.0]})
radar = pl.DataFrame({"id": ["a"] * 4, "time": [3.0, 0.0, 2.0, 1.0], "gap": [33.0, 30, 32, 31]})
with warnings.catch_warnings(record=True) as unsorted_warning:
    warnings.simplefilter("always")
    found = car.join_asof(radar, on="time", by="id")["gap"].to_list()
with warnings.catch_warnings(record=True) as sorted_warning:
    warnings.simplefilter("always")
    right = car.join_asof(radar.sort("time"), on="time", by="id")["gap"].to_list()
try:
    car.join_asof(radar, on="time")
    refused = False
except pl.exceptions.InvalidOperationError:
    refused = True
print("gaps, sensor sorted by time:    ", right)
print("gaps, sensor not sorted:        ", found)
print("without `by` it is refused:     ", refused)
print("same warnings for both:         ", len(unsorted_warning) == len(sorted_warning))
alike = len(unsorted_warning) == len(sorted_warning)
sys.exit(0 if right == [30.0, 31.0, 32.0, 33.0] and found != right and refused and alike else 1)
EOF
