"""Means of an evaluation per window and per driver: what a study's tables and figures need."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import pandas as pd

from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.results.bootstrap import Estimate
from lcc_rl.results.headline import counted, several
from lcc_rl.results.runs import EPISODES
from lcc_rl.results.savings import WAYS, savings

WINDOWS, DRIVERS = "windows.parquet", "drivers.parquet"
TRAINED = ["strategy", "training_seed"]
NUMBERS = ("profile_id", "driver_id", "training_seed")  # name a thing, measure none
ENERGY = "energy_kj"
PER_KM = "vehicle and km"
# What the energies of each group of vehicles are divided by.
DRIVEN = {"cav": WAYS[:1], "hdv": WAYS[1:], "total": WAYS}
ENDS = {"min": "min", "max": "max", "worst": "max"}  # first word of a column → not its mean


@dataclass(frozen=True)
class Means:
    """Means over the episodes of an evaluation in which all windows have the same drivers.

    Columns that begin with ``min_`` or ``max_`` hold the least or the largest value.

    Args:
        windows: a row per strategy, training seed and window, with ``episodes``, their number,
            ``collisions``, and ``worst_share_…``, the largest share of an episode.
        drivers: energies and distances, a row per strategy and driver: means over windows and
            seeds.
        per: what energies are per.
    """

    windows: pd.DataFrame
    drivers: pd.DataFrame
    per: str = "episode"

    @classmethod
    def of(cls, rows: pd.DataFrame) -> Self:
        """Return the means of the rows of episodes.parquet."""
        collided = rows["collided"].astype("float32")
        worst = {f"worst_{name}": rows[name] for name in rows if str(name).startswith("share_")}
        rows = rows.assign(episodes=1, collisions=collided, collided=collided, **worst)
        measures = [str(name) for name in rows.select_dtypes("number") if name not in NUMBERS]
        how = {name: ENDS.get(name.partition("_")[0], "mean") for name in measures}
        how |= {"episodes": "sum", "collisions": "sum"}
        keys = [*TRAINED, "profile_id", "profile"]
        keys += [name for name in ("source",) if name in rows]
        windows = rows.groupby(keys, dropna=False, as_index=False, observed=True, sort=False)
        energies = [name for name in measures if name.endswith(ENERGY) or name in WAYS]
        drivers = rows.groupby(["strategy", "driver_id"], as_index=False, sort=False)[energies]
        return cls(windows.agg(how), drivers.mean())

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Return the means of an evaluation: as kept in its folder, else of its episodes."""
        if (folder / WINDOWS).exists():
            return cls(read_parquet(folder / WINDOWS), read_parquet(folder / DRIVERS))
        return cls.of(read_parquet(folder / EPISODES))

    def per_km(self) -> Self:
        """Return the means whose drivers' energies, and whose savings, are per vehicle and km."""
        return replace(self, drivers=_per_km(self.drivers), per=PER_KM)

    def saving(self, column: str, strategy: str, baseline: str) -> Estimate:
        """Return what a strategy saves over windows, see :func:`lcc_rl.results.savings.savings`."""
        per = DRIVEN[column.partition("_")[0]] if self.per == PER_KM else ()
        return savings(self.windows, column, strategy, baseline, per)

    def write(self, folder: Path) -> None:
        """Write both tables into a folder, with numbers of single precision and six decimals."""
        for table, name in ((self.windows, WINDOWS), (self.drivers, DRIVERS)):
            numbers = table.select_dtypes("float").columns
            small = table.astype(dict.fromkeys(numbers, "float32")).round(6)
            write_parquet(small, folder / name)

    def size(self) -> str:
        """Return the number of windows and drivers, in words."""
        windows = self.windows["profile_id"].nunique()
        drivers = several(self.drivers["driver_id"].nunique(), "driver")
        return f"{counted(windows, 'held-out ')} × {drivers}"


def _per_km(table: pd.DataFrame) -> pd.DataFrame:
    """Divide the energies of each group of vehicles by their distance, row by row."""
    found = table.copy()
    for group, names in DRIVEN.items():
        way = table[[name for name in names if name in table]].sum(axis=1) / 1e3
        energies = table.columns[table.columns.str.fullmatch(f"{group}_.*{ENERGY}")]
        found[energies] = table[energies].div(way, axis=0)
    return found
