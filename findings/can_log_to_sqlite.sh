#!/usr/bin/env bash
# python-can: a log of a car is converted to another format by can.logconvert (python-can 4.6.1).
# Guess before: BLF, CSV and SQLite hold the 60,000 messages of ten minutes; only ASC moves times.
# Seen: SQLite holds the first 120 or 165 s, another share each time, and nothing says so.
# Hurt: who converts logs to a database to query drives. Messages on a bus arrive slowly
# enough to be kept.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        python-can==4.6.1 || exit 2
cd "$folder"
cat >record.py <<'EOF'
import can

with can.Logger("drive.blf") as log:
    for count in range(60_000):
        speed = (count % 3_000).to_bytes(2, "little")
        log(can.Message(timestamp=1.7e9 + 0.01 * count, arbitration_id=0x100, data=speed))
EOF
venv/bin/python record.py
for kind in csv db; do
    venv/bin/python -m can.logconvert drive.blf "drive.$kind"
done
venv/bin/python - <<'EOF'
import sqlite3
import sys
from pathlib import Path

rows = len(Path("drive.csv").read_text().splitlines()) - 1
[(kept, last)] = sqlite3.connect("drive.db").execute("select count(*), max(ts) from messages")
print(f"of 60000 messages CSV holds {rows}, SQLite {kept}, up to {last - 1.7e9:.0f} of 600 s")
sys.exit(0 if rows == 60_000 and kept < 60_000 else 1)
EOF
