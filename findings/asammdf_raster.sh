#!/usr/bin/env bash
# asammdf 8.8.28, a speed in an MDF4 file, an integer of 0.01 m/s as on CAN, from 10 to 50 Hz:
# `resample(0.02)` and `get(name, raster=0.02)` hold values, `to_dataframe(raster=0.02)` does not.
# Guess before: all convert to m/s first and interpolate linearly, as for a speed stored as float.
# Seen: a braking of 5 m/s² becomes 25; stored as float it stays 5. `get` returns floats in both
# cases. `configure(integer_interpolation=2)` mends `resample`; `get` does not follow it.
# Hurt: accelerations and energies from CAN logs; the own speed lags a radar's by up to a sample.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq asammdf==8.8.28 numpy==2.4.6 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import sys

import numpy as np
from asammdf import MDF, Signal
from asammdf.blocks.conversion_utils import from_dict

time = np.arange(601) / 10
speed = np.interp(time, [0, 20, 23, 40, 60], [25, 25, 10, 25, 25])
scale = from_dict({"a": 0.01, "b": 0.0})
with MDF(version="4.10") as log:
    raw = np.round(100 * speed).astype("u2")
    log.append([Signal(raw, time, name="integer", unit="m/s", conversion=scale)])
    log.append([Signal(speed, time, name="float", unit="m/s")])
    log.save("log.mf4")


def hardest(samples):
    return np.diff(samples).min() / 0.02


found = {}
with MDF("log.mf4") as log:
    for mode in ("as it is", "configured"):
        if mode == "configured":
            log.configure(integer_interpolation=2)
        for name in ("integer", "float"):
            found[mode, name] = [
                hardest(log.resample(0.02).get(name).samples),
                hardest(log.get(name, raster=0.02).samples),
                hardest(log.to_dataframe(raster=0.02)[name].to_numpy()),
            ]
            print(f"{mode}, {name:7}: hardest braking by resample, get, to_dataframe:",
                  *(f"{x:.2f}" for x in found[mode, name]), "m/s²")
    print("get returns", log.get("integer").samples.dtype, log.get("integer").unit)
expected = {
    ("as it is", "integer"): [-25, -25, -5],
    ("as it is", "float"): [-5, -5, -5],
    ("configured", "integer"): [-5.5, -25, -5],
    ("configured", "float"): [-5, -5, -5],
}
same = all(np.allclose(found[key], expected[key], rtol=0, atol=0.3) for key in expected)
sys.exit(0 if same else 1)
EOF
