"""The console command: every command under one name, quick to start; and the wheel's list."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import pandas as pd
import pytest
from commands import run_command
from helpers import slow_but

import lcc_rl
from lcc_rl.cli.console import COMMANDS, TOOLS
from lcc_rl.errors import ConfigError
from lcc_rl.io.files import write_parquet

ROOT = Path(__file__).parents[1]
HEAVY = {"torch", "tensordict", "torchrl", "matplotlib", "scipy.stats", "scipy.interpolate"}
TABLES = {"pandas", "pyarrow"}
# Does what its argument says, as python -m would, then names what was loaded on the way.
PROGRAM = """
import runpy, sys
try:
    if sys.argv[1].startswith("from"):
        exec(sys.argv[1])
    else:
        runpy.run_module("lcc_rl", run_name="__main__", alter_sys=True)
except SystemExit:
    pass
print("loaded:", *sys.modules, file=sys.stderr)
"""


def ran(*words: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(words, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done


def test_help_names_the_version_and_every_command(tmp_path) -> None:
    def said(*words: str) -> str:
        return run_command(*words, cwd=tmp_path, check=True).stdout

    assert said("--version") == f"lcc-rl {lcc_rl.__version__}\n"
    assert version("lcc_rl") == lcc_rl.__version__
    assert all(f"\n  {name} " in said() for name in COMMANDS)
    assert "usage: lcc-rl status" in said("status", "-h")
    assert all(callable(import_module(module).main) for module, _ in TOOLS.values())


def test_help_fits_80_columns(tmp_path, monkeypatch, subtests) -> None:
    for name in COMMANDS:
        with subtests.test(name=name):
            monkeypatch.setenv("COLUMNS", "80")
            shown = run_command(name, "--help", cwd=tmp_path, check=True).stdout
            assert [line for line in shown.splitlines() if len(line) > 80] == []


QUICK_TO_START = [  # what is done, what is not loaded for it, and what is printed
    (["train", "--help-all"], HEAVY | TABLES, "calibration: both, energy, global, local"),
    (["train", "-h", "agent=td3"], HEAVY | TABLES, "td3             analytic, ddpg"),
    *(([x, "-h"], HEAVY, x) for x in ("simulate", "score", "energy", "export", "table")),
    (["status", "."], HEAVY | TABLES, "1 finished"),
    (["from lcc_rl import results; print(results.load('.')['seed'].tolist())"], HEAVY, "[3]"),
    (
        ["from lcc_rl import simulate; print(len(simulate([12.0] * 11, 'human').steps))"],
        {"lcc_rl.agents", "scipy.special", "numba", "matplotlib"},
        "22",
    ),
]


@pytest.mark.parametrize(
    ("words", "unused", "printed"), slow_but(QUICK_TO_START[:1], QUICK_TO_START)
)
def test_what_need_not_wait_for_torch_does_not_load_it(tmp_path, words, unused, printed) -> None:
    write_parquet(pd.DataFrame({"strategy": ["idm"]}), tmp_path / "run" / "episodes.parquet")
    (tmp_path / "run" / "config.yaml").write_text("seed: 3\n")
    done = ran(sys.executable, "-c", PROGRAM, *words, cwd=tmp_path)
    assert not unused.intersection(done.stderr.rpartition("loaded:")[2].split())
    assert printed in done.stdout


def test_the_listed_packages_are_those_of_the_folders() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    found = (path.parent.relative_to(ROOT) for path in ROOT.glob("lcc_rl/**/__init__.py"))
    names = {".".join(path.parts) for path in found if "conf" not in path.parts}
    assert set(settings["packages"]) == names | {"lcc_rl.conf"}


@pytest.mark.slow
def test_a_wheel_runs_in_an_empty_folder(tmp_path) -> None:
    pip = (sys.executable, "-m", "pip", "wheel", "--no-deps", "--quiet", "--wheel-dir")
    assert "arning" not in ran(*pip, str(tmp_path), str(ROOT)).stderr
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as content:
        content.extractall(tmp_path / "site")
        names = set(content.namelist())
    tracked = ran("git", "ls-files", "lcc_rl", "conf").stdout.split()
    assert {re.sub("^conf/", "lcc_rl/conf/", name) for name in tracked} <= names
    program = (
        f"import sys; sys.path.insert(0, {str(tmp_path / 'site')!r}); "
        "from lcc_rl.cli.console import main; main()"
    )
    empty = tmp_path / "empty"
    empty.mkdir()
    start = (sys.executable, "-P", "-c", program)
    ran(*start, "run", "experiment=smoke", "hydra.run.dir=job", cwd=empty)
    assert (empty / "job" / "report.html").exists()


# What Python 3.14 does to every argument of a parser, and an installation that is not editable
# does in the folder of the clone: the package beside conf/ is found, and lcc_rl.conf is not.
NEWER = """
import argparse, sys

add = argparse._ActionsContainer.add_argument

def check(self, action):
    try:
        "%" in (action.help or "")
    except TypeError as error:
        raise ValueError("badly formed help string") from error

def added(self, *words, **settings):
    action = add(self, *words, **settings)
    if hasattr(self, "_get_formatter"):
        self._check_help(action)
    return action

argparse._ActionsContainer._check_help = check
argparse._ActionsContainer.add_argument = added
sys.meta_path = [finder for finder in sys.meta_path if "editable" not in str(finder)]
sys.path.insert(0, "")
"""


@pytest.mark.slow
def test_commands_run_on_a_newer_python_in_a_clone_that_is_installed_elsewhere() -> None:
    refused = f"{NEWER}\nfrom hydra._internal.utils import get_args_parser\nget_args_parser()"
    done = subprocess.run([sys.executable, "-c", refused], capture_output=True, text=True)
    assert "badly formed help string" in done.stderr
    call = "from lcc_rl.cli.console import main\nmain(['train', '--cfg', 'job', 'seed=7'])"
    command = [sys.executable, "-c", f"{NEWER}\n{call}"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "seed: 7" in done.stdout.splitlines()


@pytest.mark.parametrize(
    ("package", "extra", "use"),
    [
        ("libsumo", "sumo", lambda: import_module("lcc_rl.interfaces.sumo").load_sumo()),
        (
            "onnx",
            "interfaces",
            lambda: import_module("lcc_rl.cli.export").main(["pretrained/alcc", "x.onnx"]),
        ),
    ],
)
def test_an_extra_that_is_missing_is_one_line(
    package, extra, use, monkeypatch, tmp_path, capsys
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ConfigError, SystemExit)) as error:
        use()
    text = f"{error.value} {capsys.readouterr().err}"
    assert package in text.lower()
    assert f"pip install -e '.[{extra}]'" in text


def test_advice_to_install_is_what_a_clone_can_do() -> None:
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "lcc_rl").rglob("*.py")]
    wrong = [line for text in texts for line in text.splitlines() if "pip install" in line]
    assert len(wrong) == 1  # lcc_rl.errors.how_to_install
    assert "-e '.[" in wrong[0]
