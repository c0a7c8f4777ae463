#!/usr/bin/env bash
# canmatrix 1.3.3: the DBC of a car's speeds and forces, brought to ARXML by `canconvert`.
# Guess before: 50 % that a signed or a float signal becomes another number in one of the formats.
# Seen: in ARXML, silently. Factors have one decimal (0.25 becomes 0.2; 0.01 becomes 0.0 and is
# read as 1), a signal with named values has none, signed ones are unsigned: a relative speed of
# -5 m/s is 200.8 m/s. JSON and KCD are right; cantools 45.1.0 refuses the ARXML.
# Hurt: who hands the DBC of a measured car on to a tool that wants AUTOSAR.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        "canmatrix[arxml,kcd]==1.3.3" cantools==45.1.0 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import subprocess
import sys
from pathlib import Path

import canmatrix.formats
import cantools

Path("car.dbc").write_text("""VERSION ""
NS_ :
BS_:
BU_: CAR LOG
BO_ 100 Motion: 8 CAR
 SG_ Speed : 0|16@1+ (0.01,0) [0|100] "m/s" LOG
 SG_ RelativeSpeed : 16|10@1- (0.25,0) [-100|100] "m/s" LOG
 SG_ SetSpeed : 32|8@1+ (0.5,0) [0|60] "m/s" LOG
 SG_ Force : 40|16@1- (0.5,0) [-10000|10000] "N" LOG
VAL_ 100 SetSpeed 0 "none" 255 "error" ;
""")
sent = {"Speed": 22.5, "RelativeSpeed": -5.0, "SetSpeed": 25.0, "Force": -3000.0}
data = cantools.database.load_file("car.dbc").encode_message("Motion", sent)


def received(file: str) -> list[float]:
    """Return the values of the message's signals, in the order of `sent`, by a file's matrix."""
    (matrix,) = canmatrix.formats.loadp(file).values()
    values = matrix.frame_by_id(canmatrix.ArbitrationId(100)).decode(data)
    return [float(values[name].phys_value) for name in sent]


found = {"dbc": received("car.dbc")}
said = ""
for kind in ("kcd", "json", "arxml"):
    run = ["venv/bin/canconvert", "car.dbc", f"car.{kind}"]
    shown = subprocess.run(run, check=True, capture_output=True, text=True)
    said += shown.stdout + shown.stderr
    found[kind] = received(f"car.{kind}")
for kind, values in found.items():
    print(f"{kind:6}" + ", ".join(f"{name} {value:g}" for name, value in zip(sent, values)))
print("warnings:", said.lower().count("warn") + said.lower().count("error"))
try:
    refused = not cantools.database.load_file("car.arxml")
except cantools.database.UnsupportedDatabaseFormatError as error:
    refused = True
    print("cantools:", error)
true = list(sent.values())
same = found["dbc"] == found["kcd"] == found["json"] == true and "warn" not in said.lower()
sys.exit(0 if same and refused and found["arxml"] == [2250, 200.8, 50, 29768] else 1)
EOF
