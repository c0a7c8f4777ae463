#!/usr/bin/env bash
# torch.compile's cache folder, shared by processors of two kinds: every second group of eight
# cars has no position, without an error (torch 2.13.0; first run with AVX-512, second with AVX2).
# Guess before: the second process compiles anew, since the key holds what the kernels depend on.
# Seen: 32 of 64 positions are what was in memory before; with a folder of its own none is wrong.
# Hurt: who sweeps on a cluster of mixed nodes with one home, or ships a warm cache in an image.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        torch==2.13.0 numpy==2.4.1 setuptools==80.9.0 || exit 2
cd "$folder"
cat >ring.py <<'EOF'
import sys

import torch


def ring():
    """Return the positions of 64 cars, 7.5 m apart."""
    return torch.arange(64, dtype=torch.float32) * 7.5


if torch.backends.cpu.get_cpu_capability() != sys.argv[1]:
    print("this processor has no", sys.argv[1])
    sys.exit(2)
wrong = (torch.compile(ring)() != ring()).nonzero().flatten().tolist()
print(f"{sys.argv[1]}: {len(wrong)} of 64 positions are wrong, of cars {wrong[:10]} ...")
half = [car for car in range(64) if car // 8 % 2]
sys.exit(0 if wrong == (half if sys.argv[2] == "half" else []) else 1)
EOF
run() {
    echo "cache folder $3"
    ATEN_CPU_CAPABILITY=${1,,} TORCHINDUCTOR_CACHE_DIR=$folder/$3 \
        venv/bin/python -W ignore ring.py "$1" "$2"
}
run AVX512 none shared
run AVX2 half shared
run AVX2 none own
