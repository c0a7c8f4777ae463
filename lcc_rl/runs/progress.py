"""Progress of long jobs: a bar on a terminal, lines in a log, ``progress.json``."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, wait
from contextlib import contextmanager
from multiprocessing import parent_process
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from lcc_rl.config.compose import is_sweep
from lcc_rl.io.atomic import atomic_path
from lcc_rl.runs.output import show_headline
from lcc_rl.runs.states import PROGRESS, check_present, read_progress

log = logging.getLogger("lcc_rl")

BETWEEN_LINES = 20.0  # seconds, without a terminal


def clock(seconds: float) -> str:
    """Return a duration as ``m:ss``."""
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


def bar(console: Console, shown: bool, transient: bool = False) -> Progress:
    """Return a progress bar for tasks with a ``note``, disabled unless ``shown``."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
        console=console,
        disable=not shown,
        transient=transient,
    )


@contextmanager
def phases(
    title: str, console: Console, emit: Callable[[Sequence[str]], None], every: float = 10.0
) -> Iterator[Callable[[int, int, str], None]]:
    """Report the progress of a job in phases with separate counts.

    A terminal shows a live bar, which disappears at the end; else a line is written at most every
    ``every`` seconds.

    Args:
        title: name of the job.
        console: console of the bar.
        emit: function that receives the lines.
        every: seconds between lines without a terminal.

    Yields:
        A function ``report(done, total, text)`` of the finished units of a phase.
    """
    begun = last = last_line = time.monotonic()
    before = 0

    def report(done: int, total: int, text: str) -> None:
        nonlocal before, begun, last, last_line
        now = time.monotonic()
        begun = last if done <= before else begun
        before, last = done, now
        eta = clock((now - begun) / max(done, 1) * (total - done))
        note = f"{text}: {done}/{total}  ETA {eta}"
        shown.update(task, completed=done, total=total, note=note)
        if not console.is_terminal and now - last_line >= every:
            last_line = now
            emit([f"{title}: {note}"])

    with bar(console, console.is_terminal, transient=True) as shown:
        task = shown.add_task(title, total=None, note="")
        yield report


class ProgressReporter:
    """Reports rate, ETA and current values of a long job.

    A terminal shows a live bar, except in a sweep (:mod:`lcc_rl.runs.sweeps` draws one table); else
    a line is written at most every 20 s. The log file always gets the lines, and
    ``folder/progress.json`` holds the latest state.

    Args:
        title: name of the job.
        total: units of work.
        unit: name of a unit.
        start: units already done (after resuming).
        folder: folder of ``progress.json``; None: none is written.
        console: console of the bar; standard error by default.
    """

    def __init__(
        self,
        title: str,
        total: int,
        unit: str = "iteration",
        start: int = 0,
        folder: Path | None = None,
        console: Console | None = None,
    ) -> None:
        self.title, self.total, self.unit, self.start = title, total, unit, start
        self.folder = folder
        self.console = console or Console(stderr=True)
        # Trainings of the main job have the bar of their parent.
        alone = not is_sweep() and parent_process() is None
        self.live = self.console.is_terminal and alone
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
        self.begun = self.last_line = time.monotonic()
        self.marks: list[tuple[float, int]] = []  # (time, units done)
        self.bar = bar(self.console, self.live)
        note = f"{start}/{total}"
        self.task: TaskID = self.bar.add_task(title, total=total, completed=start, note=note)

    def __enter__(self) -> ProgressReporter:
        self.bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.bar.stop()

    def update(self, done: int, values: Mapping[str, float] | None = None) -> None:
        """Report that ``done`` units are finished, with values to display."""
        rate = self._rate(done)
        remaining = (self.total - done) / rate if rate > 0 else 0.0
        values = dict(values or {})
        shown = "  ".join(f"{name} {value:.4g}" for name, value in values.items())
        eta = f"ETA {clock(remaining)}"
        # The rate does not fit into 80 characters.
        self.bar.update(self.task, completed=done, note=f"{done}/{self.total}  {shown}  {eta}")
        if len(self.marks) < 2 and done < self.total:
            return  # the first unit compiles and fills buffers
        self._write_state(done, remaining, values)
        if time.monotonic() - self.last_line >= BETWEEN_LINES or done >= self.total:
            self.last_line = time.monotonic()
            note = f"{shown}  {rate:.2f} {self.unit}s/s  {eta}"
            self._line(f"{self.title}: {self.unit} {done}/{self.total}  {note}")

    def _rate(self, done: int) -> float:
        """Return the units per second in the second half of the time, without the first update."""
        now = time.monotonic()
        self.marks.append((now, done))
        while len(self.marks) > 2 and self.marks[1][0] <= 0.5 * (self.begun + now):
            del self.marks[0]
        since, before = self.marks[0] if len(self.marks) > 1 else (self.begun, self.start)
        return (done - before) / max(now - since, 1e-9)

    def _line(self, text: str) -> None:
        if not self.live:
            log.info(text)
            return
        # The terminal has the bar; the log file gets the line.
        record = log.makeRecord(log.name, logging.INFO, "", 0, text, (), None)
        for handler in logging.getLogger().handlers:
            if isinstance(handler, logging.FileHandler):
                handler.emit(record)

    def _write_state(self, done: int, remaining: float, values: Mapping[str, float]) -> None:
        if self.folder is None:
            return
        check_present(self.folder)
        state = {"title": self.title, "done": done, "total": self.total}
        state |= {"eta_s": round(remaining, 1)}
        state |= {name: float(f"{value:.6g}") for name, value in values.items()}
        with atomic_path(self.folder / PROGRESS, durable=False) as temporary:
            temporary.write_text(json.dumps(state), encoding="utf-8")


def watch_jobs(jobs: Mapping[str, tuple[Path, Future[Any]]]) -> None:
    """Show the progress of jobs in other processes until all are done or one fails.

    Args:
        jobs: folder of ``progress.json`` and future of each job.
    """
    console = Console(stderr=True)
    last = time.monotonic()
    futures = [future for _, future in jobs.values()]
    with bar(console, console.is_terminal) as shown:
        tasks = {name: shown.add_task(name, total=None, note="starting") for name in jobs}
        running = True
        while running:
            running = bool(wait(futures, 1.0, FIRST_EXCEPTION).not_done)
            due = not console.is_terminal and time.monotonic() - last >= BETWEEN_LINES
            last = time.monotonic() if due else last
            parts = []
            for name, (folder, future) in jobs.items():
                state = read_progress(folder)
                if state is None:
                    continue
                reward = f"reward {state.get('reward', 0.0):.4g}  ETA {clock(state['eta_s'])}"
                done, total = state["done"], state["total"]
                count = f"{done}/{total}"
                note = f"{count}  {reward}"
                shown.update(tasks[name], completed=int(done), total=total, note=note)
                if not future.done():
                    parts.append(f"{name} {count}, {reward}")
            if due and parts:
                show_headline("; ".join(parts))
            if any(future.done() and future.exception() for future in futures):
                return
