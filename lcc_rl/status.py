"""Entry point: how the runs below a folder stand, ``python -m lcc_rl.status FOLDER``."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from lcc_rl.cli import main_guard
from lcc_rl.progress import clock
from lcc_rl.results.states import STATES, RunState, survey
from lcc_rl.sweeps import read_plan

COLOURS = {"finished": "green", "running": "cyan", "stopped": "yellow", "failed": "red"}


def counts(states: Sequence[RunState], planned: int = 0) -> dict[str, int]:
    """Count the runs by state, with those that have not begun as ``waiting``."""
    numbers = {kind: sum(state.state == kind for state in states) for kind in STATES}
    return {**numbers, "waiting": max(0, planned - len(states))}


def remaining(states: Sequence[RunState], planned: int = 0) -> float | None:
    """Estimate the seconds until everything is finished; None where nothing is known.

    The running runs tell their own rest; those that wait or stopped are taken to last as long as
    a running one lasts in all, shared among as many as run now.
    """
    running = [state for state in states if state.state == "running" and state.eta_s is not None]
    known = [state for state in running if 0 < state.done < state.total]
    if not known:
        return None
    own = [float(state.eta_s or 0.0) for state in known]
    whole = [
        eta * state.total / (state.total - state.done)
        for state, eta in zip(known, own, strict=True)
    ]
    numbers = counts(states, planned)
    later = (numbers["waiting"] + numbers["stopped"]) * sum(whole) / len(whole)
    return max(max(own), (sum(own) + later) / len(running))


def headline(root: Path, states: Sequence[RunState], planned: int) -> str:
    """Return the one line that sums a folder up."""
    numbers = counts(states, planned)
    parts = [f"{count} {kind}" for kind, count in numbers.items() if count]
    left = remaining(states, planned)
    eta = f"; about {clock(left)} left" if left is not None else ""
    return f"{root}: {max(planned, len(states))} runs: {', '.join(parts) or 'none'}{eta}"


def note(state: RunState) -> str:
    """Return what is worth saying about a run beside its progress."""
    if state.state == "running" and state.eta_s is not None:
        return f"ETA {clock(state.eta_s)}" if state.done < state.total else "evaluating"
    return state.error


def progress(state: RunState) -> str:
    """Return ``done/total``, or nothing for a run without iterations."""
    return f"{state.done}/{state.total}" if state.total else ""


def draw(root: Path, states: Sequence[RunState], planned: int) -> Group:
    """Draw the runs as a table for a terminal."""
    table = Table("run", "state", "iteration", "")
    for state in states:
        colour = COLOURS[state.state]
        cells = (f"[{colour}]{state.state}[/]", progress(state), escape(note(state)))
        table.add_row(escape(state.name), *cells)
    return Group(table, escape(headline(root, states, planned)))


def show(root: Path, console: Console) -> None:
    """Print how the runs below a folder stand: a table on a terminal, else a line a run."""
    states, planned = survey(root), read_plan(root).runs
    if console.is_terminal:
        console.print(draw(root, states, planned))
        return
    for state in states:
        line = f"{state.state:<9}{progress(state):>12}  {state.name}  {note(state)}"
        console.print(line.rstrip(), markup=False, soft_wrap=True)
    console.print(headline(root, states, planned), markup=False, soft_wrap=True)


def watch(root: Path, console: Console, every: float) -> None:
    """Keep the table current until no run is running and none waits."""
    with Live(console=console, auto_refresh=False) as live:
        while True:
            states, planned = survey(root), read_plan(root).runs
            live.update(draw(root, states, planned), refresh=True)
            numbers = counts(states, planned)
            if not numbers["running"] and not numbers["waiting"]:
                return
            time.sleep(every)


def main(arguments: Sequence[str] | None = None) -> None:
    """Show the folder given on the command line."""
    parser = argparse.ArgumentParser("lcc_rl.status", description=__doc__)
    parser.add_argument("folder", nargs="?", default="outputs", type=Path)
    parser.add_argument("--watch", action="store_true", help="keep the table current")
    options = parser.parse_args(arguments)
    console = Console(highlight=False)
    if options.watch and console.is_terminal:
        main_guard(watch)(options.folder, console, 2.0)
    else:
        main_guard(show)(options.folder, console)


if __name__ == "__main__":
    main()
