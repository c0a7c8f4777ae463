"""A run is repeated from its folder alone, and the rows are compared."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from commands import NO_AGENT, QUICK, TINY, assert_same_tables, run_command, tiny
from helpers import check_refused

from lcc_rl.commands import repeat, training
from lcc_rl.errors import LccError
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.results import runs
from lcc_rl.results.runs import ORIGIN
from lcc_rl.version import __version__


def test_a_run_is_repeated_from_its_folder(trained, tmp_path, capsys) -> None:
    assert repeat.main([str(trained), "--out", str(tmp_path / "again")]) == 0
    assert_same_tables(trained, tmp_path / "again")
    assert f"{tmp_path / 'again'}: all rows are equal" in capsys.readouterr().out


def test_rows_that_differ_are_named(trained, tmp_path) -> None:
    one, other = (shutil.copytree(trained, tmp_path / name) for name in "ab")
    rows = read_parquet(one / "episodes.parquet")
    rows.loc[0, "total_energy_kj"] *= 1.25
    write_parquet(rows, other / "episodes.parquet")
    missing = rows.assign(total_energy_kj=rows["total_energy_kj"].mask(rows.index == 0))
    assert repeat._largest(rows["total_energy_kj"], missing["total_energy_kj"]) == np.inf
    assert np.isnan(repeat._largest(rows["total_energy_kj"], rows["strategy"]))
    (other / "steps.parquet").unlink()
    found = dict(repeat.compared(one, other))
    assert [*found.values()] == [False, False, True]
    first, second, _ = found
    assert re.search(r"1 of \d+ columns differ \(total_energy_kj\), by up to 0\.2$", first)
    assert second == "steps.parquet: not written"


def test_settings_alone_are_a_run_to_begin(trained, tmp_path) -> None:
    folder = tmp_path / "sent"
    folder.mkdir()
    shutil.copy(trained / "config.yaml", folder)
    training.run(tiny("train", f"resume={folder}"), tmp_path, quiet=True)
    assert_same_tables(trained, folder)
    (folder / "checkpoint.pt").unlink()
    again = tiny("train", f"resume={folder}")
    cases = [
        (lambda: training.run(again, tmp_path), "parquet without checkpoint.pt .* lcc-rl repeat"),
        *((lambda to=x: repeat.repeat(folder, to), "or lies in") for x in (trained, folder / "a")),
        (lambda: repeat.repeat(tmp_path, folder), "not a run folder"),
    ]
    check_refused(lambda call: call(), cases, LccError)


JOB = (*TINY, QUICK, "variants=[alcc]", "jobs=1", "evaluation.baselines=[human]")
COMMANDS = {"train": (*NO_AGENT, "variant=idm"), "evaluate": (*NO_AGENT, "variant=idm")}
SLOW = pytest.param("run", JOB, marks=pytest.mark.slow)


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize(("command", "words"), [*COMMANDS.items(), SLOW])
def test_every_command_is_repeated(command, words, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    here = f"hydra.run.dir={tmp_path / 'run'}"
    run_command(command, *words, here, cwd=tmp_path, check=True)
    assert repeat.main([str(tmp_path / "run")]) == 0
    assert "outputs/repeat/run: all rows are equal" in capsys.readouterr().out


def test_a_run_says_where_it_comes_from(evaluated) -> None:
    command, versions, folder, *_ = (evaluated / ORIGIN).read_text().splitlines()
    assert command
    assert versions.startswith(f"lcc_rl {__version__}+")
    assert Path(folder).is_absolute()


def test_the_commit_of_the_package_is_recorded_and_of_no_other_repository(
    tmp_path, monkeypatch
) -> None:
    (package := tmp_path / "package").mkdir()
    (package / "version.py").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runs, "PACKAGE", package)

    def recorded(*words: str) -> str:
        if words:
            git = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c", *words]
            subprocess.run(git, check=True, capture_output=True)
        runs._commit.cache_clear()
        return runs.origin().rstrip()

    try:
        assert recorded().endswith(str(tmp_path))
        recorded("init", "-q")
        assert "\ncommit " not in recorded("commit", "-q", "--allow-empty", "-m", "one")
        recorded("add", ".")
        assert recorded("commit", "-q", "-m", "two").endswith(", unchanged")
        (tmp_path / "mine.py").touch()
        assert recorded().endswith(", 1 files changed")
    finally:
        runs._commit.cache_clear()


def test_a_training_that_is_resumed_by_other_code_says_so(tmp_path, caplog, monkeypatch) -> None:
    cfg, told = tiny("train"), r"begun with lcc_rl \S+\+\w{8}, torch .*, resumed with lcc_rl 9\.9, "
    for name in (None, None, "9.9"):
        if name:
            monkeypatch.setattr(runs, "code_version", lambda: "9.9")
        assert not caplog.messages
        runs.save_config(cfg, tmp_path, resumed=True)
    assert re.search(told, caplog.text)
    assert (tmp_path / "origin.txt").read_text().count("\nlcc_rl ") == 3
