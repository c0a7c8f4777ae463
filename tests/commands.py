"""The commands of the package run inside the test process, and the settings that shrink them."""

from __future__ import annotations

import hashlib
import logging
import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, chdir, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pandas as pd
import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig

from lcc_rl.cli.console import main
from lcc_rl.config import load
from lcc_rl.io.files import read_parquet
from lcc_rl.runs.interrupts import ENDING_SIGNALS

# The baselines of an evaluation by default, in their order.
UNTRAINED = ("direct", "idm", "human", "idm_acc", "acc")

# Data that take a fraction of a second to generate; enough for every entry point.
DATA = ("data.platoons=2", "data.recordings=2", "data.duration_s=[62,70]")
HORIZON = "scenario.horizon=20"
QUICK = "calibration.local_genetic.generations=2"
AGENT = ("agent.batch_size=64", "agent.hidden=[16,16]")
NO_AGENT = ("experiment=smoke", *DATA, HORIZON)
TINY = (*NO_AGENT, *AGENT)


def tiny(entry: str, *overrides: str, agent: bool = True) -> Any:
    """Compose an entry point's configuration, shrunk; without the settings of a learning agent."""
    return load(entry, [*(TINY if agent else NO_AGENT), *overrides])


def assert_same_tables(one: Path, two: Path) -> None:
    """Check that two runs left the same rows, float for float."""
    for table in ("training", "episodes", "steps"):
        frames = (read_parquet(folder / f"{table}.parquet") for folder in (one, two))
        pd.testing.assert_frame_equal(*frames, check_exact=True)


def content(folder: Path) -> dict[str, str]:
    """Return a checksum of every file of a folder, those of Hydra included."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@dataclass(frozen=True)
class Done:
    """What a command left behind."""

    returncode: int
    stdout: str
    stderr: str


def run_command(*words: str, cwd: Path, check: bool = False) -> Done:
    """Run ``lcc-rl`` with these words, without a new process, which imports for seconds.

    The process's state is put back afterwards. An exception that a process would end on is raised.
    """
    code = 0
    with process_state("lcc-rl", words, cwd) as (out, err):
        try:
            main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    done = Done(code, out.getvalue(), err.getvalue())
    assert not check or done.returncode == 0, done.stderr
    return done


def jobs_in_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the pipeline train in a thread, one variant at a time, instead of new processes."""

    def threads(max_workers: int, mp_context: object, initializer: object) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(1)

    monkeypatch.setattr("lcc_rl.commands.pipeline.ProcessPoolExecutor", threads)


# -- real processes --------------------------------------------------------------------------------


def start(*words: str, cwd: Path) -> subprocess.Popen[str]:
    """Start ``lcc-rl`` in a process, and a process group, of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "lcc_rl", *words],
        cwd=cwd,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def wait_for(path: Path, child: subprocess.Popen[str], seconds: float = 120.0) -> None:
    """Wait until a process has written a file."""
    deadline = time.monotonic() + seconds
    while not path.exists():
        assert child.poll() is None, child.communicate()[1]
        assert time.monotonic() < deadline, f"{path} did not appear"
        time.sleep(0.02)


# -- the state of this process ---------------------------------------------------------------------


@contextmanager
def process_state(
    module: str, words: tuple[str, ...], cwd: Path
) -> Iterator[tuple[StringIO, StringIO]]:
    """Give a command its arguments, folder and output; put back what it changes."""
    out, err = StringIO(), StringIO()
    threads, precision = torch.get_num_threads(), torch.get_float32_matmul_precision()
    # A fresh process has no Hydra; a state that stays would make the next load a sweep's.
    hydra, job = GlobalHydra.instance().hydra, HydraConfig.instance().cfg
    GlobalHydra.instance().clear()
    HydraConfig.instance().cfg = None
    with ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        stack.enter_context(patch.object(sys, "argv", [module, *words]))
        stack.enter_context(patch.dict(os.environ))
        stack.enter_context(chdir(cwd))
        stack.enter_context(kept_logging())
        handlers = {kind: signal.getsignal(kind) for kind in ENDING_SIGNALS}
        stack.enter_context(redirect_stdout(out))
        stack.enter_context(redirect_stderr(err))
        try:
            yield out, err
        finally:
            GlobalHydra.instance().hydra = hydra
            HydraConfig.instance().cfg = job
            for kind, handler in handlers.items():
                signal.signal(kind, handler)
            torch.set_num_threads(threads)
            torch.set_float32_matmul_precision(precision)


@contextmanager
def kept_logging() -> Iterator[None]:
    """Put loggers back as they were, and close the files that were opened meanwhile."""
    before = [(log, log.level, log.disabled, log.propagate, log.handlers[:]) for log in loggers()]
    try:
        yield
    finally:
        old = {handler for *_, handlers in before for handler in handlers}
        for log in loggers():
            for handler in set(log.handlers) - old:
                log.removeHandler(handler)
                handler.close()
        for log, level, disabled, propagate, handlers in before:
            log.setLevel(level)
            log.disabled, log.propagate, log.handlers = disabled, propagate, handlers


def loggers() -> list[logging.Logger]:
    known = logging.Logger.manager.loggerDict.values()
    return [logging.getLogger(), *(log for log in known if isinstance(log, logging.Logger))]
