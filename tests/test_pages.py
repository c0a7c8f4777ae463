"""The pages' commands compose; in make test-all, every block of a page runs as a try."""

from __future__ import annotations

import re
import runpy
import shlex
import sys
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from functools import cache, partial
from itertools import chain
from pathlib import Path
from types import ModuleType

import matplotlib as mpl
import pytest
from commands import DATA, QUICK, jobs_in_threads, process_state, run_command
from helpers import slow_but
from hydra.core.override_parser.overrides_parser import OverridesParser
from page_blocks import PAGES, ROOT, Block, blocks, commands
from page_files import LEFT_OUT, write_named

from lcc_rl import learn
from lcc_rl.cli import console
from lcc_rl.config import load
from lcc_rl.errors import ConfigError

# Commands that are composed only, by their first words, and why.
NOT_RUN = {
    "make": "sets up an environment",
    "pip": "needs a package index",
    "source": "of the shell",
    "export": "of the shell",
    "ls": "of the shell",
    "curl": "downloads",
    "lcc-rl reproduce": "tests/studies run both studies at the size of a try",
    "lcc-rl animate": "tests/results/test_motion.py runs it",
    "lcc-rl evaluate experiment=main": "tests/test_entry_points.py does it with a job of its own",
    "lcc-rl score": "tests/evaluation/test_score.py runs it",
    "python docs/recipes": "tests/envs/test_stock_torchrl.py and two more run them",
    "python tools/benchmarks": "tests/tools/test_benchmark.py runs it",
    "python tools/kill_test.py": "takes an hour",
}
# Settings that shrink a command, where they are settings of it.
COUNTED = "evaluation.warm_up=0"
LENGTH, WINDOWS = "scenario.horizon=40", ("evaluation.profiles=2", "evaluation.drivers=2")
TRAINING = ("training.episodes=24", "training.environments=8", "training.segment=20")
SMALL = (
    *(LENGTH, *TRAINING, *WINDOWS, QUICK, *DATA),
    *("training.checkpoint_every=1", "evaluation.full_length=false", COUNTED),
)
OF_TRAINING = ("agent.batch_size=64", "agent.population=4")
# What a page asks for, and what is enough for a try.
ENOUGH = {
    "range(8)": "range(2)",
    "range(64)": "range(2)",
    "evaluation.shards=64": "evaluation.shards=2 evaluation.batch_size=8",
    "automated*100": "automated*8",
    "evaluation.warm_up=20": "evaluation.warm_up=1",
    "evaluation.repeats=2000": "evaluation.repeats=4",
    "evaluation.repeats=200": "evaluation.repeats=2",
    "--iterations 200": "--iterations 2",
    '["experiment=limits"]': repr([COUNTED, LENGTH, *TRAINING, *WINDOWS, *DATA]),
    '["+filter=cbf"]': repr(["+filter=cbf", COUNTED, LENGTH, *WINDOWS, *DATA]),
    'learn("alcc", words,': f'learn("alcc", [*words, *{list(SMALL)}],',
    "n_trials=40": "n_trials=2",
    "batch_size=1024": "batch_size=4",
    "num_envs=64": "num_envs=2",
    "batch_size=64": "batch_size=4",
    '"evaluation.drivers=24"': repr([COUNTED, LENGTH, *WINDOWS, *DATA])[1:-1],
    '1.2]"]': f'1.2]", *{list(DATA)}]',
    "learn(300_000,": "learn(9_600,",
    "rollout(6000": "rollout(20",
    "rollout(300": "rollout(20",
    "(0, 2999, 5999)": "(0, 9, 19)",
}
ENTRIES = {"run": "pipeline"}  # entry points that are not called as their command
# Extras of a page.
NEEDS = {
    "interfaces.md": ("gymnasium", "stable_baselines3", "onnx", "onnxscript", "onnxruntime"),
    "sweeps.md": ("optuna",),
    "learners.md": ("stable_baselines3", "onnx", "onnxscript", "onnxruntime"),
}
PLACEHOLDER = re.compile(r"<[^<>=]*>…?|…")
LAUNCH = ("hydra/launcher=",)  # of extras that need not be installed


class Reader:
    """Reads a page in a folder: writes its files and checks its commands.

    Args:
        folder: an empty folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.failures: list[str] = []

    def read(self, page: Path) -> None:
        """Read all blocks; fail with all that went wrong."""
        for block in blocks(page):
            file = re.match(r"# ([\w/]+\.py)", block.text)
            if block.language == "yaml":
                self.write(block.before.strip("`:").rpartition("`")[2], block.text)
            elif block.language == "python" and file:
                self.write(file[1], block.text)
            elif block.language == "python":
                self.note(block.line, self.program, block)
            elif block.language in ("bash", "console"):
                error = re.search(r"^lcc_rl: error: .{20}", block.text, flags=re.M)
                for words in commands(block):
                    self.note(block.line, self.command, words, error and error[0])
            else:
                assert block.language in ("text", "{eval-rst}"), (
                    f"{page}:{block.line}: {block.language}"
                )
        assert not self.failures, f"{page}:" + f"\n\n{page}:".join(self.failures)

    def write(self, name: str, text: str) -> None:
        """Add to a file that the page tells to write."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as file:
            file.write(text)
        sys.modules.pop(path.stem, None)  # the next command imports it anew, as a process would

    def note(self, line: int, act, *given) -> None:
        """Do something; keep what goes wrong."""
        try:
            act(*given)
        except (Exception, SystemExit) as error:
            self.failures.append(f"{line}: {given[0]}: {type(error).__name__}: {error}")

    def program(self, block: Block) -> None:
        """Programs are run only."""

    def command(self, words: list[str], error: str | None) -> None:
        """Compose one command, which may end with an error, without running it."""
        program, name, *rest = [*(PLACEHOLDER.sub("a_name", word) for word in words), "", ""]
        if program != "lcc-rl" or name not in console.HYDRA_COMMANDS:
            return
        settings = settings_of([word for word in rest if word], self.folder)
        with suppress(ConfigError) if error else nullcontext():
            for choice in (0, -1):
                entry = ENTRIES.get(name, name)
                once(entry, tuple(one_run(word, choice) for word in settings))


class Runner(Reader):
    """Runs everything on a page, in one folder, with a run for those that it does not make."""

    def __init__(self, folder: Path, run: Path) -> None:
        super().__init__(folder)
        self.run, self.count, page = run, 0, ModuleType("read_page")
        sys.modules[page.__name__] = page  # what a program defines has a module
        self.space = vars(page)

    def program(self, block: Block) -> None:
        """Run a program in the state that those before it left."""
        if "my.sumocfg" not in block.text:  # of the reader's own
            exec(self.filled(block.text), self.space)

    def command(self, words: list[str], error: str | None) -> None:
        """Run one command; one whose error the page shows ends with it."""
        if shlex.join(words).startswith(tuple(NOT_RUN)):
            return
        words = [word for word in words if not word.startswith(LAUNCH)]
        for group, (key, path) in LEFT_OUT.items():
            if group in words:
                words = [f"{key}={path}" if word == f"{key}=…" else word for word in words]
        program, name, *rest = shlex.split(self.filled(shlex.join(words)))
        if program == "python":
            with process_state(name, tuple(rest), self.folder) as (_, errors):
                try:
                    runpy.run_path(str(ROOT / name), run_name="__main__")
                except SystemExit as stop:
                    if stop.code:
                        raise RuntimeError(errors.getvalue()) from stop
            return
        small = [] if error else self.shrunk(name, rest)
        keys = {item.partition("=")[0] for item in small if "=" in item}
        rest = [*(word for word in rest if word.partition("=")[0] not in keys), *small]
        done = run_command(name, *rest, cwd=self.folder)
        assert done.returncode == (2 if error else 0), done.stderr[-2000:]
        assert not error or error in done.stderr, done.stderr

    def shrunk(self, name: str, words: Sequence[str]) -> list[str]:
        """Return further words that make a command a matter of seconds."""
        if name == "clairvoyant":
            data = [] if any(word.startswith("leader=") for word in words) else DATA
            return ["--iterations", "2", "--no-compile", LENGTH, *WINDOWS, *data]
        if name not in console.HYDRA_COMMANDS or any(word.startswith("resume=") for word in words):
            return []
        self.count += 1
        own = any(word == "-m" or word.startswith("hydra.run.dir=") for word in words)
        place = [] if own else [f"hydra.run.dir=outputs/{name}/{self.count}"]
        if "experiment=smoke" in words:  # small by itself
            return place
        typed = settings_of(words, self.folder)
        ends = [[one_run(word, choice) for word in typed] for choice in (0, -1)]
        sweep = ends[0] != ends[1]  # some of its runs may learn nothing
        small = [*SMALL, *(OF_TRAINING if name != "evaluate" and not sweep else ())]
        if name == "evaluate":
            small = [word for word in small if not word.startswith("training.")]
        fits = partial(composes, ENTRIES.get(name, name), sweep=sweep)
        return [*place, *(item for item in small if all(fits([*e, item]) for e in ends))]

    def filled(self, text: str) -> str:
        """Put sizes of a try, and runs of this page, in place of what the page says."""
        for much, little in ENOUGH.items():
            text = text.replace(much, little)
        text = re.sub(r",…(?=[],])", "", text)  # one run for several
        return re.sub(r"(?:outputs/(\w+)/)?<([a-z ]+)>(/\w+\.parquet)?", self.latest, text)

    def latest(self, found: re.Match[str]) -> str:
        """Return the run that the page made last, of the kind that its name says."""
        kind, name, file = found.groups()
        if file == "/trajectories.parquet":
            return f"outputs/{kind}/run{file}"
        holds = file or ("/episodes.parquet" if kind == "evaluate" else "/policy.pt")
        where = kind or ("calibrate" if file else "train")
        made = self.folder.glob(f"outputs/{where}/**/{holds[1:]}")
        runs = sorted(made, key=lambda path: path.stat().st_mtime)
        if file and not runs:  # a file of an earlier run, see page_files.FILES
            return file[1:]
        folder = runs[-1].parent if runs and not name.startswith("other") else self.run
        if name == "sweep" and (folder.parent / "sweep.json").exists():
            folder = folder.parent
        return f"{folder}{file or ''}"


@cache
def once(entry: str, settings: tuple[str, ...]) -> None:
    """Compose settings; a command in the text may leave out a required one."""
    try:
        load(entry, settings)
    except ConfigError as error:
        if "is required" not in str(error):
            raise


def composes(entry: str, settings: Sequence[str], sweep: bool) -> bool:
    """Whether settings compose; in a sweep, runs that learn nothing may be given how to."""
    try:
        load(entry, settings)
    except ConfigError as error:
        return sweep and "has no agent" in str(error)
    return True


def settings_of(words: Sequence[str], own: Path) -> list[str]:
    """Return the settings among the words of a command of Hydra, without those of launchers."""
    settings = [word for word in words if "=" in word or word.startswith("~")]
    flags = [word for word in words if word not in settings]
    settings = [word for word in settings if not word.startswith(LAUNCH)]
    if flags[:1] == ["--config-dir"]:
        settings.append(f"hydra.searchpath=[file://{own / flags[1]}]")
        flags = flags[2:]
    assert set(flags) <= {"-m", "--help"}, flags
    # The folder of a sweep, which a single run may not name.
    return [word for word in settings if "-m" not in flags or not word.startswith("sweep=")]


def one_run(setting: str, choice: int) -> str:
    """Return one value of a setting that may be swept; runs of a sweep are none."""
    if setting.startswith("compare=[") and "=" in setting.removeprefix("compare="):
        return setting
    (override,) = OverridesParser.create().parse_overrides([setting])
    if not override.is_sweep_override():
        return setting
    values = list(override.sweep_string_iterator())
    return f"{override.get_key_element()}={values[choice]}"


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """An empty folder whose modules are found, and forgotten afterwards."""
    for place in (ROOT / "docs" / "recipes", tmp_path):
        monkeypatch.syspath_prepend(str(place))
    yield tmp_path
    for path in tmp_path.glob("*.py"):
        sys.modules.pop(path.stem, None)


def test_the_pages_stay_short() -> None:
    """CONTRIBUTING's limits; docs/settings.md is written when the site is built."""
    lines = {}
    for page in {ROOT / "README.md", *(ROOT / "docs").glob("*.md")} - {ROOT / "docs/settings.md"}:
        text = page.read_text().splitlines()
        lines[page.name] = len(text)
        ranges = (range(one.line, one.line + one.text.count("\n")) for one in blocks(page))
        inside = set(chain.from_iterable(ranges))
        for number, line in enumerate(text, 1):
            free = number in inside or line.startswith(("|", "!["))
            assert free or len(line) <= 100, f"{page.name}:{number}"
    assert sum(lines.values()) <= 4_400
    assert lines["README.md"] <= 90


@pytest.mark.parametrize("page", slow_but(PAGES[:1], PAGES), ids=lambda page: page.name)
def test_every_command_of_a_page_composes(page, folder) -> None:
    Reader(folder).read(page)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run that stands for one which a page does not make itself."""
    small = ["experiment=smoke", "agent.batch_size=64", "seed=7", *DATA]
    return learn("alcc", small, tmp_path_factory.mktemp("pages") / "run").folder


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of what a reader may see
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_everything_on_a_page_runs(page, run, folder, monkeypatch) -> None:
    for extra in NEEDS.get(page.name, ()):
        pytest.importorskip(extra)
    jobs_in_threads(monkeypatch)
    monkeypatch.chdir(folder)
    mpl.use("agg")
    write_named(page.read_text(), folder)
    Runner(folder, run).read(page)
