"""Kill small commands of every kind at random moments and check their files each time.

    python tools/kill_test.py --kills 200

A kill counts if it ended an active process. After each kill, every file must be readable and no
finished run may be missing or written again; the final rows must equal those of commands that were
not killed. Prints the counts; the exit code is 1 if a check fails or the time ends before the last
kill.
"""

from __future__ import annotations

import argparse
import faulthandler
import hashlib
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
from dataclasses import dataclass, field
from pathlib import Path

import torch
from matplotlib.image import imread

from lcc_rl.cli import console
from lcc_rl.commands.pipeline import COMMAND_FILE
from lcc_rl.commands.repeat import compared
from lcc_rl.config import load
from lcc_rl.errors import ResultsError
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.io.settings import read_json
from lcc_rl.io.tensors import read_torch
from lcc_rl.results.runs import read_settings
from lcc_rl.runs.interrupts import INTERRUPTED
from lcc_rl.runs.states import LOCK, RESULT_TABLES, read_progress

SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
WAITED = os.WEXITED | os.WNOHANG | os.WNOWAIT
PATIENCE = 120.0  # timeout of a process after a signal [s]
READERS: dict[str, Callable[[Path], object]] = {
    ".parquet": read_parquet,
    ".pt": read_torch,
    ".png": imread,
    ".json": read_json,
    ".yaml": read_settings,
}


@dataclass
class Job:
    """A command and the state of its runs.

    Args:
        words: its name and settings.
        where: the setting of the folder.
        share: share of the kills of this command.
        root: folder of its files.
    """

    words: list[str]
    where: str
    share: float
    root: Path
    length: float = 0.0  # seconds of the command that is not killed
    completed: int = 0
    seen: Counter[str] = field(default_factory=Counter)

    @property
    def whole(self) -> Path:
        """Folder of the command that is not killed."""
        return self.root / "whole"

    @property
    def killed(self) -> Path:
        """Folder of the command that is killed; a new one after its end."""
        return self.root / f"killed{self.completed}"

    def start(self, folder: Path) -> int:
        """Start or resume the command in a separate process; return its id."""
        child = os.fork()  # importing torch again would take longer than the command
        if child:
            return child
        os.setsid()
        output = os.open(self.root / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(output, 1)
        os.dup2(output, 2)
        faulthandler.register(signal.SIGUSR1)
        # Processes in the background of a shell ignore SIGINT by default.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        words = [*self.words, f"{self.where}={folder}"]
        if (folder / COMMAND_FILE).exists():
            words = [self.words[0], f"resume={folder}"]
        code = 0
        try:
            console.main(words)
        except SystemExit as stop:
            code = int(stop.code or 0)
        except BaseException:
            code = 1
            traceback.print_exc()
        finally:
            os._exit(code)

    def complete(self, folder: Path) -> None:
        """Complete the command's work."""
        code = os.waitstatus_to_exitcode(os.waitpid(self.start(folder), 0)[1])
        assert code == 0, self.tail()

    def tail(self) -> str:
        """Return the last lines of the command's output."""
        lines = (self.root / "log").read_text(errors="replace", encoding="utf-8").splitlines()
        return "\n".join(lines[-100:])

    def disturb(self, delay: float, kind: int, group: bool) -> bool:
        """Start the command and send it a signal; return whether the signal ended it.

        Args:
            delay: seconds until the signal.
            kind: the signal.
            group: send it to the command's child processes, too.
        """
        child = self.start(self.killed)
        deadline = time.monotonic() + delay
        while time.monotonic() < deadline and os.waitid(os.P_PID, child, WAITED) is None:
            time.sleep(0.002)
        (os.killpg if group else os.kill)(child, kind)  # no effect if it has ended
        patience = time.monotonic() + PATIENCE
        while os.waitid(os.P_PID, child, WAITED) is None or at_work(child):
            if time.monotonic() > patience:
                os.killpg(child, signal.SIGUSR1)  # prints the stack
                time.sleep(1.0)
                os.killpg(child, signal.SIGKILL)
                os.waitpid(child, 0)
                raise AssertionError(f"hung after {signal.Signals(kind).name}: {self.tail()}")
            time.sleep(0.01)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        assert code in (0, -kind, INTERRUPTED), f"exit code {code}: {self.tail()}"
        return code != 0

    def kill(self, chance: random.Random) -> bool:
        """Kill the command once and check its files; return whether it was active."""
        before, kind = finished(self.killed), chance.choice(SIGNALS)
        group = kind == signal.SIGINT or chance.random() < 0.5  # as a terminal does
        ended = self.disturb(chance.uniform(0.0, self.length), kind, group)
        now, wrong = finished(self.killed), unreadable(self.killed)
        assert before.items() <= now.items(), f"missing or changed: {before} became {now}"
        assert not wrong, "\n".join(wrong)
        if ended:
            self.seen[signal.Signals(kind).name] += 1
        else:
            self.end()
        return ended

    def end(self) -> None:
        """Check the files of a completed command, and start another one."""
        compare(self.whole, self.killed)
        self.completed += 1
        self.seen["completed"] += 1


def at_work(group: int) -> bool:
    """Return whether a process of a group runs; a zombie does not."""
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _, own = path.read_text(encoding="utf-8").rpartition(")")[2].split()[:3]
            if int(own) == group and state != "Z":
                return True
    return False


def unreadable(root: Path) -> list[str]:
    """Return the unreadable files of a folder, with the error."""
    wrong = []
    for path in root.rglob("*"):
        if path.name.startswith(".") or ".hydra" in path.parts or path.suffix not in READERS:
            continue
        try:
            if path.name == "progress.json" and read_progress(path.parent) is None:
                raise ResultsError("damaged")
            READERS[path.suffix](path)
        except (ResultsError, OSError, SyntaxError) as error:  # the last two are errors of figures
            wrong.append(f"{path}: {error}")
    return wrong


def finished(root: Path) -> dict[str, str]:
    """Return the tables of finished runs, with the hash of each."""
    tables = [path for name in RESULT_TABLES for path in root.rglob(name)]
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in tables}


def compare(whole: Path, killed: Path) -> None:
    """Check that two folders have the same files, and their tables the same rows."""
    names, others = (
        {str(x.relative_to(root)) for x in root.rglob("*") if x.is_file() and x.suffix != ".log"}
        for root in (whole, killed)
    )
    differ = {name for name in names ^ others if Path(name).name != LOCK}
    assert not differ, f"files differ: {differ}"
    wrong = [sentence for sentence, equal in compared(whole, killed) if not equal]
    assert not wrong, "\n".join(wrong)


def jobs(folder: Path) -> dict[str, Job]:
    """Return the commands to kill, each run to its end once."""
    source = load("train", ["data.platoons=4", "data.recordings=2"]).data.made()
    write_parquet(source.load().episodes, folder / "pairs.parquet")
    small = ["experiment=smoke", "scenario.horizon=40", "data=episodes"]
    small += [f"data.path={folder / 'pairs.parquet'}"]
    agent = ["agent.batch_size=64", "agent.hidden=[16,16]", "training.episodes=48"]
    sweep = ["train", "-m", *small, *agent, "seed=0,1"]
    one = ["evaluate", *small, "policy=pretrained", "compare=[pretrained/reference]"]
    whole = ["run", *small, *agent, "calibration.local_genetic.generations=2", "jobs=1"]
    whole += ["training.checkpoint_every=1"]
    fitted = ["data.platoons=4", "data.recordings=2", "calibration.local_genetic.generations=2"]
    calibrate = ["calibrate", *fitted]
    study = ["reproduce", "alcc", "--recipe=smoke", "--seeds=1", "--parts=main", *fitted]
    study += ["training.episodes=48", "scenario.horizon=40"]
    found = {
        "sweeps": Job(sweep, "hydra.sweep.dir", 0.4, folder / "sweep"),
        "evaluations": Job(one, "hydra.run.dir", 0.2, folder / "evaluation"),
        "pipelines": Job(whole, "hydra.run.dir", 0.2, folder / "pipeline"),
        "calibrations": Job(calibrate, "hydra.run.dir", 0.1, folder / "calibration"),
        "studies": Job(study, "--out", 0.1, folder / "study"),
    }
    for job in found.values():
        job.root.mkdir()
        begun = time.monotonic()
        job.complete(job.whole)
        job.length = time.monotonic() - begun
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the test with the numbers given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="at most, of killing")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        killed, done, chance = jobs(Path(folder)), 0, random.Random(options.seed)
        begun, shares = time.monotonic(), [job.share for job in killed.values()]
        try:
            while done < options.kills and time.monotonic() - begun < options.seconds:
                done += chance.choices(list(killed.values()), shares)[0].kill(chance)
            for job in killed.values():
                job.complete(job.killed)
                job.end()
        finally:
            counts = ((what, name, n) for name, x in killed.items() for what, n in x.seen.items())
            listed = ", ".join(f"{n} {what} in {name}" for what, name, n in sorted(counts))
            print(f"{done} kills: {listed}; {time.monotonic() - begun:.0f} s", flush=True)
    if done < options.kills:
        sys.exit(f"too few: {done} of {options.kills} kills ended an active command")
    print("all files are present and readable, rows are identical")


if __name__ == "__main__":
    main()
