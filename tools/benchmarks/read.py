"""Benchmark of the NGSIM reader: rows per second."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TextIO

import pandas as pd

from benchmarks.harness import Row, rates, stream
from lcc_rl.data.ngsim import OFFICIAL, read_ngsim
from lcc_rl.data.trajectories import FOOT


def read(options: Namespace) -> list[Row]:
    """Return rows/s of the NGSIM reader, beside pandas alone."""
    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as folder:
        path = Path(folder, "stream.csv.gz")
        write_ngsim(stream(options.quick).generate().samples, path)
        runs = {"read_ngsim": lambda: read_ngsim(path), "pandas": lambda: pd.read_csv(path)}
        counts = dict.fromkeys(runs, read_ngsim(path).report.rows_read)
        return rates(options, runs, "rows/s", counts, {"read_ngsim": ["pandas"]})


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
