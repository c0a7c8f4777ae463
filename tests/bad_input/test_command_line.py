"""Whatever is typed: a wrong command ends in one line and leaves every folder as it was."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from commands import DATA, NO_AGENT, QUICK, TINY, content, jobs_in_threads, run_command

from lcc_rl.drivers.tables import load_drivers
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


# What is typed after lcc-rl, and the words of the error.
REFUSED = {
    # names
    "trian": "'train'",
    "train variant=alccc": "'alccc'.*'alcc'",
    "train variant=idm --experiment 3": "--experiment.*key=value",
    "calibrate --seed 3": "--seed",
    "calibrate experiment=smoke": "this command has no option 'experiment'",
    "train data=ngsim data.path=nowhere.csv": "nowhere.csv",
    "train data=ngsim data.path='~nobody-here/x.csv'": "~nobody-here/x.csv: no such file",
    "train data=ngsim data.path=[]": "no file is named",
    "train resume=nowhere": "nowhere",
    "evaluate variant=alcc policy=nowhere": "nowhere",
    "evaluate variant=alcc compare=[null]": "compare names None: expected a name",
    "evaluate variant=alcc compare={a:[b,c]}": "compare names .'b', 'c'.: expected a name",
    "run variants=[]": "variants",
    "run variant=idm": "variant=idm has no effect on lcc-rl run",
    f"train -m variant=idm {' '.join(LISTS)}": "at most 100000 runs",
    "train out=x": "hydra.run.dir=… sets the folder",
    "train hydra.run.dir=file/run": "Not a directory",
    f"train hydra.run.dir={'x' * 5000}": "too long",
    "train variant=idm sweep=mine": "sweep=mine has no effect.* -m",
    # flags
    "status --banana": "unrecognized arguments: --banana",
    "animate nowhere --start nan": "--start: must be a finite number",
    "animate nowhere": "nowhere: not a run folder",
    "clairvoyant --iterations 0": "--iterations: must be greater than or equal to 1",
    "export pretrained/alcc policy.banana": "'.banana'; valid: .html, .onnx",
    "status nowhere": "nowhere: no such folder",
    "reproduce alcc --recipe smok": "smok",
    "reproduce alcc --recipe smoke --jobs 1000000000": "jobs must lie from 1 to",
    "reproduce alcc --recipe smoke hydra.run.dir=x": "hydra.run.dir=x has no effect",
}
# Commands that write what they are told to, and never over what is there: {file}, {run}.
NAMED = (
    *("clairvoyant --out {run}", "clairvoyant --out {file}", "animate {run} --out {file}"),
    "export pretrained/alcc {file}",
    "reproduce alcc --recipe smoke --seeds 1 --out {run}",
)


def refused(words: list[str], cwd: Path, module: str = "lcc_rl.cli.console") -> str:
    """Return the one line of a command that ends with exit code 2 and leaves all as it was."""
    before = sorted(cwd.rglob("*")), content(cwd)
    done = run_command(module, *words, cwd=cwd)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("lcc_rl: error: ")
    assert (sorted(cwd.rglob("*")), content(cwd)) == before
    return done.stderr


@pytest.mark.parametrize("words", REFUSED)
def test_bad_input_is_one_line_and_exit_code_2_and_leaves_nothing(tmp_path, words) -> None:
    (tmp_path / "file").write_text("kept")
    assert re.search(REFUSED[words], refused(words.split(), tmp_path))


def test_a_job_that_fails_once_its_data_are_read_is_recorded(tmp_path) -> None:
    words = (*NO_AGENT, "data.recordings=1", "hydra.run.dir=job")
    done = run_command("lcc_rl.cli.pipeline", *words, cwd=tmp_path)
    assert done.stderr.count("\n") == 1
    assert "split.by=vehicle" in inspect_run(tmp_path / "job").error


@pytest.mark.parametrize("words", NAMED)
def test_nothing_that_is_there_is_written_over(run, tmp_path, words) -> None:
    (tmp_path / "v.html").write_text("kept")
    said = refused(words.format(file="v.html", run="run").split(), tmp_path)
    assert re.search("is already there|already holds|is no folder", said)


@pytest.mark.parametrize(
    ("module", "words", "expected"),
    [
        ("benchmarks.command", ["env", "--out", "run/episodes.parquet"], "is already there"),
        ("benchmarks.command", ["env", "--threads", "100000"], "--threads: must be less"),
        ("benchmarks.command", ["reed"], "Did you mean 'read'"),
        ("benchmarks.command", ["calibrate", "--episodes", "nowhere.parquet"], "nowhere"),
    ],
)
def test_so_do_the_tools(run, tmp_path, monkeypatch, module, words, expected) -> None:
    load_drivers(mode="local").head(3).to_parquet(run / "d.parquet")
    monkeypatch.setattr("sys.argv", ["tool", *words])
    assert expected in refused(words, tmp_path, module)


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


def test_nor_is_a_folder_of_something_else(tmp_path) -> None:
    (tmp_path / "config.yaml").write_text("site_name: mine\n")
    assert "config.yaml of something else" in refused(
        ["evaluate", *RULE, "hydra.run.dir=."], tmp_path
    )


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


def test_a_folder_that_is_not_utf_8_is_refused_before_work_begins(tmp_path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    folder.mkdir()
    said = refused(["train", *RULE], folder)
    assert "can't encode" in said


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


# -- output that goes nowhere --------------------------------------------------------------------

FULL = "lcc_rl: error: .*No space left on device: 'standard output'\n"
OUTPUTS = [
    ("status run | true", 0, ""),
    ("-h | true", 0, ""),
    ("--version >&-", 0, ""),
    ("status run >&- 2>&- <&-", 0, ""),
    ("--version >/dev/full", 2, FULL),
    ("status run >/dev/full", 2, FULL),
    ("table run >/dev/full", 2, FULL),
    ("table run --all --format csv >/dev/full", 2, FULL),
    ("trian 2>/dev/full", 2, ""),
]


@pytest.mark.parametrize(("words", "code", "said"), OUTPUTS)
def test_output_that_cannot_be_written_ends_nothing(run, tmp_path, words, code, said) -> None:
    command = f"{sys.executable} -m lcc_rl {words}; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == code
    assert re.fullmatch(said, done.stderr)


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
