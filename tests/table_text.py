"""Small tables of trajectories: native OpenACC files and tables of a row per vehicle and moment."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from lcc_rl.data.leaders import RecordLeaders
from lcc_rl.data.ngsim import read_ngsim
from lcc_rl.data.openacc import OpenAccSource
from lcc_rl.data.sources import EpisodesSource, NgsimSource
from lcc_rl.data.speed_records import DRIVE_COLUMNS, read_drives, read_speed_record
from lcc_rl.data.table_source import TableSource

PREAMBLE = (
    "Date,8,10,2019\nVehicle_order,SMART,MAZDA,TESLA,\nNumber_of_vehicles,{cars}\nACC,1\n"
    "Distance_setting,S\n"
)
GAP, LENGTH = 20.0, 5.0  # m
BY_GAP = {"vehicle": "id", "time": "t", "speed": "v", "leader": "ahead", "gap": "gap"}
STRETCH = {"a": {"to_s": 9.0}}
READERS: dict[str, Callable[[str], object]] = {
    "ngsim": lambda path: read_ngsim(path),
    "source": lambda path: NgsimSource(path=path).load(),
    "i-80": lambda path: read_ngsim(path, location="i-80"),
    "table": lambda path: TableSource(path=path, columns={**BY_GAP, "position": "x"}).load(),
    "lengths": lambda path: TableSource(path=path, columns={**BY_GAP, "length": "length"}).load(),
    "episodes": lambda path: EpisodesSource(path=path).load(),
    "openacc": lambda path: OpenAccSource(path=path).load(),
    "drives": lambda path: read_drives(path, DRIVE_COLUMNS, 0.1),
    "record": lambda path: read_speed_record(path),
    "leaders": lambda path: RecordLeaders(path=path, training=STRETCH, held_out=STRETCH).load(
        0.1, 9
    ),
}


def written(folder: Path, frame: pd.DataFrame, name: str = "my.csv", **options: object) -> str:
    """Write a table as parquet, or as text with the options of pandas; return its path."""
    path = folder / name
    if path.suffix == ".parquet":
        frame.to_parquet(path)
    else:
        frame.to_csv(path, index=False, **options)
    return str(path)


def speed(time: np.ndarray, car: int) -> np.ndarray:
    """A wavy speed, a little later for every car [m/s]."""
    return 12.0 + 3.0 * np.sin((time - 0.5 * car) / 4.0)


def way(time: np.ndarray, car: int) -> np.ndarray:
    """Position of a car of which the first begins at 0 m: the integral of its speed [m]."""
    start = -(car - 1) * (GAP + LENGTH)
    phase = 0.5 * car / 4.0
    return start + 12.0 * time + 12.0 * (np.cos(phase) - np.cos(time / 4.0 - phase))


def openacc_text(cars: int = 3, rows: int = 400, blank: dict[str, list[int]] | None = None) -> str:
    """A native OpenACC file at 10 Hz from 430 s on; ``blank`` rows of columns have no value."""
    time = np.arange(rows) / 10
    frame = pd.DataFrame({"Time": 430 + time})
    for car in range(1, cars + 1):
        frame[f"Speed{car}"] = speed(time, car)
        frame[f"E{car}"] = frame[f"N{car}"] = way(time, car)
    for car in range(1, cars):
        frame[f"IVS{car}"] = way(time, car) - way(time, car + 1) - LENGTH
    for name, places in (blank or {}).items():
        frame.loc[places, name] = np.nan
    return PREAMBLE.format(cars=cars) + frame.to_csv(index=False)


def long_table(cars: int = 3, rows: int = 400, step: float = 0.1) -> pd.DataFrame:
    """A row per vehicle and moment, with every column that there may be, in SI."""
    parts = []
    for car in range(1, cars + 1):
        time = step * np.arange(rows)
        ahead = way(time, car - 1) - way(time, car) - LENGTH if car > 1 else np.nan
        parts.append(
            pd.DataFrame(
                {
                    "id": car,
                    "t": time,
                    "v": speed(time, car),
                    "x": way(time, car),
                    "lane": "left",
                    "ahead": car - 1,
                    "gap": ahead,
                    "length": LENGTH,
                }
            )
        )
    return pd.concat(parts, ignore_index=True)


def pairs(episodes: int = 20, rows: int = 30) -> pd.DataFrame:
    """An episode table in SI, at 20 m/s."""
    number = np.repeat(np.arange(episodes), rows)
    time = np.tile(np.arange(rows) / 10, episodes)
    return pd.DataFrame(
        {
            "episode": number,
            "recording": "a",
            "follower_id": number + 100,
            "leader_id": number + 200,
            "time_s": time,
            "follower_position_m": 20.0 * time,
            "follower_speed_mps": 20.0,
            "leader_position_m": 20.0 * time + 15.0,
            "leader_speed_mps": 20.0,
            "leader_length_m": 5.0,
            "gap_m": 10.0,
        }
    )
