"""Whatever is typed: a wrong command ends in one line and leaves every folder as it was."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from commands import DATA, NO_AGENT, QUICK, TINY, content, jobs_in_threads, run_command
from helpers import check_refused, slow_but

from benchmarks import command as benchmarks
from lcc_rl.runs.states import claim, inspect_run

RULE = ("variant=idm", *NO_AGENT)
COMMANDS = {
    "train": (*RULE, "seed=1"),
    "evaluate": (*RULE, "evaluation.seed=1"),
    "calibrate": (*DATA, QUICK),
    "run": ("variants=[alcc]", *TINY),
}
LISTS = ("seed=range(1000000)", "data.seed=range(1000000000)")


@pytest.fixture
def run(evaluated, tmp_path) -> Path:
    return Path(shutil.copytree(evaluated, tmp_path / "run"))


# What is typed after lcc-rl, and the words of the error.
REFUSED = {
    "trian": "'train'",
    "train variant=idm --experiment 3": "--experiment.*key=value",
    "evaluate scenario.controllers.human=gipps": "by controller@scenario.controllers.human=gipps",
    "evaluate scenario.pieces.slope=hills": r"is chosen by \+slope=hills$",
    "evaluate slope=hills": r"slope is added: write \+slope=",
    "calibrate experiment=smoke": "this command has no option 'experiment'",
    "train data=ngsim data.path='~nobody-here/x.csv'": "~nobody-here/x.csv: no such file",
    "train resume=nowhere": "nowhere",
    "run variant=idm": "variant=idm has no effect on lcc-rl run",
    "train experiment=limits +filter=cbf": "filter is chosen twice: leave one out",
    f"train -m variant=idm {' '.join(LISTS)}": "at most 100000 runs",
    "train seed=1 variant=idm ++seed=2": r"seed=1 \+\+seed=2: seed is set twice; leave one out$",
    "score idm seed=1 seed=2": "seed is set twice",
    "energy trips.csv energy=bolt energy=fuel": "energy is set twice",
    "train filter=cbf": r"write \+filter=",
    "train ~agent.gamma": "~agent.gamma: no file sets it",
    "export policy.pt": "required: path ",
    "train out=x": "hydra.run.dir=… sets the folder",
    "train hydra.run.dir=file/run": "Not a directory",
    f"train hydra.run.dir={'x' * 5000}": "too long",
    "status --banana": "unrecognized arguments: --banana",
    "status nowhere": "nowhere: no such folder",
    "animate nowhere --start nan": "--start: must be a finite number",
    "clairvoyant --iterations 0": "--iterations: must be greater than or equal to 1",
    "export pretrained/alcc policy.banana": "'.banana'; valid: .c, .html, .onnx",
    "reproduce alcc --recipe smoke --jobs 1000000000": "jobs must lie from 1 to",
}
# Commands that write what they are told to, and never over what is there.
NAMED = (
    *("clairvoyant --out run", "clairvoyant --out v.html", "animate run --out v.html"),
    *("export pretrained/alcc v.html", "reproduce alcc --recipe smoke --seeds 1 --out run"),
)


def refused(words: Sequence[str], cwd: Path) -> str:
    """Return the one line of a command that ends with exit code 2 and leaves all as it was."""
    before = sorted(cwd.rglob("*")), content(cwd)
    done = run_command(*words, cwd=cwd)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("lcc_rl: error: ")
    assert (sorted(cwd.rglob("*")), content(cwd)) == before
    return done.stderr


def test_bad_input_is_one_line_and_exit_code_2_and_leaves_nothing(tmp_path) -> None:
    (tmp_path / "file").write_text("kept")
    for words, said in REFUSED.items():
        assert re.search(said, refused(words.split(), tmp_path)), words


def test_a_job_that_fails_once_its_data_are_read_is_recorded(tmp_path) -> None:
    words = ("experiment=smoke", DATA[0], "data.recordings=1", DATA[2], "hydra.run.dir=job")
    done = run_command("run", *words, cwd=tmp_path)
    assert done.stderr.count("\n") == 1
    assert "split.by=vehicle" in inspect_run(tmp_path / "job").error


def test_nothing_that_is_there_is_written_over(run, tmp_path) -> None:
    (tmp_path / "v.html").write_text("kept")
    for words in NAMED:
        said = refused(words.split(), tmp_path)
        assert re.search("exists already|already holds|is no folder", said), words


def test_so_do_the_benchmarks(run, tmp_path, monkeypatch) -> None:
    cases = (("env --out run/episodes.parquet", "exists already"), ("reed", "Did you mean 'read'"))
    monkeypatch.chdir(tmp_path)
    check_refused(lambda typed: benchmarks.main(typed.split()), cases)


def test_flags_may_stand_anywhere(tmp_path) -> None:
    words = ("seed=7", "--cfg", "job", "variant=IDM")
    done = run_command("train", *words, cwd=tmp_path, check=True)
    assert "seed: 7" in done.stdout
    assert "variant: idm" in done.stdout


# -- folders that hold something -------------------------------------------------------------------


def test_a_run_is_not_written_over_finished_or_stopped(run, tmp_path) -> None:
    for entry, words in COMMANDS.items():
        said = refused([entry, *words, "hydra.run.dir=run"], tmp_path)
        assert "already holds episodes.parquet of other settings" in said, entry
    held = run / "episodes.parquet"
    for kept in ("checkpoint.pt", "command.txt"):  # of a training and of a pipeline
        held = held.rename(run / kept)
        said = refused(["evaluate", *RULE, "evaluation.seed=3", "hydra.run.dir=run"], tmp_path)
        assert f"already holds {kept} of other settings" in said


def test_nor_is_a_folder_of_something_else(tmp_path) -> None:
    (tmp_path / "config.yaml").write_text("site_name: mine\n")
    words = ["evaluate", *RULE, "hydra.run.dir=."]
    assert "config.yaml of something else" in refused(words, tmp_path)


def test_a_sweep_does_not_write_over_a_run_of_other_settings(run, tmp_path) -> None:
    before = content(run)
    words = ("-m", *COMMANDS["train"], "hydra.sweep.dir=.", "hydra.sweep.subdir=run")
    done = run_command("train", *words, cwd=tmp_path)
    assert done.returncode == 2
    after = content(run)
    assert all(before[name] == after[name] for name in ("episodes.parquet", "config.yaml"))


def test_the_same_command_gives_the_same_rows_again(run, tmp_path) -> None:
    before = (run / "episodes.parquet").read_bytes()
    run_command("train", *RULE, "hydra.run.dir=run", cwd=tmp_path, check=True)
    assert (run / "episodes.parquet").read_bytes() == before
    assert inspect_run(run).state == "finished"


def test_a_refused_command_leaves_a_run_as_it_was(run, tmp_path) -> None:
    for words in (["resume=run", "seed=3"], ["hydra.run.dir=run", *RULE, "evaluation.drivers=0"]):
        refused(["train", *words], tmp_path)
    (run / "episodes.parquet").unlink()
    said = refused(["train", "resume=run", "reward.terms.own.weight=1"], tmp_path)
    assert "a resumed run keeps the settings it was started with; remove reward.terms.own" in said
    assert inspect_run(run).state == "stopped"


def test_a_run_whose_settings_were_changed_is_not_resumed(run, tmp_path) -> None:
    path = run / "config.yaml"
    path.write_text(path.read_text().replace("seed: 0", "seed: 1", 1))
    before = content(run)
    done = run_command("train", "resume=run", cwd=tmp_path)
    assert done.returncode == 2
    assert "episodes.parquet belongs to another configuration" in done.stderr
    assert content(run) == before


def test_a_folder_that_is_not_utf_8_is_refused_before_work_begins(tmp_path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    folder.mkdir()
    said = refused(["train", *RULE], folder)
    assert "can't encode" in said


def test_the_second_process_in_a_folder_touches_nothing(tmp_path, monkeypatch) -> None:
    jobs_in_threads(monkeypatch)
    target = f"hydra.run.dir={tmp_path / 'run'}"
    with claim(tmp_path / "run"):
        for entry, words in COMMANDS.items():
            said = refused([entry, *words, target], tmp_path)
            assert said.endswith("run: another process is working on this run\n"), entry


# -- output that goes nowhere --------------------------------------------------------------------

FULL = "lcc_rl: error: .*No space left on device: 'standard output'\n"
OUTPUTS = [
    ("status run | true", 0, ""),
    ("--version >&-", 0, ""),
    ("--version >/dev/full", 2, FULL),
    ("table run >/dev/full", 2, FULL),
    ("trian 2>/dev/full", 2, ""),
]


@pytest.mark.parametrize(("words", "code", "said"), slow_but(OUTPUTS[2:3], OUTPUTS))
def test_output_that_cannot_be_written_ends_nothing(run, tmp_path, words, code, said) -> None:
    command = f"{sys.executable} -m lcc_rl {words}; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == code
    assert re.fullmatch(said, done.stderr)


@pytest.mark.slow
def test_signs_that_the_terminal_lacks_and_control_codes(tmp_path) -> None:
    (tmp_path / "é" / "run").mkdir(parents=True)
    (tmp_path / "é" / "run" / "error.txt").write_text("red \x1b[31m é\a")
    done = subprocess.run(
        [sys.executable, "-m", "lcc_rl", "status", "é"],
        cwd=tmp_path,
        capture_output=True,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )
    assert done.returncode == 0, done.stderr
    assert rb"red [31m \xe9" in done.stdout
    assert b"\x1b" not in done.stdout
