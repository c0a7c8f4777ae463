"""Whatever is typed: a wrong command ends in one line and leaves every folder as it was."""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from commands import NO_AGENT, run_command
from test_foreign_files import content

from lcc_rl.cli.entry import flags_first
from lcc_rl.runs.output import Unbroken
from lcc_rl.runs.states import inspect_run


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("finished")
    words = (*NO_AGENT, "variant=idm", "hydra.run.dir=run")
    run_command("lcc_rl.cli.train", *words, cwd=folder, check=True)
    return folder / "run"


# -- options ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("typed", "sorted_words"),
    [
        (["a=1", "-m", "b=1,2"], ["-m", "a=1", "b=1,2"]),
        (["a=1", "--cfg", "job", "b=2"], ["--cfg", "job", "a=1", "b=2"]),
        (["-m", "a=-m", "b=2"], ["-m", "a=-m", "b=2"]),
        (["seed=3", "variant=ALCC", "-m"], ["-m", "++seed=3", "variant=alcc"]),
        (["a=1", "--config-dir", "x", "a=1"], ["--config-dir", "x", "a=1", "a=1"]),
        ([], []),
    ],
)
def test_flags_may_stand_anywhere(typed, sorted_words) -> None:
    assert flags_first(typed) == sorted_words


@pytest.mark.parametrize("entry", ["train", "calibrate"])
def test_an_unknown_flag_is_one_line(tmp_path, entry) -> None:
    # argparse would take --experiment for an abbreviation of a flag of Hydra's own
    flag = "--experiment" if entry == "train" else "--seed"
    done = run_command(f"lcc_rl.cli.{entry}", "variant=idm", flag, "3", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith(f"lcc_rl: error: unknown flag {flag}: settings are written key=")
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


# -- refused commands ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words",
    [
        ("resume=run", "seed=3"),
        ("resume=run", "training.episodes=abc"),
        ("hydra.run.dir=run", "variant=idm", "evaluation.drivers=0", *NO_AGENT[:1]),
        ("hydra.run.dir=run", "variant=idm", "drivers=fixed", "drivers._target_=os.getcwd"),
        ("hydra.run.dir=run", "variant=alcc", "agent=none"),
    ],
)
def test_a_refused_command_leaves_a_finished_run_as_it_was(finished, tmp_path, words) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "run"))
    before = content(folder)
    assert {".hydra/overrides.yaml", "episodes.parquet"} <= before.keys()
    done = run_command("lcc_rl.cli.train", *words, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert content(folder) == before


def test_a_finished_run_of_other_settings_is_refused_and_left(finished, tmp_path) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "run"))
    path = folder / "config.yaml"
    path.write_text(path.read_text().replace("seed: 0", "seed: 1", 1))
    before = content(folder)
    done = run_command("lcc_rl.cli.train", "resume=run", cwd=tmp_path)
    assert "episodes.parquet belongs to another configuration" in done.stderr
    assert done.returncode == 2
    assert content(folder) == before


def test_a_refused_command_does_not_make_a_stopped_run_a_failed_one(finished, tmp_path) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "run"))
    (folder / "episodes.parquet").unlink()
    run_command("lcc_rl.cli.train", "resume=run", "seed=3", cwd=tmp_path)
    assert inspect_run(folder).state == "stopped"


def test_a_failed_start_is_recorded_and_forgotten_once_it_works(tmp_path) -> None:
    words = (*NO_AGENT, "variant=idm", "hydra.run.dir=run")
    run_command("lcc_rl.cli.train", *words, "evaluation.drivers=0", cwd=tmp_path)
    assert inspect_run(tmp_path / "run").state == "failed"
    run_command("lcc_rl.cli.train", *words, cwd=tmp_path, check=True)
    assert inspect_run(tmp_path / "run").state == "finished"


# -- output that nobody reads ----------------------------------------------------------------------


class Closed(io.StringIO):
    """A pipe whose reader is gone."""

    def write(self, text: str) -> int:
        raise BrokenPipeError

    def fileno(self) -> int:
        raise OSError


def test_what_nobody_reads_is_dropped() -> None:
    stream = Unbroken(Closed())
    assert stream.write("text") == 4
    stream.flush()
    whole = Unbroken(io.StringIO())
    whole.write("text")
    assert whole.getvalue() == "text"


@pytest.mark.parametrize(
    ("module", "words"),
    [
        ("lcc_rl.cli.status", ("runs",)),
        pytest.param(
            "lcc_rl.cli.train",
            (*NO_AGENT, "variant=idm", "hydra.run.dir=new"),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_closed_pipe_ends_nothing_and_says_nothing(finished, tmp_path, module, words) -> None:
    for name in "ab":
        shutil.copytree(finished, tmp_path / "runs" / name)
    command = [sys.executable, "-m", module, *words]
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as child:
        child.stdout.close()  # as head -0 does
        errors = child.stderr.read().decode()
        assert child.wait(timeout=300) == 0, errors
    assert errors == ""
    if module == "lcc_rl.cli.train":
        assert inspect_run(tmp_path / "new").state == "finished"
