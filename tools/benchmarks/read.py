"""Benchmarks of reading recordings and of starting a command."""

from __future__ import annotations

import resource
import subprocess
import sys
from argparse import Namespace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TextIO

import numpy as np
import pandas as pd

from benchmarks.harness import Row, rates, rows_of, stream
from lcc_rl.data.ngsim import OFFICIAL, read_ngsim
from lcc_rl.data.trajectories import FOOT

STARTS = {
    "import torchrl": ("-c", "import torchrl.envs, torchrl.collectors, torchrl.objectives"),
    "evaluate smoke": (
        *("-m", "lcc_rl", "evaluate", "experiment=smoke", "policy=pretrained"),
        "hydra.run.dir=evaluate",
    ),
    "train smoke": ("-m", "lcc_rl", "train", "experiment=smoke", "hydra.run.dir=train"),
}


def read(options: Namespace) -> list[Row]:
    """Return rows/s of the NGSIM reader, beside pandas alone."""
    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as folder:
        path = Path(folder, "stream.csv.gz")
        write_ngsim(stream(options.quick).generate().samples, path)
        runs = {"read_ngsim": lambda: read_ngsim(path), "pandas": lambda: pd.read_csv(path)}
        count = read_ngsim(path).report.rows_read
        return rates(options, runs, "rows/s", count, {"read_ngsim": ["pandas"]})


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


def start(options: Namespace) -> list[Row]:
    """Return the seconds of the processor that small commands take, loading included."""
    chosen = list(STARTS)[: 1 if options.quick else None]
    spent: dict[str, list[float]] = {case: [] for case in chosen}
    for _ in range(options.repeats):
        for case in chosen:
            with TemporaryDirectory(prefix="lcc_rl_benchmark_") as folder:
                spent[case].append(_processor(STARTS[case], folder))
    return rows_of({case: np.array(each) for case, each in spent.items()}, "s of the processor")


def _processor(words: tuple[str, ...], folder: str) -> float:
    def used() -> float:
        found = resource.getrusage(resource.RUSAGE_CHILDREN)
        return found.ru_utime + found.ru_stime

    before = used()
    subprocess.run([sys.executable, *words], check=True, cwd=folder, stdout=subprocess.DEVNULL)
    return used() - before
