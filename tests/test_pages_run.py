"""The pages' commands and programs run from the first to the last, at the size of a try."""

from __future__ import annotations

import re
import runpy
import shlex
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import matplotlib as mpl
import pytest
from commands import DATA, QUICK, jobs_in_threads, process_state, run_command
from page_checks import ENTRIES, LAUNCH, one_run, settings_of
from page_files import LEFT_OUT, write_named
from pages import PAGES, ROOT, Block, blocks, commands, name_of

from lcc_rl import learn
from lcc_rl.cli import console
from lcc_rl.config import load
from lcc_rl.errors import ConfigError

# Commands that are parsed and composed only, by their first words, and why.
NOT_RUN = {
    "make": "sets up an environment",
    "pip": "needs a package index",
    "source": "of the shell",
    "export": "of the shell",
    "ls": "of the shell",
    "lcc-rl reproduce": "tests/studies run both studies at the size of a try",
    "python tools/sumo_ring.py": "tests/interfaces/test_sumo_bridge.py drives in SUMO",
    "lcc-rl animate": "tests/results/test_animation.py runs it",
    "lcc-rl maps": "tests/results/test_figures.py runs it",
    "python tools/benchmarks": "tests/tools/test_benchmark.py runs it",
    "python tools/kill_test.py": "takes an hour",
}
# Settings that shrink a command, where they are settings of it.
SMALL = (
    "scenario.horizon=40",
    "training.episodes=24",
    "training.environments=8",
    "training.segment=20",
    "training.checkpoint_every=1",
    "evaluation.profiles=2",
    "evaluation.drivers=2",
    "evaluation.full_length=false",
    QUICK,
    *DATA,
)
OF_TRAINING = ("agent.batch_size=64", "agent.population=4")
# What a page asks for, and what is enough for a try.
ENOUGH = {
    "range(8)": "range(2)",
    "range(64)": "range(2)",
    "evaluation.shards=64": "evaluation.shards=2 evaluation.batch_size=8",
    "automated*100": "automated*8",
    "evaluation.repeats=2000": "evaluation.repeats=4",
    "evaluation.repeats=200": "evaluation.repeats=2",
    "--iterations 200": "--iterations 2",
    '["experiment=limits"]': repr([*SMALL[:4], *SMALL[5:7], *DATA]),
    '["+filter=cbf"]': repr(["+filter=cbf", SMALL[0], *SMALL[5:7], *DATA]),
    "batch_size=1024": "batch_size=4",
    "num_envs=64": "num_envs=2",
    "rollout(6000": "rollout(20",
    "rollout(300": "rollout(20",
    "(0, 2999, 5999)": "(0, 9, 19)",
}


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run that stands for one which a page does not make itself."""
    small = ["experiment=smoke", "agent.batch_size=64", "seed=7", *DATA]
    return learn("alcc", small, tmp_path_factory.mktemp("pages") / "run").folder


# Extras that a page's commands need.
NEEDS = {"docs/interfaces.md": ("gymnasium", "onnx", "onnxscript", "onnxruntime")}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of what a reader may see
@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_everything_on_a_page_runs(page, run, tmp_path, monkeypatch) -> None:
    for extra in NEEDS.get(name_of(page), ()):
        pytest.importorskip(extra)
    jobs_in_threads(monkeypatch)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    mpl.use("agg")
    modules = set(sys.modules)
    write_named(page.read_text(), tmp_path)
    reader = Reader(tmp_path, run)
    for block in blocks(page):
        reader.read(block)
    for name in set(sys.modules) - modules:
        if (tmp_path / f"{name}.py").exists():
            del sys.modules[name]
    assert not reader.failures, "\n\n".join(f"{name_of(page)}:{said}" for said in reader.failures)


class Reader:
    """Does what a page says, in one folder."""

    def __init__(self, folder: Path, run: Path) -> None:
        self.folder, self.run = folder, run
        self.space: dict[str, object] = {}
        self.failures: list[str] = []
        self.count = 0

    def read(self, block: Block) -> None:
        """Write a file, execute a program or run commands; note what goes wrong."""
        file = re.match(r"# ([\w/]+\.py)", block.text)
        if block.language == "yaml":
            self.write(block.before.strip("`:"), block.text)
        elif block.language == "python" and file:
            self.write(file[1], block.text)
        elif block.language == "python" and "my.sumocfg" not in block.text:  # of the reader's own
            self.note(block.line, "python", lambda: exec(self.filled(block.text), self.space))
        elif block.language in ("bash", "console"):
            for words in commands(block):
                error = re.search(r"^lcc_rl: error: .{20}", block.text, flags=re.M)
                act = partial(self.command, words, error and error[0])
                self.note(block.line, shlex.join(words), act)

    def write(self, name: str, text: str) -> None:
        """Add to a file that the page tells to write."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as file:
            file.write(text)
        sys.modules.pop(path.stem, None)  # the next command imports it anew, as a process would

    def note(self, line: int, told: str, act: Callable[[], object]) -> None:
        """Do something; keep what goes wrong."""
        try:
            act()
        except (Exception, SystemExit) as error:
            self.failures.append(f"{line}: {told}: {type(error).__name__}: {error}")

    def command(self, words: list[str], error: str | None) -> None:
        """Run one command; one whose error the page shows ends with it."""
        told = " ".join(words)
        if told.startswith(tuple(NOT_RUN)) or "hydra/sweeper=" in told:
            return
        words = [word for word in words if not word.startswith(LAUNCH)]
        for group, (key, path) in LEFT_OUT.items():
            if group in words:
                words = [f"{key}={path}" if word == f"{key}=…" else word for word in words]
        program, name, *rest = shlex.split(self.filled(shlex.join(words)))
        if program == "python":
            self.tool(name, rest)
            return
        rest += [] if error else self.shrunk(name, rest)
        done = run_command("lcc_rl.cli.console", name, *rest, cwd=self.folder)
        assert done.returncode == (2 if error else 0), done.stderr[-2000:]
        assert not error or error in done.stderr, done.stderr

    def tool(self, name: str, words: Sequence[str]) -> None:
        """Run a script of tools/."""
        code: object = 0
        with process_state(name, tuple(words), self.folder) as (_, errors):
            try:
                runpy.run_path(str(ROOT / name), run_name="__main__")
            except SystemExit as end:
                code = end.code
        assert not code, errors.getvalue()

    def shrunk(self, name: str, words: Sequence[str]) -> list[str]:
        """Return further words that make a command a matter of seconds."""
        if name == "clairvoyant":
            return ["--iterations", "2", "--no-compile", *SMALL[:1], *SMALL[5:7], *DATA]
        if name not in console.HYDRA or any(word.startswith("resume=") for word in words):
            return []
        self.count += 1
        place = [] if "-m" in words else [f"hydra.run.dir=outputs/{name}/{self.count}"]
        if "experiment=smoke" in words:  # small by itself
            return place
        entry = ENTRIES.get(name, name)
        typed = settings_of(words, self.folder)
        ends = [[one_run(word, choice) for word in typed] for choice in (0, -1)]
        sweep = ends[0] != ends[1]  # some of its runs may learn nothing
        small = [*SMALL, *(OF_TRAINING if name != "evaluate" and not sweep else ())]
        fits = (item for item in small if all(composes(entry, [*e, item], sweep) for e in ends))
        return [*place, *fits]

    def filled(self, text: str) -> str:
        """Put sizes of a try, and runs of this page, in place of what the page says."""
        for much, little in ENOUGH.items():
            text = text.replace(much, little)
        return re.sub(r"(?:outputs/(\w+)/)?<([a-z ]+)>(/\w+\.parquet)?", self.latest, text)

    def latest(self, found: re.Match[str]) -> str:
        """Return the run that the page made last, of the kind that its name says."""
        kind, name, file = found.groups()
        if file == "/trajectories.parquet":
            return f"outputs/{kind}/run{file}"
        holds = file or ("/episodes.parquet" if kind == "evaluate" else "/policy.pt")
        where = kind or ("calibrate" if file else "train")
        runs = sorted(
            self.folder.glob(f"outputs/{where}/**/{holds[1:]}"), key=lambda p: p.stat().st_mtime
        )
        folder = runs[-1].parent if runs and not name.startswith("other") else self.run
        return f"{folder}{file or ''}"


def composes(entry: str, settings: Sequence[str], sweep: bool) -> bool:
    """Whether settings compose; in a sweep, runs that learn nothing may be given how to."""
    try:
        load(entry, settings)
    except ConfigError as error:
        return sweep and "learns nothing" in str(error)
    return True
