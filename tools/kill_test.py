"""Kill a small sweep at random moments and check its files each time.

    python tools/kill_test.py --kills 200

After every kill each file must be readable and no finished run may be lost; the final rows must
equal those of an undisturbed sweep. Prints the counts; the exit code is 1 if a check fails.
"""

from __future__ import annotations

import argparse
import faulthandler
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import torch

from lcc_rl import results, train
from lcc_rl.commands.training import EPISODES
from lcc_rl.config import load
from lcc_rl.data.episodes import write_episodes
from lcc_rl.data.sources import LoadedEpisodes
from lcc_rl.errors import ResultsError
from lcc_rl.io.files import read_parquet, read_torch
from lcc_rl.results.runs import read_settings
from lcc_rl.runs.states import read_progress, survey

SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
TABLES = ("training", "episodes", "steps")
TINY = (
    "experiment=smoke",
    "scenario.horizon=40",
    "agent.batch_size=64",
    "agent.hidden=[16,16]",
    "training.episodes=48",
    "seed=0,1",
)


def tiny_data(folder: Path) -> Path:
    """Write the episodes that every sweep here reads."""
    from lcc_rl.config import build

    cfg = load("train", ["data.platoons=4", "data.recordings=2"])
    loaded: LoadedEpisodes = build(cfg.data, "data").load()
    path = folder / "pairs.parquet"
    write_episodes(loaded.episodes, path)
    return path


def start(words: Sequence[str], log: Path) -> int:
    """Start the sweep in a process of its own, as the command line would; return its id."""
    child = os.fork()  # importing torch again would take longer than the sweep
    if child:
        return child
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(output, 1)
    os.dup2(output, 2)
    faulthandler.register(signal.SIGUSR1)
    # A shell that starts this in the background makes it, and all below it, deaf to SIGINT.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.argv = ["train", "-m", *words]
    code = 0
    try:
        train.main()
    except SystemExit as stop:
        code = int(stop.code or 0)
    finally:
        os._exit(code)


def unreadable(sweep: Path) -> list[str]:
    """Return the files of a sweep that cannot be read, with the reason."""
    wrong = []
    for path in sweep.rglob("*"):
        if path.name.startswith(".") or ".hydra" in path.parts:
            continue
        try:
            if path.suffix == ".parquet":
                read_parquet(path)
            elif path.suffix == ".pt":
                read_torch(path)
            elif path.name == "config.yaml":
                read_settings(path)
            elif path.name == "progress.json" and read_progress(path.parent) is None:
                raise ResultsError(f"{path}: damaged")
        except ResultsError as error:
            wrong.append(str(error))
    return wrong


def finished(sweep: Path) -> dict[str, int]:
    """Return the finished runs and when their table was written."""
    names = [state.name for state in survey(sweep) if state.state == "finished"]
    return {name: (sweep / name / EPISODES).stat().st_mtime_ns for name in names}


def tail(log: Path, lines: int = 100) -> list[str]:
    """Return the last lines of what a sweep said."""
    return log.read_text(errors="replace").splitlines()[-lines:]


def disturb(words: Sequence[str], sweep: Path, log: Path, delay: float, kind: int) -> str:
    """Start the sweep, send it a signal after a delay, and say what that did."""
    child = start(words, log)
    deadline = time.monotonic() + delay
    while time.monotonic() < deadline:
        if os.waitpid(child, os.WNOHANG)[0]:
            return "was done"
        time.sleep(0.002)
    os.kill(child, kind)
    patience = time.monotonic() + 60
    while not os.waitpid(child, os.WNOHANG)[0]:
        if time.monotonic() > patience:
            os.kill(child, signal.SIGUSR1)  # where it hangs
            time.sleep(1.0)
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            print(f"hung after {signal.Signals(kind).name}:", *tail(log), sep="\n", flush=True)
            return "hung"
        time.sleep(0.002)
    return signal.Signals(kind).name


def compare(whole: Path, sweep: Path) -> None:
    """Check that two sweeps hold the same runs with the same rows."""
    for table in TABLES:
        expected, found = (results.load(folder, table, strict=True) for folder in (whole, sweep))
        pd.testing.assert_frame_equal(found, expected, check_exact=True)


def run(kills: int, seed: int, folder: Path, limit: float) -> Counter[str]:
    """Do the whole test; return what the kills did.

    Raises:
        AssertionError: saying what was lost, damaged or different.
    """
    data = tiny_data(folder)
    whole, sweep = folder / "whole", folder / "killed"
    words = [*TINY, "data=episodes", f"data.path={data}"]
    begun = time.monotonic()
    os.waitpid(start([*words, f"hydra.sweep.dir={whole}"], folder / "whole.log"), 0)
    assert len(finished(whole)) == 2, "\n".join(tail(folder / "whole.log"))
    length, chance = time.monotonic() - begun, random.Random(seed)
    seen: Counter[str] = Counter()
    words.append(f"hydra.sweep.dir={sweep}")
    known: dict[str, int] = {}
    for number in range(kills):
        if time.monotonic() - begun > limit:
            break
        if len(known) == 2:  # all is done: begin anew
            sweep.rename(folder / f"done{number}")
            compare(whole, folder / f"done{number}")
            known = {}
            seen["sweeps completed"] += 1
        delay = chance.uniform(0.0, 0.6 * length)
        seen[disturb(words, sweep, folder / "killed.log", delay, chance.choice(SIGNALS))] += 1
        now = finished(sweep) if sweep.exists() else {}
        assert known.items() <= now.items(), f"lost or written again: {known} became {now}"
        known = now
        wrong = unreadable(sweep)
        assert not wrong, "\n".join(wrong)
    os.waitpid(start(words, folder / "killed.log"), 0)
    compare(whole, sweep)
    seen["sweeps completed"] += 1
    assert not seen["hung"], "a process did not react to its signal within a minute"
    return seen


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the test with the numbers given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop killing then")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        begun = time.monotonic()
        seen = run(options.kills, options.seed, Path(folder), options.seconds)
    told = ", ".join(f"{count} {name}" for name, count in sorted(seen.items()))
    print(f"{told}; {time.monotonic() - begun:.0f} s; nothing lost, all readable, rows identical")


if __name__ == "__main__":
    main()
