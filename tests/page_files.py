"""Small files that stand for those which the pages' commands name."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from functools import cache
from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd
from ngsim_text import csv_text, native_text, portal_text
from table_text import long_table, openacc_text

from benchmarks.read import write_ngsim
from lcc_rl.data.sources import NgsimSource
from lcc_rl.drivers.population import load_drivers
from lcc_rl.io.files import write_parquet
from lcc_rl.synthetic.stream import StreamSource


@cache
def recordings() -> list[list[list[str]]]:
    """Rows of two recordings, in the order of the official columns."""
    stream = StreamSource(recordings=2, platoons=3, vehicles=3, duration_s=(45.0, 60.0))
    samples = stream.generate().samples
    write_ngsim(samples, text := StringIO())
    rows = [line.split(",") for line in text.getvalue().splitlines()[1:]]
    half = int((samples["recording"] == samples["recording"].iloc[0]).sum())
    return [rows[:half], rows[half:]]


def official(path: Path) -> None:
    """Both recordings as the official CSV."""
    text = csv_text([row for part in recordings() for row in part]).encode()
    path.write_bytes(gzip.compress(text) if path.suffix == ".gz" else text)


def native(path: Path) -> None:
    """One native file for each recording."""
    for number, rows in enumerate(recordings()):
        path.with_name(path.name.replace("*", str(number))).write_text(native_text(rows))


def pairs(path: Path) -> None:
    """The pairs of both recordings."""
    official(path.with_suffix(".csv"))
    write_parquet(NgsimSource(path=str(path.with_suffix(".csv"))).load().episodes, path)


def wide(path: Path) -> None:
    """Pairs with names and units of one's own, a row per moment."""
    time = np.arange(0.0, 60.0, 0.04)
    parts = []
    for run in range(4):
        ahead, own = (10.0 + 3.0 * np.sin((time - late) / (4.0 + run)) for late in (0.0, 1.0))
        gap = 20.0 + np.cumsum(ahead - own) * 0.04
        speeds = {"v1": 3.6 * ahead, "v2": 3.6 * own}
        parts.append(pd.DataFrame({"run": run, "clock": time, **speeds, "d": gap / 0.3048}))
    pd.concat(parts).to_csv(path, index=False)


def car_log(path: Path) -> None:
    """The log of a car at 50 Hz behind two targets, one after the other."""
    time = np.arange(0.0, 240.0, 0.02)
    own, ahead = (12.0 + 3.0 * np.sin((time - late) / 5.0) for late in (1.0, 0.0))
    gap = 30.0 + np.cumsum(ahead - own) * 0.02 - 9.0 * (time > 120.0)
    columns = {"t": time, "v": own, "d": gap, "dv": ahead - own, "id": 1 + (time > 120.0)}
    pd.DataFrame({**columns, "ok": 1}).to_csv(path, index=False)


def table(path: Path) -> None:
    """A table with names and units of its own."""
    frame = long_table(cars=6, rows=600).rename(columns={"gap": "distance"})
    frame.assign(v=3.6 * frame["v"]).to_csv(path, sep=";", index=False)


def fcd(path: Path) -> None:
    """Vehicles as SUMO writes them."""
    names = {"id": "vehicle_id", "t": "timestep_time", "v": "vehicle_speed"}
    names |= {"ahead": "vehicle_leaderID", "gap": "vehicle_leaderGap"}
    frame = long_table(cars=4, rows=600).rename(columns=names)
    frame["vehicle_leaderID"] = frame["vehicle_leaderID"].map("f.{}".format)
    frame.assign(vehicle_id=frame["vehicle_id"].map("f.{}".format)).to_csv(
        path, sep=";", index=False
    )


def highd(path: Path) -> None:
    """Both directions of a road as highD has them: upper left corners of boxes, 25 Hz."""
    parts = []
    for direction, sign in ((1, -1), (2, 1)):
        frame = long_table(cars=4, rows=1500, step=0.04)
        width = 4.0 + frame["id"] % 3
        corner = -frame["x"] if sign < 0 else frame["x"] - width
        part = {"frame": (frame["t"] / 0.04).round().astype(int), "x": corner, "width": width}
        part |= {"id": frame["id"] + 10 * direction, "xVelocity": sign * frame["v"]}
        ahead = (frame["ahead"] + 10 * direction).where(frame["ahead"] > 0, 0)
        parts.append(pd.DataFrame({**part, "precedingId": ahead, "laneId": 2 * direction}))
    tracks = pd.concat(parts, ignore_index=True)
    tracks.to_csv(path, index=False)
    meta = pd.DataFrame({"id": tracks["id"].unique()})
    meta["drivingDirection"] = meta["id"] // 10
    meta.to_csv(path.with_name("01_tracksMeta.csv"), index=False)


def record(path: Path, unit: float = 3.6) -> None:
    """One record, in km/h."""
    time = np.arange(0.0, 300.0, 0.1)
    frame = pd.DataFrame({"t": time, "v": unit * (12.0 + 4.0 * np.sin(time / 5.0))})
    frame.to_csv(path, index=False)


def trips(path: Path) -> None:
    """A folder of twelve drives, each in a file."""
    path.mkdir()
    for number in range(12):
        record(path / f"trip{number}.csv", 1.0)


def openacc(path: Path) -> None:
    """Three native files of OpenACC."""
    for number in range(3):
        name = path.name.replace("*", f"drive{number}")
        path.with_name(name).write_bytes(gzip.compress(openacc_text(rows=1200).encode()))


def drives(path: Path) -> None:
    """Twelve wavy drives of twelve days."""
    time = np.arange(0.0, 150.0, 0.1)
    parts = []
    for day in range(1, 13):
        drive = {"drive": f"2021-03-{day:02}-22-35-14_{day}", "time_s": time}
        parts.append(pd.DataFrame({**drive, "speed_mps": 18.0 + 5.0 * np.sin(time / (4.0 + day))}))
    pd.concat(parts, ignore_index=True).to_parquet(path)


# By the name that the pages use; a star stands for several files.
FILES: dict[str, Callable[[Path], object]] = {
    "trajectories.csv.gz": official,
    "raw/trajectories-*.txt": native,
    "portal.csv": lambda path: path.write_text(
        portal_text([row for part in recordings() for row in part])
    ),
    "other.csv": official,
    "my.csv": table,
    "mine.csv": wide,
    "log.csv": car_log,
    "pairs.parquet": pairs,
    "ring_pairs.parquet": pairs,
    "outputs/pipeline/<run>/trajectories.parquet": pairs,
    "astazero/*.csv.gz": openacc,
    "drives.parquet": drives,
    "other.parquet": drives,
    "i24_leaders.parquet": drives,
    "record.csv": record,
    "fcd.csv": fcd,
    "01_tracks.csv": highd,
    "my_trips": trips,
    "drivers.parquet": lambda path: write_parquet(load_drivers().head(6), path),
}
# What stands where a page leaves a path out, by the setting or the group that it belongs to.
LEFT_OUT = {
    "data=ngsim": ("data.path", "trajectories.csv.gz"),
    "leader=drives": ("leader.path", "drives.parquet"),
    "leader=i24": ("leader.path", "i24_leaders.parquet"),
    "leader=openacc": ("leader.path", "astazero/drive0.csv.gz"),
}


def write_named(text: str, folder: Path) -> None:
    """Write the files that a page names, into a folder."""
    left_out = {name for _, name in LEFT_OUT.values()}
    for name, make in FILES.items():
        if name in text or (name in left_out and ".path=…" in text):
            path = folder / name.replace("<run>", "run")
            path.parent.mkdir(parents=True, exist_ok=True)
            make(path)
