"""What need not wait for torch, TorchRL and matplotlib does not load them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pandas as pd

from lcc_rl.io.files import write_parquet

HEAVY = ("torch", "tensordict", "torchrl", "matplotlib", "scipy.stats", "scipy.interpolate")
TABLES = ("pandas", "pyarrow")
# Runs the argument as ``python -m`` would, then names what was loaded on the way.
PROGRAM = """
import runpy, sys
module, *sys.argv[1:] = sys.argv[1:]
try:
    runpy.run_module(module, run_name="__main__", alter_sys=True)
except SystemExit as stop:
    print(stop.code or 0, file=sys.stderr)
print("loaded:", *sys.modules, file=sys.stderr)
"""


def loaded(program: str, *words: str, cwd: Path) -> tuple[set[str], str, str]:
    """Run a program; return what it had imported, and what it printed."""
    done = subprocess.run(
        [sys.executable, "-c", program, *words], cwd=cwd, text=True, capture_output=True, check=True
    )
    said, _, names = done.stderr.rpartition("loaded:")
    return set(names.split()), done.stdout, said


def test_help_needs_no_torch(tmp_path) -> None:
    names, out, _ = loaded(PROGRAM, "lcc_rl.cli.train", "--help", cwd=tmp_path)
    assert not names.intersection((*HEAVY, *TABLES))
    assert "calibration: both, global, local" in out  # the choices of every group


def test_status_needs_neither_torch_nor_pandas(tmp_path) -> None:
    write_parquet(pd.DataFrame({"x": [1.0]}), tmp_path / "run" / "episodes.parquet")
    names, out, _ = loaded(PROGRAM, "lcc_rl.cli.status", str(tmp_path), cwd=tmp_path)
    assert not names.intersection((*HEAVY, *TABLES))
    assert "1 finished" in out


def test_reading_results_needs_no_torch(tmp_path) -> None:
    write_parquet(pd.DataFrame({"x": [1.0]}), tmp_path / "run" / "episodes.parquet")
    (tmp_path / "run" / "config.yaml").write_text("seed: 3\n")
    program = """
import sys
from lcc_rl import results
print(results.load(".")["seed"].tolist())
print("loaded:", *sys.modules, file=sys.stderr)
"""
    names, out, _ = loaded(program, cwd=tmp_path)
    assert not names.intersection(HEAVY)
    assert out == "[3]\n"
