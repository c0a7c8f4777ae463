"""Write the recorded drivers that the package ships, from tables of OpenACC.

    python tools/ship_recordings.py openacc.parquet free_driving.parquet

OpenACC (European Commission, Joint Research Centre) is licensed CC BY 4.0; see
lcc_rl/assets/README.md for the attribution and for what was chosen.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

import lcc_rl.assets
from lcc_rl.io.files import write_parquet

FOLDER = Path(lcc_rl.assets.__file__).parent / "recorded"
GAPS = (1.0, 120.0)  # between them, a driver follows [m]
EPISODE = 602  # samples of an episode: two windows of 30 s
SHORTEST = 301  # samples of an episode, one window
DRIVE = 9000  # samples of a drive: 15 min
STANDING, MOST = 0.5, 0.3  # speed below which a car stands [m/s], largest share of a drive
LEAST = 1.0  # standard deviation of the speed of a drive; cruise control is not driving [m/s]


def platoons(table: pd.DataFrame) -> pd.DataFrame:
    """Human drivers behind the car before them.

    Args:
        table: campaign, file, car, time_s, speed_mps, gap_m and driver, at 10 Hz.

    Returns:
        A table of pairs; a recording is a file: minutes of one trip are alike.
    """
    parts: list[pd.DataFrame] = []
    for (campaign, file), one in table.groupby(["campaign", "file"], observed=True):
        origin = one["time_s"].min()
        numbers = one["car"].unique().tolist()
        cars = {car: one[one["car"] == car] for car in numbers}
        cars = {car: own.set_index(_frame(own, origin)) for car, own in cars.items()}
        for car in cars.keys() & {number + 1 for number in cars}:
            own = cars[car].assign(leader=cars[car - 1]["speed_mps"])
            human = own["driver"].eq("Human") & own["gap_m"].between(*GAPS)
            own = own[human & own["leader"].notna() & own["speed_mps"].notna()]
            place = own.index.to_numpy()
            number = (np.diff(place, prepend=-2) != 1).cumsum()
            for _, run in own.groupby([number, place // EPISODE]):
                if len(run) < SHORTEST:
                    continue
                episode = pd.DataFrame(
                    {
                        "episode": len(parts),
                        "recording": f"{campaign} {file}",
                        "follower_id": car,
                        "leader_id": car - 1,
                        "time_s": run.index / 10,
                        "follower_speed_mps": run["speed_mps"].to_numpy(),
                        "leader_speed_mps": run["leader"].to_numpy(),
                        "gap_m": run["gap_m"].to_numpy(),
                    }
                )
                parts.append(episode)
    return _rounded(pd.concat(parts, ignore_index=True))


def drives(table: pd.DataFrame) -> pd.DataFrame:
    """A quarter of an hour of every driver.

    Args:
        table: drive (driver_part), time_s and speed_mps, at 10 Hz.

    Returns:
        The middle of each driver's longest trip, of those in which the car neither stands nor
        cruises there.
    """
    parts = []
    drivers = table["drive"].astype(str).str.extract(r"D(\d+)_")[0].astype(int)
    for driver, trips in table.groupby(drivers):
        for _, trip in sorted(trips.groupby("drive", observed=True), key=lambda x: -len(x[1])):
            start = (len(trip) - DRIVE) // 2
            part = trip.iloc[max(start, 0) : max(start, 0) + DRIVE]
            stands, varies = (part["speed_mps"] < STANDING).mean(), part["speed_mps"].std()
            if stands < MOST and varies > LEAST:
                name, time = f"driver {driver:02d}", np.arange(len(part)) / 10
                speed = part["speed_mps"].to_numpy()
                parts.append(pd.DataFrame({"drive": name, "time_s": time, "speed_mps": speed}))
                break
    return _rounded(pd.concat(parts, ignore_index=True))


def _frame(table: pd.DataFrame, origin: float) -> pd.Index:
    return pd.Index(np.rint((table["time_s"].to_numpy(float) - origin) * 10).astype(int))


def _rounded(table: pd.DataFrame) -> pd.DataFrame:
    """Speeds and gaps to a centimetre, which the instruments do not resolve."""
    names = [name for name in table if str(name).endswith(("_mps", "_m"))]
    return table.assign(**{str(x): table[x].astype(float).round(2) for x in names})


def main() -> None:
    """Write both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("openacc", help="table of platoons")
    parser.add_argument("free_driving", help="table of drives")
    given = parser.parse_args()
    FOLDER.mkdir(exist_ok=True)
    write_parquet(platoons(pd.read_parquet(given.openacc)), FOLDER / "platoons.parquet")
    write_parquet(drives(pd.read_parquet(given.free_driving)), FOLDER / "drives.parquet")


if __name__ == "__main__":
    main()
