"""Show the state of the runs in a folder, by default outputs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from lcc_rl.errors import require
from lcc_rl.runs.arguments import Arguments
from lcc_rl.runs.overview import EVERY, counts, left, live, overview_line, progress, states_table
from lcc_rl.runs.plans import read_plan
from lcc_rl.runs.states import clean, survey


def show_states(root: Path, console: Console) -> None:
    """Print the state of the runs: a table on a terminal, else one line per run."""
    states, planned = survey(root), read_plan(root).runs
    if console.is_terminal:
        console.print(states_table(root, states, planned))
        return
    for state in states:
        line = f"{state.state:<9}{progress(state):>12}  {state.name}  {left(state) or state.error}"
        console.print(line.rstrip(), markup=False, soft_wrap=True)
    console.print(overview_line(root, states, planned), markup=False, soft_wrap=True)


def watch_folder(root: Path, console: Console) -> None:
    """Update the table until no run is running or waiting."""

    def planned() -> int:
        return read_plan(root).runs

    survey(root)  # raises for a missing folder before the table is drawn
    with live(root, planned, console):
        while True:
            numbers = counts(survey(root), planned())
            if not numbers["running"] and not numbers["waiting"]:
                return
            time.sleep(EVERY)


def main(arguments: Sequence[str] | None = None) -> None:
    """Show the folder of the command line, once or continuously."""
    parser = Arguments(prog="lcc-rl status", description=__doc__)
    parser.add_argument("folder", nargs="?", default="outputs")
    parser.add_argument("--watch", action="store_true", help="update the table until all runs end")
    parser.add_argument(
        "--clean", action="store_true", help="first remove failed runs without results"
    )
    options = parser.parse_args(arguments)
    if options.clean:
        for path in clean(Path(options.folder)):
            print(f"removed {path}")
    require(options.folder, "the name of the folder is empty; use, e.g., outputs")
    console = Console(highlight=False)
    show = watch_folder if options.watch and console.is_terminal else show_states
    show(Path(options.folder), console)
