"""Benchmark of the NGSIM reader: rows per second and memory."""

from __future__ import annotations

import gzip
import subprocess
import sys
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TextIO

import numpy as np
import pandas as pd

from benchmarks.harness import Row, rates, rows_of, stream
from lcc_rl.data.ngsim import OFFICIAL, read_ngsim
from lcc_rl.data.trajectories import FOOT
from lcc_rl.errors import DataError

# The kernel's mark of this very process: ru_maxrss may begin at that of the one that started it.
PROGRAM = """
import resource
def peak():
    if not Path("/proc/self/status").exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # bytes where no /proc
    return int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) / 2**10
from pathlib import Path
before = peak()
read()
print(peak() - before)
"""
READER = """
import sys
from lcc_rl.data.ngsim import read_ngsim
def read(): read_ngsim(sys.argv[1], sys.argv[2] or None)
"""
PEAK = "peak memory"


def read(options: Namespace) -> list[Row]:
    """Return rows/s of the NGSIM reader, and by how much reading raises the peak of memory.

    Memory is the largest resident size of a process of its own, less that before reading. The
    file of four times the rows holds one copy under each of four Locations.
    """
    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as folder:
        path, fourfold = Path(folder, "stream.csv.gz"), Path(folder, "fourfold.csv.gz")
        if options.ngsim is None:
            write_ngsim(stream(options.quick).generate().samples, path)
        path = Path(options.ngsim or path)
        runs = {"read_ngsim": lambda: read_ngsim(path), "pandas": lambda: pd.read_csv(path)}
        count = read_ngsim(path).report.rows_read
        counts, against = dict.fromkeys(runs, count), {"read_ngsim": ["pandas"]}
        rows = rates(options, runs, "rows/s", counts, against)
        write_copies(path, fourfold, ("a", "b", "c", "d"))
        memory = {
            PEAK: peak_memory(READER, str(path), ""),
            "… 4 × the rows, ¼ kept": peak_memory(READER, str(fourfold), "a"),
            "… 4 × the rows": peak_memory(READER, str(fourfold), ""),
        }
    return rows + rows_of(memory, "MiB", {name: [PEAK] for name in memory if name != PEAK})


def write_ngsim(samples: pd.DataFrame, path: Path | TextIO) -> None:
    """Write samples of a synthetic stream as an 18-column NGSIM file; unused columns are 0."""
    start = pd.to_datetime(samples["recording"]).dt.tz_localize(None)
    clock = start.to_numpy("datetime64[ms]").astype("int64") + 100 * samples["frame"]
    whole = {"Vehicle_ID": "vehicle", "Frame_ID": "frame", "v_Class": "vehicle_class"}
    whole |= {"Lane_ID": "lane", "Preceding": "preceding"}
    feet = {"Local_Y": "position_m", "v_Length": "length_m", "v_Vel": "speed_mps"}
    feet |= {"v_Acc": "acceleration_mps2"}
    columns = {name: samples[own] for name, own in whole.items()} | {"Global_Time": clock}
    columns |= {name: samples[own] / FOOT for name, own in feet.items()}
    table = pd.DataFrame({name: columns.get(name, 0) for name in OFFICIAL})
    table.to_csv(path, index=False, float_format="%.3f")


def write_copies(path: Path, target: Path, locations: Sequence[str]) -> None:
    """Write an 18-column CSV several times below one header, a Location added to each copy."""
    content = path.read_bytes()
    content = gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content
    header, *lines = content.decode().splitlines()
    if header.count(",") != 17:
        raise DataError(f"{path}: expected an 18-column CSV with a header, got {header[:80]!r}")
    with gzip.open(target, "wt", compresslevel=1, encoding="utf-8") as file:
        file.write(f"{header},Location\n")
        for place in locations:
            file.writelines(f"{line},{place}\n" for line in lines)


def peak_memory(reader: str, *words: str) -> np.ndarray:
    """Return by how much reading raises the peak of a fresh process [MiB].

    Args:
        reader: a program that defines ``read``.
        words: its arguments.
    """
    command = [sys.executable, "-c", reader + PROGRAM, *words]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return np.array([float(done.stdout)])
