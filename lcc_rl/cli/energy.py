"""Energy of recorded trips: in kJ, kWh, litres and grams, per trip and per kilometre.

lcc-rl energy trips.parquet energy=fuel   # columns drive, time_s, speed_mps
lcc-rl energy folder energy=bolt --out energies.parquet  # a file per trip
lcc-rl energy a.csv leader.columns.grade=slope leader.units.grade=%

Further words are settings: energy=…, leader.columns and leader.units.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

from lcc_rl.io.atomic import new_file
from lcc_rl.io.files import write_table
from lcc_rl.runs.arguments import TABLE, Arguments, files_and_settings
from lcc_rl.runs.interrupts import ending_quietly

SHOWN_TRIPS = 20  # most trips that are printed


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the energy of trips, and write it to a file."""
    parser = Arguments(prog="lcc-rl energy", description=__doc__)
    parser.add_argument("words", nargs="+", help="tables, folders, patterns; settings key=value")
    parser.add_argument("--out", type=TABLE, help="also write a row per trip: .csv, .parquet")
    options = parser.parse_intermixed_args(arguments)
    files, settings = files_and_settings(options.words)
    out = options.out and new_file(options.out, "--out")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    with ending_quietly():  # loads torch
        from lcc_rl.commands.energy import trip_energies
    trips = trip_energies(files, settings)
    print(trips.head(SHOWN_TRIPS).to_string(index=False, float_format="{:,.4g}".format))
    sums = trips[["distance_km", "energy_kj", "energy_kwh"]].sum()
    totals = "{distance_km:,.1f} km, {energy_kj:,.0f} kJ, {energy_kwh:,.1f} kWh".format(**sums)
    print(f"{len(trips):,} trips: {totals}")
    if out:
        write_table(trips, out)
