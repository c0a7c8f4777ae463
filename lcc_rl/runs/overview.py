"""Overview room: the runs of a folder counted, timed and drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from lcc_rl.runs.progress import clock
from lcc_rl.runs.states import STATES, RunState, survey

COLOURS = {"finished": "green", "running": "cyan", "stopped": "yellow", "failed": "red"}
URGENCY = ("running", "failed", "stopped", "finished")


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
    if state.state == "running" and state.total and state.eta_s is not None:
        return f"ETA {clock(state.eta_s)}" if state.done < state.total else "evaluating"
    return state.error


def progress(state: RunState) -> str:
    """Return ``done/total``, or nothing for a run without iterations."""
    return f"{state.done}/{state.total}" if state.total else ""


def draw(root: Path, states: Sequence[RunState], planned: int, most: int | None = None) -> Group:
    """Draw the runs as a table for a terminal.

    Args:
        root: the folder that was looked at.
        states: its runs.
        planned: how many runs there will be.
        most: rows there is room for; runs at work come first, then those in trouble. All: None.
    """
    shown = sorted(states, key=lambda state: URGENCY.index(state.state)) if most else states
    table = Table("run", "state", "iteration", "")
    for state in shown[:most]:
        colour = COLOURS[state.state]
        cells = (f"[{colour}]{state.state}[/]", progress(state), escape(note(state)))
        table.add_row(escape(state.name), *cells)
    if most and len(shown) > most:
        table.add_row(f"… {len(shown) - most} more")
    return Group(table, escape(headline(root, states, planned)))


def live(root: Path, planned: Callable[[], int], console: Console, every: float = 2.0) -> Live:
    """Return a table that keeps itself current, on a terminal, from ``start`` to ``stop``."""

    def picture() -> Group:
        # Heading, borders and the lines below; a long error may still wrap.
        room = max(1, console.height - 7)
        return draw(root, survey(root), planned(), room)

    return Live(get_renderable=picture, console=console, refresh_per_second=1 / every)
