"""Simulate a string of vehicles behind leaders; print a row per vehicle.

lcc-rl simulate us06 drivers=highway --string 'automated human*4'
lcc-rl simulate drive.csv --repeats 20 energy=bolt --steps steps.parquet
lcc-rl simulate scenario=ring --string 'human*22' --seconds 300

Leaders are shipped cycles or files with the columns time_s and speed_mps, an episode each. Words
with = are settings. More with lcc_rl.simulate in Python.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

from lcc_rl.config.schemas import TimeStep
from lcc_rl.io.atomic import new_file
from lcc_rl.io.files import write_table
from lcc_rl.runs.arguments import TABLE, Arguments, files_and_settings, typed
from lcc_rl.runs.interrupts import ending_quietly
from lcc_rl.settings import Count, Positive, Seed

ARGUMENTS: dict[str, tuple[Callable[[str], Any], str]] = {
    "string": (str, "vehicles from front to back, by default human*10"),
    "controller": (str, "of automated vehicles: a name, a file, a run, my_module.Class"),
    "time_step": (typed(TimeStep), "duration of a step [s], by default 0.1"),
    "seconds": (typed(Positive), "duration [s], by default that of the leader"),
    "repeats": (typed(Count), "episodes behind each leader, by default 1"),
    "seed": (typed(Seed), "of the noise, by default 0"),
}
TABLES = {"steps": "a row per time and vehicle", "vehicles": "the printed table with all measures"}
MOST_ROWS, LAST_SHOWN = 40, "mean_gap_m"  # most vehicles and the last column that are printed


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row per vehicle, and write tables to files."""
    parser = Arguments(prog="lcc-rl simulate", description=__doc__)
    parser.add_argument("words", nargs="+", help="leaders; settings key=value")
    for name, (kind, text) in ARGUMENTS.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, help=text)
    for name, text in TABLES.items():
        parser.add_argument(f"--{name}", type=TABLE, help=f"file for {text}: .csv, .parquet")
    options = vars(parser.parse_intermixed_args(arguments))
    files = {name: options.pop(name) for name in TABLES}
    written = {name: new_file(file, f"--{name}") for name, file in files.items() if file}
    leaders, settings = files_and_settings(options.pop("words"))
    given = {name: value for name, value in options.items() if value is not None}
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    with ending_quietly():  # loads torch
        from lcc_rl.evaluation.simulation import simulate
    found = simulate(leaders or None, overrides=settings, **given)
    shown = found.vehicles.loc[: MOST_ROWS - 1, :LAST_SHOWN]
    print(shown.to_string(index=False, float_format="{:,.4g}".format))
    if (more := len(found.vehicles) - len(shown)) > 0:
        print(f"and {more} more: --vehicles FILE has all")
    for name, path in written.items():
        write_table(getattr(found, name), path)
