#!/usr/bin/env bash
# npTDMS: a speed of 100 Hz and a radar gap of 10 Hz in one group, as a data frame (1.13.0).
# Guess before: side by side by number; by `time_index=True` rows of one time that do not meet.
# Seen: the gap of second 50 is beside the speed of second 5, without a word: a time gap of 1.5 s
# becomes 0.3 to 2.3 s. With `time_index=True` a sixth of the gaps have a row beside that of their
# time, as 3 x 0.1 is not 30 x 0.01.
# Hurt: who computes time gaps or TTC from measurement files of test benches and cars.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        nptdms==1.13.0 pandas==3.1.1 numpy==2.4.6 || exit 2
cd "$folder"
venv/bin/python -W error - <<'EOF'
import sys

import numpy as np
from nptdms import ChannelObject, TdmsFile, TdmsWriter

fast, slow = 0.01 * np.arange(6000), 0.1 * np.arange(600)  # a minute [s]


def speed(time: np.ndarray) -> np.ndarray:
    """Return a speed that swings with a period of 30 s [m/s]."""
    return 12 + 8 * np.sin(2 * np.pi * time / 30)


with TdmsWriter("drive.tdms") as file:
    file.write_segment(
        ChannelObject("radar", name, values, {"wf_increment": step, "wf_start_offset": 0.0})
        for name, values, step in (("speed", speed(fast), 0.01), ("gap", 1.5 * speed(slow), 0.1))
    )
group = TdmsFile.read("drive.tdms")["radar"]
table = group.as_dataframe().dropna()
gaps = table["gap"] / table["speed"]
print(f"time gaps: 1.5 s driven; read {gaps.min():.2f} to {gaps.max():.2f} s, {len(table)} rows")
joined = group.as_dataframe(time_index=True)
alone = int((joined["gap"].notna() & joined["speed"].isna()).sum())
print(f"time_index=True: {alone} of {len(slow)} gaps have no speed")
sys.exit(0 if gaps.min() < 0.5 and gaps.max() > 2 and alone > 50 else 1)
EOF
