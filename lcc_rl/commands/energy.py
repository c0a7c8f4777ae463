"""Energy of recorded trips: in kJ, kWh, litres and grams, per trip and per kilometre.

lcc-rl energy trips.parquet energy=fuel   # columns drive, time_s, speed_mps
lcc-rl energy folder energy=bolt --out energies.parquet  # a file per trip
lcc-rl energy a.csv leader.columns.grade=slope leader.units.grade=%

Further words are settings: energy=…, leader.columns and leader.units.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from os import PathLike, fspath
from typing import Any

import numpy as np
import pandas as pd
import torch

from lcc_rl.arrays import times
from lcc_rl.config import load
from lcc_rl.config.words import quoted, top_key
from lcc_rl.data.leaders import DriveLeaders
from lcc_rl.data.profiles import Profiles
from lcc_rl.envs.inputs import build_energy
from lcc_rl.errors import require
from lcc_rl.evaluation.metrics import KILO
from lcc_rl.io.atomic import new_file
from lcc_rl.io.files import write_table
from lcc_rl.runs.arguments import TABLE, Arguments, files_and_settings
from lcc_rl.runs.output import log_report
from lcc_rl.settings import checked

BLOCK = 10  # records whose energies are computed together; more exceed the processor's cache
KWH = 3600.0  # [kJ]
MOST_ROWS = 20  # most trips that are printed


@checked
def trip_energies(
    path: str | PathLike | Sequence[str | PathLike], overrides: Sequence[str] = ()
) -> pd.DataFrame:
    """Return the energy of recorded trips, and log lines on the data.

    Args:
        path: a table of many trips, files with one trip each, a folder, a pattern, or a list.
        overrides: the energy model, columns and units: ``["energy=fuel", "leader.columns.drive=id",
            "leader.units.speed=km/h", "leader.columns.grade=slope", "leader.units.grade=%"]``.

    Returns:
        A row per trip, by name: ``trip``, ``parts`` (records that holes divide it into),
        ``duration_s``, ``distance_km``, ``energy_kj`` as drawn, ``net_energy_kj``, less the gain of
        kinetic energy and height; and of the energy drawn ``energy_kwh``, ``kwh_per_100km``, fuel
        and carbon dioxide.
    """
    for word in overrides:
        valid = top_key(word) in ("energy", "leader", "scenario", "trust")
        require(valid, f"{word} has no effect on the energy of given trips")
    names = [path] if isinstance(path, (str, PathLike)) else path
    listed = ",".join(quoted(fspath(name)) for name in names)
    settings = ["variant=direct", "leader=drives", f"leader.path=[{listed}]", *overrides]
    cfg = load("evaluate", settings)
    (model, *further), step = build_energy(cfg).models, cfg.scenario.time_step
    require(not further, "energy: a mixture has several models; choose one, such as fuel")
    source = cfg.leader.made(DriveLeaders)
    records, lines = source.profiles(step)
    log_report(lines)
    blocks = (slice(first, first + BLOCK) for first in range(0, len(records), BLOCK))
    rows = pd.concat([_energies(records, block, model) for block in blocks])
    trips = rows.groupby("trip").sum().reset_index()
    order = trips["trip"].astype(str).str.replace(r"\d+", lambda x: x[0].zfill(20), regex=True)
    trips = trips.loc[order.sort_values().index].reset_index(drop=True)  # 2 before 10
    km = trips["distance_km"].where(trips["distance_km"] > 0.0)
    trips["energy_kwh"] = trips["energy_kj"] / KWH
    trips["kwh_per_100km"] = 100.0 * trips["energy_kwh"] / km
    if model.heating_value:
        drawn = torch.from_numpy(trips["energy_kj"].to_numpy() / KILO)
        trips["fuel_l"], trips["co2_g"] = (x.numpy() for x in model.burnt(drawn))
        trips["l_per_100km"] = 100.0 * trips["fuel_l"] / km
        trips["co2_g_per_km"] = trips["co2_g"] / km
    return trips


def _energies(records: Profiles, block: slice, model: Any) -> pd.DataFrame:
    """Return duration, distance and energies of some records, as ``energy_measures`` does."""
    first, step = records.offsets[block].numpy(), records.time_step
    last = first + records.lengths[block].numpy() - 1
    rows, first, last = slice(first[0], last[-1] + 1), first - first[0], last - first[0]
    speed = records.speeds[rows]
    if records.grades is not None:
        model = model.at(records.grades[rows][:-1])
    rates = np.stack([model.power(speed[:-1], speed.diff() / step), model.climbing(speed[:-1])])
    rates[:, last[:-1]] = 0.0  # from one record to the next
    drawn, climbed = KILO * step * np.add.reduceat(rates, first, axis=1, dtype=np.float64)
    edges = speed[np.stack([first, last])].double()
    stored = climbed + KILO * model.stored_energy(edges).diff(dim=0)[0].numpy()
    total = np.add.reduceat(speed.numpy(), first, dtype=np.float64) - 0.5 * edges.sum(0).numpy()
    return pd.DataFrame(
        {
            "trip": records.recordings[block],
            "parts": 1,
            "duration_s": times(last - first, step),
            "distance_km": KILO * step * total,
            "energy_kj": drawn,
            "net_energy_kj": drawn - stored,
        }
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the energy of trips, and write it to a file."""
    parser = Arguments(prog="lcc-rl energy", description=__doc__)
    parser.add_argument("words", nargs="+", help="tables, folders, patterns; settings key=value")
    parser.add_argument("--out", type=TABLE, help="also write a row per trip: .csv, .parquet")
    options = parser.parse_intermixed_args(arguments)
    files, settings = files_and_settings(options.words)
    out = options.out and new_file(options.out, "--out")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    trips = trip_energies(files, settings)
    print(trips.head(MOST_ROWS).to_string(index=False, float_format="{:,.4g}".format))
    sums = trips[["distance_km", "energy_kj", "energy_kwh"]].sum()
    totals = "{distance_km:,.1f} km, {energy_kj:,.0f} kJ, {energy_kwh:,.1f} kWh".format(**sums)
    print(f"{len(trips):,} trips: {totals}")
    if out:
        write_table(trips, out)
