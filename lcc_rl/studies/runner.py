"""Runs of a study: parallel trainings that resume and skip finished runs, and the study's notes."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from lcc_rl.config import NOT_IDENTITY, identity, load
from lcc_rl.config.schemas import StudyConfig, as_plain
from lcc_rl.errors import Interrupted, require, unknown_name
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.settings import read_json
from lcc_rl.results.runs import CONFIG, EPISODES, differing, flatten, load_config
from lcc_rl.runs.interrupts import interruptible
from lcc_rl.runs.progress import clock
from lcc_rl.runs.states import is_claimed
from lcc_rl.settings import MOST_PARALLEL

log = logging.getLogger("lcc_rl")

NOTES = "study.json"
FINISHED, FAILED, FOREIGN = "finished", "failed", "other settings"


@dataclass(frozen=True)
class Run:
    """A training: its folder, and its overrides of ``lcc-rl train``."""

    folder: Path
    overrides: tuple[str, ...]

    def compose(self) -> StudyConfig:
        """Return its configuration; a ConfigError for an unknown or wrong override."""
        return load("train", self.overrides)

    @property
    def finished(self) -> bool:
        """Whether the training and its evaluation are complete."""
        return (self.folder / EPISODES).exists()

    def command(self) -> list[str]:
        """Return the command that starts the training, or resumes it from its checkpoint."""
        words = [sys.executable, "-m", "lcc_rl.cli.train"]
        if (self.folder / "checkpoint.pt").exists():
            return [*words, f"resume={quoted(self.folder)}"]
        return [*words, *self.overrides, f"hydra.run.dir={quoted(self.folder)}"]


@dataclass(frozen=True)
class Outcome:
    """The status of a run (``finished``, ``failed`` or ``other settings``) and the reason."""

    run: Run
    status: str
    note: str = ""


@dataclass(frozen=True)
class BaseStudy:
    """The settings that every study has.

    Attributes:
        folder: the study's folder.
        recipe: ``experiment`` of every training; None for the defaults of the agent.
        seeds: number of trainings of every learned variant, numbered from 0.
        overrides: further settings of every run, data and calibration included.
        jobs: number of trainings at a time.
        accept: settings in which a run found in the folder may differ.
    """

    folder: Path
    recipe: str | None
    seeds: int = 8
    overrides: tuple[str, ...] = ()
    jobs: int = 2
    accept: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, most in (("seeds", 10**6), ("jobs", MOST_PARALLEL)):
            given = getattr(self, name)
            require(1 <= given <= most, f"{name} must lie from 1 to {most}, got {given}")


def quoted(path: str | Path) -> str:
    """Return a path quoted for Hydra's command line."""
    return "'" + str(path).replace("\\", "\\\\").replace("'", "\\'") + "'"


def differences(run: Run, wanted: StudyConfig, accept: Sequence[str] = ()) -> list[str]:
    """List the settings of a stored run that differ from the wanted ones, ``key: found → wanted``.

    ``accept`` names dotted keys, or their beginnings, that may differ (``data``, ``drivers.path``).
    """
    found, asked = (dict(flatten(as_plain(cfg))) for cfg in (load_config(run.folder), wanted))
    ignored = (*NOT_IDENTITY, *accept)
    return [
        f"{key}: {found.get(key)} → {asked.get(key)}"
        for key in differing(found, asked)
        if not any(key == item or key.startswith(f"{item}.") for item in ignored)
    ]


def check_accepted(accept: Sequence[str], wanted: StudyConfig) -> None:
    """Check that settings that may differ exist."""
    known = [key.split(".") for key, _ in flatten(as_plain(wanted))]
    for item in accept:
        parts = item.split(".")
        if not any(key[: len(parts)] == parts for key in known):
            raise unknown_name("setting in accept", item, {key[0] for key in known})


def up_to_date(cfg: StudyConfig, folder: Path, policies: Sequence[Path] = ()) -> bool:
    """Whether a folder holds the evaluation of a configuration, not older than its policies."""
    table = folder / EPISODES
    if not table.exists():
        return False
    done = load_config(folder)
    newest = max(((path / "policy.pt").stat().st_mtime for path in policies), default=0.0)
    return identity(done) == identity(cfg) and table.stat().st_mtime >= newest


def run_all(runs: Sequence[Run], jobs: int, accept: Sequence[str] = ()) -> list[Outcome]:
    """Run all unfinished trainings in parallel, ``jobs`` at a time.

    A failure does not stop the others. A run whose folder was made with other settings, except
    those in ``accept``, is left as it is and reported.

    Returns:
        The outcome of every run: those left out, those finished before, then those run now.

    Raises:
        ConfigError: if a run's settings are wrong; checked for all before the first starts.
        Interrupted: on SIGINT or SIGTERM, after every running training is saved.
    """
    outcomes, todo = [], []
    for run in runs:
        wanted = run.compose()
        known = (run.folder / CONFIG).is_file()
        other = differences(run, wanted, accept) if known else []
        if other:
            log.error("%s: left out, it has other settings: %s", run.folder, "; ".join(other))
            outcomes.append(Outcome(run, FOREIGN, "; ".join(other)))
        elif known and run.finished:
            outcomes.append(Outcome(run, FINISHED))
        else:
            todo.append(run)
    finished = sum(outcome.status == FINISHED for outcome in outcomes)
    log.info("%d runs: %d to do, %d finished before", len(runs), len(todo), finished)
    return outcomes + _start(todo, jobs)


def _start(runs: Sequence[Run], jobs: int) -> list[Outcome]:
    """Run processes in parallel; on an interrupt each saves its state."""
    children: set[subprocess.Popen[str]] = set()
    stopping = threading.Event()
    with ThreadPoolExecutor(jobs) as pool, interruptible():
        futures = [pool.submit(_one, run, children, stopping) for run in runs]
        try:
            return [future.result() for future in futures]
        except KeyboardInterrupt:
            stopping.set()
            for child in list(children):
                child.terminate()
            raise Interrupted("stopped; the same command resumes from here") from None


def _one(run: Run, children: set[subprocess.Popen[str]], stopping: threading.Event) -> Outcome:
    if is_claimed(run.folder):  # by a training whose study was killed
        log.info("%s: waits for the process that works on it", run.folder)
    while is_claimed(run.folder) and not stopping.wait(1.0):
        pass
    if run.finished:
        return Outcome(run, FINISHED)
    if stopping.is_set():
        return Outcome(run, FAILED, "not started")
    run.folder.mkdir(parents=True, exist_ok=True)
    command, begun = run.command(), time.monotonic()
    log.info("%s: %s", run.folder, "resumed" if command[-1].startswith("resume=") else "started")
    # A session of its own: the terminal's Ctrl-C reaches it once, through this process.
    child = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        start_new_session=True,
    )
    children.add(child)
    if stopping.is_set():
        child.terminate()
    _, errors = child.communicate()
    children.discard(child)
    if child.returncode == 0:
        log.info("%s: done in %s", run.folder, clock(time.monotonic() - begun))
        return Outcome(run, FINISHED)
    lines = [line for line in errors.splitlines() if line.strip()] or ["no message"]
    if not stopping.is_set():
        log.error("%s: failed: %s", run.folder, lines[-1])
    return Outcome(run, FAILED, lines[-1])


def note(folder: Path, study: str, command: str) -> None:
    """Append a command and its time to the notes in the study's folder."""
    when = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    commands = [*read_notes(folder).get("commands", []), f"{when}  {command}"]
    _write_notes(folder, study=study, commands=commands)


def note_problems(folder: Path, outcomes: Sequence[Outcome]) -> None:
    """Store which runs failed or differ; earlier notes on the same runs are replaced."""
    problems = dict(read_notes(folder).get("problems", {}))
    for outcome in outcomes:
        name = str(outcome.run.folder.relative_to(folder))
        problems.pop(name, None)
        if outcome.status != FINISHED:
            problems[name] = f"{outcome.status}: {outcome.note}"
    _write_notes(folder, problems=problems)


def read_notes(folder: Path) -> dict[str, Any]:
    """Return the notes in a study's folder, of which there may be none."""
    path = folder / NOTES
    return dict(read_json(path)) if path.is_file() else {}


def _write_notes(folder: Path, **changed: object) -> None:
    with atomic_path(folder / NOTES) as temporary:
        notes = read_notes(folder) | changed
        temporary.write_text(json.dumps(notes, indent=1, ensure_ascii=False), encoding="utf-8")
