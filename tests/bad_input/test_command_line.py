"""Whatever is typed: a wrong command ends in one line and leaves every folder as it was."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from commands import DATA, NO_AGENT, QUICK, TINY, content, jobs_in_threads, run_command

from lcc_rl.runs.states import claim, inspect_run

RULE = ("variant=idm", *NO_AGENT)
COMMANDS = {
    "train": (*RULE, "seed=1"),
    "evaluate": RULE,
    "calibrate": (*DATA, QUICK),
    "pipeline": ("variants=[alcc]", *TINY),
}
LISTS = ("seed=range(1000000)", "data.seed=range(1000000000)")


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("finished")
    run_command("lcc_rl.cli.train", *RULE, "hydra.run.dir=run", cwd=folder, check=True)
    return folder / "run"


@pytest.fixture
def run(finished, tmp_path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "run"))


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("console trian", "'train'"),
        ("train variant=alccc", "'alccc'.*'alcc'"),
        ("train variant=idm --experiment 3", "--experiment.*key=value"),
        ("calibrate --seed 3", "--seed"),
        ("train data=ngsim data.path=nowhere.csv", "nowhere.csv"),
        ("train resume=nowhere", "nowhere"),
        ("evaluate variant=alcc policy=nowhere", "nowhere"),
        ("pipeline variants=[]", "variants"),
        ("pipeline variant=idm", "variant=idm has no effect on lcc-rl run"),
        (f"pipeline {' '.join(NO_AGENT)} data.recordings=1", "split.by=vehicle"),
        (f"train -m variant=idm {' '.join(LISTS)}", "at most 100000 runs"),
        ("train hydra.run.dir=file/run", "Not a directory"),
        (f"train hydra.run.dir={'x' * 5000}", "too long"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, words, expected) -> None:
    (tmp_path / "file").write_text("kept")
    entry, *typed = words.split()
    done = run_command(f"lcc_rl.cli.{entry}", *typed, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1, done.stderr
    assert "error: " in done.stderr
    assert re.search(expected, done.stderr)
    assert (tmp_path / "file").read_text() == "kept"
    assert not [*tmp_path.rglob("*.parquet"), *tmp_path.rglob("nowhere")]


def test_flags_may_stand_anywhere(tmp_path) -> None:
    words = ("seed=7", "--cfg", "job", "variant=IDM")
    done = run_command("lcc_rl.cli.train", *words, cwd=tmp_path, check=True)
    assert "seed: 7" in done.stdout
    assert "variant: idm" in done.stdout


# -- folders that hold something -------------------------------------------------------------------


@pytest.mark.parametrize("entry", COMMANDS)
def test_a_finished_run_is_not_written_over(run, tmp_path, entry) -> None:
    before = content(run)
    assert {".hydra/overrides.yaml", "episodes.parquet"} <= before.keys()
    done = run_command(f"lcc_rl.cli.{entry}", *COMMANDS[entry], "hydra.run.dir=run", cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "already holds episodes.parquet of other settings" in done.stderr
    assert content(run) == before


@pytest.mark.parametrize("kept", ["checkpoint.pt", "command.txt"])
def test_nor_is_a_stopped_training_or_a_stopped_pipeline(run, tmp_path, kept) -> None:
    (run / "episodes.parquet").rename(run / kept)
    before = content(run)
    done = run_command("lcc_rl.cli.evaluate", *RULE, "hydra.run.dir=run", cwd=tmp_path)
    assert f"already holds {kept} of other settings" in done.stderr
    assert content(run) == before


def test_a_sweep_does_not_write_over_a_run_of_other_settings(run, tmp_path) -> None:
    before = content(run)
    words = ("-m", *COMMANDS["train"], "hydra.sweep.dir=.", "hydra.sweep.subdir=run")
    done = run_command("lcc_rl.cli.train", *words, cwd=tmp_path)
    assert done.returncode == 2
    after = content(run)
    assert all(before[name] == after[name] for name in ("episodes.parquet", "config.yaml"))


def test_the_same_command_gives_the_same_rows_again(run, tmp_path) -> None:
    before = (run / "episodes.parquet").read_bytes()
    run_command("lcc_rl.cli.train", *RULE, "hydra.run.dir=run", cwd=tmp_path, check=True)
    assert (run / "episodes.parquet").read_bytes() == before
    assert inspect_run(run).state == "finished"


@pytest.mark.parametrize(
    "words",
    [
        ("resume=run", "seed=3"),
        ("hydra.run.dir=run", *RULE, "evaluation.drivers=0"),
        ("hydra.run.dir=run", *RULE, "drivers=fixed", "drivers._target_=os.getcwd"),
    ],
)
def test_a_refused_command_leaves_a_run_as_it_was(run, tmp_path, words) -> None:
    before = content(run)
    assert run_command("lcc_rl.cli.train", *words, cwd=tmp_path).returncode == 2
    assert content(run) == before
    (run / "episodes.parquet").unlink()
    if words[0] == "resume=run":
        assert run_command("lcc_rl.cli.train", *words, cwd=tmp_path).returncode == 2
        assert inspect_run(run).state == "stopped"


def test_a_run_whose_settings_were_changed_is_not_resumed(run, tmp_path) -> None:
    path = run / "config.yaml"
    path.write_text(path.read_text().replace("seed: 0", "seed: 1", 1))
    before = content(run)
    done = run_command("lcc_rl.cli.train", "resume=run", cwd=tmp_path)
    assert done.returncode == 2
    assert "episodes.parquet belongs to another configuration" in done.stderr
    assert content(run) == before


def test_a_failed_start_is_recorded_and_forgotten_once_it_works(tmp_path) -> None:
    words = (*RULE, "hydra.run.dir=run")
    run_command("lcc_rl.cli.train", *words, "evaluation.drivers=0", cwd=tmp_path)
    assert inspect_run(tmp_path / "run").state == "failed"
    run_command("lcc_rl.cli.train", *words, cwd=tmp_path, check=True)
    assert inspect_run(tmp_path / "run").state == "finished"


@pytest.mark.parametrize("entry", COMMANDS)
def test_the_second_process_in_a_folder_touches_nothing(tmp_path, entry, monkeypatch) -> None:
    jobs_in_threads(monkeypatch)
    folder = tmp_path / "run"
    with claim(folder):
        before = sorted(folder.rglob("*"))
        target = f"hydra.run.dir={folder}"
        done = run_command(f"lcc_rl.cli.{entry}", *COMMANDS[entry], target, cwd=tmp_path)
        assert sorted(folder.rglob("*")) == before
    assert done.returncode == 2
    assert done.stderr == f"lcc_rl: error: {folder}: another process is working on this run\n"


# -- output that nobody reads ----------------------------------------------------------------------


def test_a_closed_pipe_ends_nothing_and_says_nothing(run, tmp_path) -> None:
    command = [sys.executable, "-m", "lcc_rl.cli.status", "run"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, cwd=tmp_path, **pipes) as child:
        child.stdout.close()  # as head -0 does
        errors = child.stderr.read().decode()
        assert child.wait(timeout=300) == 0, errors
    assert errors == ""
