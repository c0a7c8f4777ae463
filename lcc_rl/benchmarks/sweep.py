"""Benchmark of a sweep of short runs: what each costs besides its training, and reading them."""

from __future__ import annotations

import subprocess
import sys
import time
from argparse import Namespace
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage
from tempfile import TemporaryDirectory

import numpy as np

from lcc_rl import results
from lcc_rl.benchmarks.harness import Row, installed, rows_of
from lcc_rl.errors import ResultsError
from lcc_rl.runs.sweeps import parallel_jobs

RUNS, FEW = 100, 3
SHORT = ("experiment=smoke", "variant=alcc")


def sweep(options: Namespace) -> list[Row]:
    """Seconds of a core that a run takes besides its training, by launcher; seconds to read all.

    Everything counts: imports, composing, the data, checkpoints, the evaluation, the files.
    """
    runs = FEW if options.quick else RUNS
    jobs = {"one after another": ("hydra/launcher=basic", 1)}
    if installed("hydra_plugins.hydra_joblib_launcher") and not options.quick:
        jobs["joblib"] = ("hydra/launcher=lcc_joblib", parallel_jobs(options.threads))
    rows = []
    with TemporaryDirectory() as folder:
        for case, (launcher, cores) in jobs.items():
            words = [*SHORT, f"seed=range({runs})", f"threads={options.threads}", launcher]
            place = Path(folder) / case.replace(" ", "-")
            wall, used = seconds_of([*words, f"hydra.sweep.dir={place}"])
            timing = results.load(place, "timing")
            training = float(timing[["collect_s", "learn_s"]].sum().sum())
            # A busy machine lengthens everything alike: the shares of the clock are those of work.
            besides = 1.0 - training / (wall * cores)
            for unit, spent in (("s", wall * cores), ("s of processor", used)):
                value = {f"a run, {case}": np.array([spent * besides / runs])}
                rows += rows_of("sweep", value, unit, batch=runs)
        begun = time.perf_counter()
        assert results.load(place)["run"].nunique() == runs
        reading = {"reading all results": np.array([time.perf_counter() - begun])}
    return rows + rows_of("sweep", reading, "s", batch=runs)


def seconds_of(words: list[str]) -> tuple[float, float]:
    """Do a sweep in a process of its own; return its seconds on the clock and of processors.

    Raises:
        ResultsError: if it fails, with what it said.
    """
    command = [sys.executable, "-m", "lcc_rl.train", "-m", *words]
    begun, before = time.perf_counter(), getrusage(RUSAGE_CHILDREN)
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        raise ResultsError(f"the sweep failed: {done.stderr[-1000:]}")
    wall, after = time.perf_counter() - begun, getrusage(RUSAGE_CHILDREN)
    return wall, after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
