#!/usr/bin/env bash
# asammdf 8.8.28: a speed on CAN (0.01 m/s) whose DBC names one value, 0 is "standstill".
# Guess before: 35 % that samples of the largest raw value, or multiplexed ones, are lost or wrong.
# Seen: multiplexed ones are right; a car that stands has no speed. `extract_bus_logging` gives NaN,
# with either `ignore_value2text_conversion`: the mean of a drive is 10.5 instead of 7 m/s. By
# `get_can_signal` it is 700, without the factor. `ignore_value2text_conversions` of `to_dataframe`
# brings the stops back; another named value than 0 has no factor there.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        asammdf==8.8.28 cantools==45.1.0 python-can==4.6.1 numpy==2.4.6 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import sys
import time
from pathlib import Path

import can
import cantools
import numpy as np
from asammdf import MDF

Path("car.dbc").write_text("""VERSION ""
NS_ :
BS_:
BU_: CAR LOG
BO_ 100 Motion: 8 CAR
 SG_ Speed : 0|16@1+ (0.01,0) [0|100] "m/s" LOG
VAL_ 100 Speed 0 "standstill" ;
""")
motion = cantools.database.load_file("car.dbc").get_message_by_name("Motion")
seconds = np.arange(6000) / 100
speed = np.interp(seconds, [0, 10, 15, 35, 40, 60], [12, 12, 0, 0, 12, 12])  # stands for 20 s
with can.Logger("drive.mf4") as log:
    start = time.time()
    for second, value in zip(seconds, speed):
        frame = motion.encode({"Speed": value})
        log(can.Message(start + second, motion.frame_id, is_extended_id=False, data=frame))
log = can.LogReader("drive.mf4")
ways = {"driven": [motion.decode(x.data, decode_choices=False)["Speed"] for x in log]}
with MDF("drive.mf4") as log:
    for ignore in (True, False):
        bus = log.extract_bus_logging(
            {"CAN": [("car.dbc", 0)]}, ignore_value2text_conversion=ignore
        )
        ways[f"extracted, ignored: {ignore}"] = bus.get("Speed").samples
        table = bus.to_dataframe(ignore_value2text_conversions=ignore)
        ways[f"to_dataframe, ignored: {ignore}"] = table["Speed"].to_numpy()
    ways["get_can_signal"] = log.get_can_signal("Motion.Speed", database="car.dbc").samples
found = []
for name, values in ways.items():
    values = np.asarray(values, float)
    found += [(float(np.nanmean(values)), int(np.isnan(values).sum()))]
    print(f"{name:28}: mean {found[-1][0]:6.2f} m/s, {found[-1][1]} of {len(values)} missing")
expected = [(7, 0), (10.5, 2001), (7, 0), (10.5, 2001), (10.5, 2001), (700, 0)]
sys.exit(0 if np.allclose(found, expected, rtol=0, atol=0.05) else 1)
EOF
