"""Study room: start many trainings side by side, skip what is finished, go on where one stopped."""

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

from omegaconf import DictConfig

from lcc_rl.config import load, plain
from lcc_rl.errors import ConfigError, Interrupted
from lcc_rl.io.files import atomic_path
from lcc_rl.results.runs import CONFIG, NOT_IDENTITY, differing, flatten, load_config
from lcc_rl.runs.interrupts import interruptible
from lcc_rl.runs.progress import clock
from lcc_rl.runs.sweeps import key_of

log = logging.getLogger("lcc_rl")

NOTES = "study.json"
FINISHED, FAILED, FOREIGN = "finished", "failed", "other settings"


@dataclass(frozen=True)
class Run:
    """One training: its folder and what one would type after ``python -m lcc_rl.train``."""

    folder: Path
    overrides: tuple[str, ...]

    def compose(self) -> DictConfig:
        """Return its configuration.

        Raises:
            ConfigError: if an override is unknown or of the wrong type.
        """
        return load("train", self.overrides)

    def command(self) -> list[str]:
        """Return the command that starts it, or goes on with it where it has a checkpoint."""
        words = [sys.executable, "-m", "lcc_rl.train"]
        if (self.folder / "checkpoint.pt").exists():
            return [*words, f"resume={quoted(self.folder)}"]
        return [*words, *self.overrides, f"hydra.run.dir={quoted(self.folder)}"]


@dataclass(frozen=True)
class Outcome:
    """What became of a run: ``finished``, ``failed`` or ``other settings``, and the reason."""

    run: Run
    status: str
    note: str = ""


def quoted(path: str | Path) -> str:
    """Return a path as Hydra's command line takes it, whatever characters are in it."""
    return "'" + str(path).replace("\\", "\\\\").replace("'", "\\'") + "'"


GIVEN = ("seed", "variant")  # what a study gives each of its runs


def check_overrides(words: Sequence[str]) -> None:
    """Check that what is left of a command line are overrides.

    Raises:
        ConfigError: if a word is an option or nothing, or sets what every run gets from the study.
    """
    if any(word.startswith("-") or ("=" not in word and word[:1] != "~") for word in words):
        raise ConfigError(f"expected overrides such as data=stream, got {' '.join(words)}")
    for word in words:
        if key_of(word) in GIVEN:
            raise ConfigError(
                f"{word}: every run has its own; say --seeds, how many, counted from 0, "
                "and which variants by the options of this command"
            )


def differences(run: Run, wanted: DictConfig, accept: Sequence[str] = ()) -> list[str]:
    """List the settings in which a run's folder differs from what is wanted of it.

    Args:
        run: the run; its folder holds a configuration.
        wanted: the configuration it should have.
        accept: dotted keys, or beginnings of them, that may differ (``data``, ``drivers.path``).

    Returns:
        ``key: found → wanted`` for each.
    """
    found, asked = (_settings(cfg) for cfg in (load_config(run.folder), wanted))
    return [
        f"{key}: {found.get(key)} → {asked.get(key)}"
        for key in differing(found, asked)
        if not any(key == item or key.startswith(f"{item}.") for item in accept)
    ]


def _settings(cfg: DictConfig) -> dict[str, Any]:
    return {k: v for k, v in flatten(plain(cfg)) if not _no_matter(k)}


def _no_matter(key: str) -> bool:
    return any(key == item or key.startswith(f"{item}.") for item in NOT_IDENTITY)


def run_all(runs: Sequence[Run], jobs: int, accept: Sequence[str] = ()) -> list[Outcome]:
    """Do what is left to do of all runs, ``jobs`` at a time; a failure does not stop the others.

    A run whose folder was made with other settings is left alone and reported.

    Raises:
        ConfigError: if a run's settings are wrong; checked for all before the first starts.
        Interrupted: on SIGINT or SIGTERM, after every training at hand is saved.
    """
    outcomes, todo = [], []
    for run in runs:
        wanted = run.compose()
        known = (run.folder / CONFIG).is_file()
        other = differences(run, wanted, accept) if known else []
        if other:
            log.error("%s: left out, it has other settings: %s", run.folder, "; ".join(other))
            outcomes.append(Outcome(run, FOREIGN, "; ".join(other)))
        elif known and (run.folder / "episodes.parquet").exists():
            outcomes.append(Outcome(run, FINISHED))
        else:
            todo.append(run)
    finished = sum(outcome.status == FINISHED for outcome in outcomes)
    log.info("%d runs: %d to do, %d finished before", len(runs), len(todo), finished)
    return outcomes + _start(todo, jobs)


def _start(runs: Sequence[Run], jobs: int) -> list[Outcome]:
    """Run processes side by side; on an interrupt let each save its state."""
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
            raise Interrupted("stopped; the same command goes on from here") from None


def _one(run: Run, children: set[subprocess.Popen[str]], stopping: threading.Event) -> Outcome:
    if stopping.is_set():
        return Outcome(run, FAILED, "not started")
    run.folder.mkdir(parents=True, exist_ok=True)
    command, begun = run.command(), time.monotonic()
    log.info("%s: %s", run.folder, "going on" if command[-1].startswith("resume=") else "started")
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
    """Keep what was typed, and when, in the study's folder."""
    notes = read_notes(folder)
    notes["study"] = study
    when = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    notes["commands"] = [*notes.get("commands", []), f"{when}  {command}"]
    _write(folder, notes)


def note_problems(folder: Path, outcomes: Sequence[Outcome]) -> None:
    """Keep which runs failed or differ, replacing what was known of these runs before."""
    notes = read_notes(folder)
    problems = dict(notes.get("problems", {}))
    for outcome in outcomes:
        name = str(outcome.run.folder.relative_to(folder))
        problems.pop(name, None)
        if outcome.status != FINISHED:
            problems[name] = f"{outcome.status}: {outcome.note}"
    notes["problems"] = problems
    _write(folder, notes)


def read_notes(folder: Path) -> dict[str, Any]:
    """Return what the study's folder says of itself; empty where it says nothing."""
    try:
        return dict(json.loads((folder / NOTES).read_text()))
    except (OSError, ValueError):
        return {}


def _write(folder: Path, notes: dict[str, Any]) -> None:
    with atomic_path(folder / NOTES) as temporary:
        temporary.write_text(json.dumps(notes, indent=1, ensure_ascii=False))
