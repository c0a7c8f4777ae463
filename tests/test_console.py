"""The console command: every command under one name, errors in one line; and the wheel's list."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import pytest

import lcc_rl
from lcc_rl.cli.console import COMMANDS, main

ROOT = Path(__file__).parents[1]


def test_the_version_is_that_of_the_package_and_stands_once(capsys) -> None:
    main(["--version"])
    assert capsys.readouterr().out == f"lcc-rl {lcc_rl.__version__}\n"
    assert version("lcc_rl") == lcc_rl.__version__


def test_help_names_every_command(capsys) -> None:
    main([])
    text = capsys.readouterr().out
    assert all(f"\n  {name} " in text for name in COMMANDS)


def test_every_command_has_its_function() -> None:
    assert all(callable(import_module(module).main) for module, _ in COMMANDS.values())


def test_an_unknown_command_is_one_line_with_the_nearest_name(capsys) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["trian"])
    said = capsys.readouterr().err
    assert caught.value.code == 2
    assert "Did you mean 'train'?" in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("name", ["status", "reproduce", "fetch"])
def test_help_of_a_command_bears_its_name(name, capsys, monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", ["lcc-rl"])
    monkeypatch.setattr("lcc_rl.runs.interrupts.end_quietly", lambda: None)
    with pytest.raises(SystemExit) as caught:
        main([name, "-h"])
    assert caught.value.code == 0
    assert f"usage: lcc-rl {name}" in capsys.readouterr().out


def packages() -> set[str]:
    found = (path.parent.relative_to(ROOT) for path in ROOT.glob("lcc_rl/**/__init__.py"))
    names = {".".join(path.parts) for path in found if "conf" not in path.parts}
    return names | {"lcc_rl.conf"}


def test_the_listed_packages_are_those_of_the_folders() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert set(settings["packages"]) == packages()


def ran(*words: str, cwd: Path = ROOT) -> str:
    done = subprocess.run(words, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


@pytest.mark.slow
def test_a_wheel_runs_in_an_empty_folder(tmp_path) -> None:
    pip = (sys.executable, "-m", "pip", "wheel", "--no-deps", "--quiet", "--wheel-dir")
    assert "arning" not in ran(*pip, str(tmp_path), str(ROOT))
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as content:
        content.extractall(tmp_path / "site")
        names = set(content.namelist())
    tracked = ran("git", "ls-files", "lcc_rl", "conf").split()
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
