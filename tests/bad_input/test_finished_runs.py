"""No command writes over what another one left, and the same command may be given again."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from commands import DATA, NO_AGENT, QUICK, run_command
from test_foreign_files import content

from lcc_rl.config import load
from lcc_rl.errors import ResultsError
from lcc_rl.results.runs import check_folder
from lcc_rl.runs.states import inspect_run

RULE = ("lcc_rl.cli.train", *NO_AGENT, "variant=idm")
OTHERS = [
    (*RULE, "seed=1"),
    ("lcc_rl.cli.evaluate", *NO_AGENT, "variant=idm"),
    ("lcc_rl.cli.calibrate", *DATA, QUICK),
    ("lcc_rl.cli.pipeline", *NO_AGENT, "variants=[idm]"),
]


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("finished")
    run_command(*RULE, "hydra.run.dir=run", cwd=folder, check=True)
    return folder / "run"


@pytest.mark.parametrize("words", OTHERS)
def test_a_finished_run_is_not_written_over(finished, tmp_path, words) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "run"))
    before = content(folder)
    done = run_command(*words, "hydra.run.dir=run", cwd=tmp_path)
    assert done.returncode == 2
    assert "already holds episodes.parquet of other settings" in done.stderr
    assert done.stderr.count("\n") == 1
    assert content(folder) == before


@pytest.mark.parametrize("kept", ["checkpoint.pt", "drivers.parquet", "command.txt"])
def test_nor_are_drivers_a_stopped_training_or_a_stopped_pipeline(finished, tmp_path, kept) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "run"))
    (folder / "episodes.parquet").rename(folder / kept)
    before = content(folder)
    done = run_command(*OTHERS[1], "hydra.run.dir=run", cwd=tmp_path)
    assert f"already holds {kept} of other settings" in done.stderr
    assert content(folder) == before


def test_the_same_command_gives_the_same_rows_again(finished, tmp_path) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "run"))
    before = (folder / "episodes.parquet").read_bytes()
    run_command(*RULE, "hydra.run.dir=run", cwd=tmp_path, check=True)
    assert (folder / "episodes.parquet").read_bytes() == before
    assert inspect_run(folder).state == "finished"


def test_rows_without_their_settings_are_of_others(finished, tmp_path) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "run"))
    (folder / "config.yaml").unlink()
    with pytest.raises(ResultsError, match=r"other settings \("):
        check_folder(load("train", list(RULE[1:])), folder)


def test_a_sweep_does_not_write_over_a_run_of_other_settings(finished, tmp_path) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "run"))
    before = (folder / "episodes.parquet").read_bytes(), (folder / "config.yaml").read_bytes()
    words = ("-m", *RULE[1:], "seed=1", "hydra.sweep.dir=.", "hydra.sweep.subdir=run")
    done = run_command(RULE[0], *words, cwd=tmp_path)
    assert done.returncode == 2
    assert "other settings (seed)" in done.stderr + (folder / "error.txt").read_text()
    assert before == (
        (folder / "episodes.parquet").read_bytes(),
        (folder / "config.yaml").read_bytes(),
    )


def test_a_sweep_of_a_billion_runs_is_one_line(tmp_path) -> None:
    words = ("-m", *RULE[1:], "seed=range(1000000)", "data.seed=range(1000000000)")
    done = run_command(RULE[0], *words, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "lcc_rl: error: a sweep has at most 100000 runs\n"
    assert not list(tmp_path.iterdir())
