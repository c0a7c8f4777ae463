"""Show the state of the runs in a folder, by default outputs."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from lcc_rl.errors import require
from lcc_rl.runs.arguments import Arguments
from lcc_rl.runs.output import PLAIN
from lcc_rl.runs.plans import read_plan
from lcc_rl.runs.progress import clock
from lcc_rl.runs.states import STATES, RunState, clean, survey

STATE_COLOURS = {"finished": "green", "running": "cyan", "stopped": "yellow", "failed": "red"}
EVERY = 2.0  # time between surveys of the folder [s]
URGENCY = ("running", "failed", "stopped", "finished")


def counts(states: Sequence[RunState], planned: int = 0) -> dict[str, int]:
    """Count the runs by state; runs that have not started count as ``waiting``."""
    numbers = {kind: sum(state.state == kind for state in states) for kind in STATES}
    return {**numbers, "waiting": max(0, planned - len(states))}


def remaining(states: Sequence[RunState], planned: int = 0) -> float | None:
    """Estimate the time until all runs are finished [s]; None if it is unknown.

    Waiting and stopped runs are assumed to last as long as the average running one, with the
    present number of parallel runs.
    """
    running = [state for state in states if state.state == "running" and state.eta_s is not None]
    known = [state for state in running if 0 < state.done < state.total]
    if not known:
        return None
    own = [state.eta_s or 0.0 for state in known]
    whole = [(state.eta_s or 0.0) * state.total / (state.total - state.done) for state in known]
    numbers = counts(states, planned)
    later = (numbers["waiting"] + numbers["stopped"]) * sum(whole) / len(whole)
    return max(max(own), (sum(own) + later) / len(running))


def overview_line(root: Path, states: Sequence[RunState], planned: int) -> str:
    """Return a summary of the folder in one line."""
    numbers = counts(states, planned)
    parts = [f"{count} {kind}" for kind, count in numbers.items() if count]
    left = remaining(states, planned)
    eta = f"; about {clock(left)} left" if left is not None else ""
    runs = max(planned, len(states))
    return f"{root}: {runs} run{'s' * (runs != 1)}: {', '.join(parts) or 'none'}{eta}"


def left(state: RunState) -> str:
    """Return the remaining time of a run as text, if it is known."""
    if state.state != "running" or not state.total or state.eta_s is None:
        return ""
    return f"ETA {clock(state.eta_s)}" if state.done < state.total else "evaluating"


def progress(state: RunState) -> str:
    """Return ``done/total``, empty for a run without iterations."""
    return f"{state.done}/{state.total}" if state.total else ""


def states_table(
    root: Path, states: Sequence[RunState], planned: int, most: int | None = None
) -> Group:
    """Return the runs as a table for a terminal.

    Args:
        root: folder of the runs.
        states: its runs.
        planned: total number of runs.
        most: most rows; running and failed runs come first. None: all.
    """
    shown = sorted(states, key=lambda state: URGENCY.index(state.state)) if most else states
    table = Table(**PLAIN)
    table.add_column("run", overflow="fold")
    for heading in ("state", "iteration", "left"):
        table.add_column(heading)
    for state in shown[:most]:
        colour = STATE_COLOURS[state.state]
        kind = f"[{colour}]{state.state}[/]"
        # The error is below the name, which has space.
        name = f"{state.name}\n  {state.error}" if state.error else state.name
        table.add_row(escape(name), kind, progress(state), left(state))
    if most and len(shown) > most:
        table.add_row(f"… {len(shown) - most} more")
    return Group(table, escape(overview_line(root, states, planned)))


def live(root: Path, planned: Callable[[], int], console: Console) -> Live:
    """Return a live table for a terminal, updated every :data:`EVERY` seconds."""

    def picture() -> Group:
        # Seven lines for heading, borders and summary; a long error may still wrap.
        return states_table(root, survey(root), planned(), max(1, console.height - 7))

    return Live(get_renderable=picture, console=console, refresh_per_second=1 / EVERY)


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
    require(options.folder, "the name of the folder is empty; use, e.g., outputs")
    if options.clean:
        for path in clean(Path(options.folder)):
            print(f"removed {path}")
    console = Console(highlight=False)
    show = watch_folder if options.watch and console.is_terminal else show_states
    show(Path(options.folder), console)
