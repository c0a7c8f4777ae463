"""Energy of recorded trips: in kJ, kWh, litres and grams, per trip and per kilometre.

lcc-rl energy trips.parquet energy=fuel                      # columns drive, time_s, speed_mps
lcc-rl energy folder energy=bolt --out energies.parquet      # a file per trip
lcc-rl energy a.csv leader.columns.drive=id leader.units.speed=km/h energy.mass=1900 energy=electric
lcc-rl energy a.csv leader.columns.grade=slope leader.units.grade=% energy=fuel

Further words are settings: energy=…, and leader.columns and leader.units of the files. Speeds are
interpolated to 0.1 s, as in evaluations. Energy is as drawn; the net energy is less by the gain of
kinetic energy from the first to the last sample.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from pydantic import Field

from lcc_rl.cli.guard import main_guard
from lcc_rl.evaluation.trips import trip_energies
from lcc_rl.io.atomic import atomic_path, new_file
from lcc_rl.io.files import write_parquet
from lcc_rl.runs.arguments import Arguments, typed

MOST_ROWS = 20  # most trips that are printed


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the energy of trips, and write it to a file."""
    parser = Arguments(prog="lcc-rl energy", description=__doc__)
    parser.add_argument("words", nargs="+", help="tables, folders, patterns; settings key=value")
    ending = typed(Annotated[str, Field(pattern=r"\.(csv|parquet)$")])
    parser.add_argument("--out", type=ending, help="also write a row per trip: .csv, .parquet")
    options = parser.parse_args(arguments)
    files = [word for word in options.words if "=" not in word or Path(word).exists()]
    if not files:
        parser.error("expected a file of trips")
    out = options.out and new_file(options.out, "--out")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    trips = trip_energies(files, [word for word in options.words if word not in files])
    print(trips.head(MOST_ROWS).to_string(index=False, float_format="{:,.4g}".format))
    if len(trips) > MOST_ROWS:
        print(f"… and {len(trips) - MOST_ROWS:,} trips more; --out writes all")
    sums = trips[["distance_km", "energy_kj", "energy_kwh"]].sum()
    words = "{distance_km:,.1f} km, {energy_kj:,.0f} kJ, {energy_kwh:,.1f} kWh".format(**sums)
    print(f"{len(trips):,} trips: {words}")
    if out is None:
        return
    if out.suffix == ".parquet":
        write_parquet(trips, out)
    else:
        with atomic_path(out) as temporary:
            trips.to_csv(temporary, index=False)


if __name__ == "__main__":
    main_guard(main)()
