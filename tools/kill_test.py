"""Kill small sweeps, evaluations and pipelines at random moments and check their files each time.

    python tools/kill_test.py --kills 200

A kill counts if it ended a process at work. After each, every file must be readable and no finished
run may be lost or written again; the final rows must equal those of commands never killed. Prints
the counts; the exit code is 1 if a check fails or the time is over before the last kill.
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
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import torch
from kill_checks import compare, finished, unreadable

from lcc_rl import evaluate, pipeline, train
from lcc_rl.commands.pipeline import OVERRIDES
from lcc_rl.config import load
from lcc_rl.data.episodes import write_episodes
from lcc_rl.data.sources import LoadedEpisodes
from lcc_rl.runs.interrupts import INTERRUPTED

SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
WAITED = os.WEXITED | os.WNOHANG | os.WNOWAIT
PATIENCE = 120.0  # for a process to react to a signal, or to leave its folder [s]
SMALL = ("experiment=smoke", "scenario.horizon=40")
AGENT = ("agent.batch_size=64", "agent.hidden=[16,16]", "training.episodes=48")
QUICK = "calibration.local_genetic.generations=2"


@dataclass
class Job:
    """A command, where it writes, and what is known of the runs it finished.

    Args:
        main: the entry point.
        words: what is typed.
        where: the setting of the folder.
        share: of the kills that meet this command.
    """

    main: Callable[[], None]
    words: list[str]
    where: str
    share: float
    length: float = 0.0  # seconds of the command never killed
    completed: int = 0

    def typed(self, folder: Path) -> list[str]:
        """Return the words that begin the command, or that resume it where that takes others."""
        if (folder / OVERRIDES).exists():
            return [f"resume={folder}"]
        return [*self.words, f"{self.where}={folder}"]


def jobs(data: Path) -> dict[str, Job]:
    """Return the commands that are killed."""
    read = ["data=episodes", f"data.path={data}"]
    sweep = ["-m", *SMALL, *AGENT, "seed=0,1", *read]
    one = [*SMALL, "policy=pretrained", "compare=[pretrained/reference]", *read]
    whole = [*SMALL, *AGENT, QUICK, "jobs=1", "training.checkpoint_every=1", *read]
    return {
        "sweep": Job(train.main, sweep, "hydra.sweep.dir", 0.5),
        "evaluation": Job(evaluate.main, one, "hydra.run.dir", 0.25),
        "pipeline": Job(pipeline.main, whole, "hydra.run.dir", 0.25),
    }


def tiny_data(folder: Path) -> Path:
    """Write the episodes that every command here reads."""
    from lcc_rl.nodes import build

    cfg = load("train", ["data.platoons=4", "data.recordings=2"])
    loaded: LoadedEpisodes = build(cfg.data, "data").load()
    path = folder / "pairs.parquet"
    write_episodes(loaded.episodes, path)
    return path


def start(job: Job, folder: Path, log: Path) -> int:
    """Start a command in a process of its own, as the command line would; return its id."""
    child = os.fork()  # importing torch again would take longer than the command
    if child:
        return child
    os.setsid()
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(output, 1)
    os.dup2(output, 2)
    faulthandler.register(signal.SIGUSR1)
    # A shell that starts this in the background makes it, and all below it, deaf to SIGINT.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.argv = [job.main.__module__, *job.typed(folder)]
    code = 0
    try:
        job.main()
    except SystemExit as stop:
        code = int(stop.code or 0)
    except BaseException:
        code = 1
        traceback.print_exc()
    finally:
        os._exit(code)


def tail(log: Path, lines: int = 100) -> list[str]:
    """Return the last lines of what a command said."""
    return log.read_text(errors="replace").splitlines()[-lines:]


def at_work(group: int) -> bool:
    """Whether a process of a group lives; one that nobody waited for does not."""
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _, own = path.read_text().rpartition(")")[2].split()[:3]
            if int(own) == group and state != "Z":
                return True
    return False


def disturb(job: Job, folder: Path, log: Path, delay: float, kind: int, all_: bool) -> str:
    """Start a command, send it a signal after a delay, and say what ended it.

    Args:
        job: the command.
        folder: where it writes.
        log: where its output goes.
        delay: seconds until the signal.
        kind: the signal.
        all_: send it to the command's own processes, too.

    Returns:
        The name of the signal; ``"was done"`` if the command came to its end nevertheless.
    """
    child = start(job, folder, log)
    deadline = time.monotonic() + delay
    while time.monotonic() < deadline and os.waitid(os.P_PID, child, WAITED) is None:
        time.sleep(0.002)
    (os.killpg if all_ else os.kill)(child, kind)  # which does nothing to one that has ended
    patience = time.monotonic() + PATIENCE
    while os.waitid(os.P_PID, child, WAITED) is None or at_work(child):
        if time.monotonic() > patience:
            os.killpg(child, signal.SIGUSR1)  # where it hangs
            time.sleep(1.0)
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            print(f"hung after {signal.Signals(kind).name}:", *tail(log), sep="\n", flush=True)
            return "hung"
        time.sleep(0.01)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code == 0:
        return "was done"
    assert code in (-kind, INTERRUPTED), "\n".join([f"exit code {code}", *tail(log)])
    return signal.Signals(kind).name


def complete(job: Job, folder: Path, log: Path) -> None:
    """Let a command do what is left of its work."""
    code = os.waitstatus_to_exitcode(os.waitpid(start(job, folder, log), 0)[1])
    assert code == 0, "\n".join(tail(log))


class Test:
    """Kills of the commands of one folder.

    Args:
        folder: where everything goes.
        seed: of the moments and signals.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.chance, self.seen = folder, random.Random(seed), Counter[str]()
        self.jobs = jobs(tiny_data(folder))
        for name, job in self.jobs.items():
            begun = time.monotonic()
            complete(job, self.whole(name), self.log(name))
            job.length = time.monotonic() - begun

    def whole(self, name: str) -> Path:
        """Return the folder of a command never killed."""
        return self.folder / "whole" / name

    def killed(self, name: str) -> Path:
        """Return the folder of a command that is killed; another one once that came to its end."""
        return self.folder / f"killed{self.jobs[name].completed}" / name

    def log(self, name: str) -> Path:
        """Return where a command's output goes."""
        return self.folder / f"{name}.log"

    def kill(self) -> bool:
        """Kill a command once, check its files, and say whether the kill met one at work.

        Raises:
            AssertionError: saying what was lost, damaged or different.
        """
        names = list(self.jobs)
        shares = [job.share for job in self.jobs.values()]
        name = self.chance.choices(names, shares)[0]
        job, folder = self.jobs[name], self.killed(name)
        before, kind = finished(folder), self.chance.choice(SIGNALS)
        all_ = kind == signal.SIGINT or self.chance.random() < 0.5  # as a terminal does
        delay = self.chance.uniform(0.0, job.length)
        what = disturb(job, folder, self.log(name), delay, kind, all_)
        assert what != "hung", "a process did not react to its signal in time"
        now, wrong = finished(folder), unreadable(folder)
        assert before.items() <= now.items(), f"lost or changed: {before} became {now}"
        assert not wrong, "\n".join(wrong)
        if what == "was done":
            self.end(name)
            return False
        self.seen[f"{what} in {name}s"] += 1
        return True

    def end(self, name: str) -> None:
        """Check what a command left that came to its end, and begin another one."""
        compare(self.whole(name), self.killed(name))
        self.jobs[name].completed += 1
        self.seen[f"{name}s completed"] += 1


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the test with the numbers given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="at most, of killing")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        test, done = Test(Path(folder), options.seed), 0
        begun = time.monotonic()
        try:
            while done < options.kills and time.monotonic() - begun < options.seconds:
                done += test.kill()
            for name, job in test.jobs.items():
                complete(job, test.killed(name), test.log(name))
                test.end(name)
        finally:
            told = ", ".join(f"{count} {name}" for name, count in sorted(test.seen.items()))
            print(f"{done} kills: {told}; {time.monotonic() - begun:.0f} s", flush=True)
    if done < options.kills:
        sys.exit(f"too few: {done} of {options.kills} kills met a command at work")
    print("nothing lost, all readable, rows identical")


if __name__ == "__main__":
    main()
