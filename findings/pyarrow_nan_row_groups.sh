#!/usr/bin/env bash
# pyarrow: what "not below 4 s" finds in a column of TTC with NaN depends on the row groups of the
# file (pyarrow 26.0.1); NaN is the usual mark of a car that does not close in.
# Guess before: the same rows from a table in memory and from its file, however it is cut.
# Seen: six safe steps of eight in memory, four from the file: the other row group is never read.
# Hurt: who counts safe steps in drives kept as parquet; large files have many row groups.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        pyarrow==26.0.1 numpy==2.4.1 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import sys

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

nan = float("nan")
ttc = pa.table({"step": range(8), "ttc_s": [2.0, nan, nan, 3.0, 9.0, nan, 8.0, 7.0]})
safe = ~(pc.field("ttc_s") < 4.0)
found = {"in memory": ttc.filter(safe)["step"].to_pylist()}
for rows in (8, 4):
    pq.write_table(ttc, "drive.parquet", row_group_size=rows)
    read = pq.read_table("drive.parquet", filters=safe)
    found[f"row groups of {rows}"] = read["step"].to_pylist()
for name, steps in found.items():
    print(f"{name}: steps {steps} are safe")
sys.exit(0 if list(found.values()) == [[1, 2, 4, 5, 6, 7]] * 2 + [[4, 5, 6, 7]] else 1)
EOF
