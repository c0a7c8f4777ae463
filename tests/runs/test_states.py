"""How a run stands, read from its folder: locks, errors, what is missing."""

from __future__ import annotations

import json
import os
import shutil
import signal
from io import StringIO
from pathlib import Path

import pytest
from commands import run_command
from helpers import check_refused
from rich.console import Console

from lcc_rl.commands import training
from lcc_rl.errors import ConfigError, Interrupted, LccError, ResultsError
from lcc_rl.results.runs import load_config
from lcc_rl.runs.overview import main, overview_line, states_table
from lcc_rl.runs.plans import SweepPlan, unfinished
from lcc_rl.runs.progress import ProgressReporter
from lcc_rl.runs.states import (
    Busy,
    RunState,
    check_present,
    claim,
    inspect_run,
    is_claimed,
    no_run,
    record,
    survey,
    working,
)
from lcc_rl.runs.sweeps import conclude


def status(folder: Path) -> list[str]:
    done = run_command("status", str(folder), cwd=folder, check=True)
    return done.stdout.splitlines()


def test_a_claimed_folder_is_refused_to_others_and_free_afterwards(tmp_path) -> None:
    with claim(tmp_path):
        assert is_claimed(tmp_path)
        with pytest.raises(Busy, match="another process"), claim(tmp_path):
            pytest.fail("both hold the folder")
    assert not is_claimed(tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_claim_of_a_killed_process_is_void(tmp_path) -> None:
    child = os.fork()
    if not child:
        with claim(tmp_path):
            os.kill(os.getpid(), signal.SIGKILL)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    assert list(tmp_path.iterdir())
    assert not is_claimed(tmp_path)
    with claim(tmp_path):
        assert is_claimed(tmp_path)


def test_a_folder_that_cannot_be_made_is_one_clear_error(tmp_path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultsError, match="cannot be written"), claim(tmp_path / "file" / "run"):
        pass


def fails(folder: Path, error: Exception) -> None:
    with working(folder):
        raise error


def test_a_failure_is_recorded_and_forgotten_when_tried_again(tmp_path) -> None:
    with pytest.raises(ConfigError):
        fails(tmp_path, ConfigError("agent.gamma must\nlie in [0, 1)"))
    assert (tmp_path / "error.txt").read_text() == "agent.gamma must lie in [0, 1)\n"
    assert inspect_run(tmp_path).state == "failed"
    (tmp_path / ".episodes.parquet.1.tmp").write_text("half a fi")
    with pytest.raises(ZeroDivisionError):  # a bug keeps its traceback
        fails(tmp_path, ZeroDivisionError("by zero"))
    text = (tmp_path / "error.txt").read_text()
    assert text.startswith(f"ZeroDivisionError: by zero ({__file__}:")
    assert "in fails" in text
    with pytest.raises(Interrupted):
        fails(tmp_path, Interrupted("stopped"))
    assert not list(tmp_path.iterdir())
    assert inspect_run(tmp_path).state == "stopped"


def test_a_finished_run_stays_finished_and_a_removed_one_removed(tmp_path, trained, caplog) -> None:
    caplog.set_level("INFO")
    folder = shutil.copytree(trained, tmp_path / "run")
    record(folder, ConfigError("its data have changed"))
    assert str(inspect_run(folder)) == "finished: not repeated: its data have changed"
    assert not unfinished(tmp_path)
    (tmp_path / f"a_{'0' * 8}").mkdir()
    record(tmp_path / f"a_{'0' * 8}", ConfigError("of another command"))
    for marks, words in ((["1" * 8], "1 of 1"), ([], "1 of 2 runs failed and 1 of 2")):
        with pytest.raises(LccError, match=rf"^{words} runs keep earlier rows \(reasons"):
            conclude(tmp_path, SweepPlan(marks=marks))
    told = "1 of 1 runs finished", "1 failed runs in the folder are of other commands"
    assert all(line in caplog.text for line in told)
    assert "run: not repeated: its data have changed" in caplog.messages
    training.complete(load_config(folder), folder)
    assert str(inspect_run(folder)) == "finished"
    shutil.rmtree(folder)
    record(folder, ConfigError("the folder was removed during the run"))
    assert not folder.exists()


def test_a_folder_that_was_removed_and_made_anew_belongs_to_its_new_run(tmp_path) -> None:
    lock = tmp_path / "run" / ".lock"
    with claim(lock.parent):
        lock.unlink()
        lock.write_text("of another process")
        check_refused(check_present, [(lock.parent, "another process is working")], Busy)
    assert lock.exists()


def test_survey_and_status_of_a_sweep(tmp_path) -> None:
    for name in ("finished", "failed", "stopped", "running", "running/part"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.yaml").write_text("")
    (tmp_path / "finished" / "episodes.parquet").write_bytes(b"PAR1 rows PAR1")
    for name, content in {"cut": b"PAR1 row", "empty": b""}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "episodes.parquet").write_bytes(content)
    (tmp_path / "failed" / "error.txt").write_text("[disk] full\nmore")
    for name, done in (("stopped", 2), ("running/part", 4)):
        state = {"done": done, "total": 8, "eta_s": 10.0}
        (tmp_path / name / "progress.json").write_text(json.dumps(state))
    (tmp_path / ".submitit" / "1").mkdir(parents=True)
    (tmp_path / "sweep.json").write_text(json.dumps({"runs": 6, "varied": ["seed"]}))
    with claim(tmp_path / "running" / "part"):
        printed = status(tmp_path)
    damaged = ["episodes.parquet", "is", "cut", "or", "damaged"]
    assert [line.split() for line in printed[:-1]] == [
        ["failed", "cut", *damaged],
        ["failed", "empty", *damaged],
        ["failed", "failed", "[disk]", "full"],
        ["finished", "finished"],
        ["running", "4/8", "running/part", "ETA", "0:10"],
        ["stopped", "2/8", "stopped"],
    ]
    # The running one has 10 s of 20 s left; two wait and one stopped, 20 s each, one at a time.
    assert printed[-1].endswith(
        "6 runs: 1 finished, 1 running, 1 stopped, 3 failed; about 0:30 left"
    )


def test_clean_removes_failed_runs_without_work(tmp_path, capsys, monkeypatch) -> None:
    for name in ("failed", "failed_late", "stopped"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.yaml").write_text("")
    for name in ("failed", "failed_late"):
        (tmp_path / name / "error.txt").write_text("full")
        (tmp_path / name / "train.log").write_text("")
    (tmp_path / "failed_late" / "checkpoint.pt").write_text("")
    monkeypatch.chdir(tmp_path)
    check_refused(main, [(["", "--clean"], "the name of the folder is empty")])
    main([str(tmp_path), "--clean"])
    assert f"removed {tmp_path / 'failed'}\n" in capsys.readouterr().out
    assert {path.name for path in tmp_path.iterdir()} == {"failed_late", "stopped"}


def test_a_folder_that_is_no_run_is_refused_with_the_runs_and_tables_in_it(tmp_path) -> None:
    assert str(no_run(tmp_path)) == f"{tmp_path}: not a run folder: it has no config.yaml"
    for name in ("seed=0", "seed=1", "seed=2", "seed=3", "tables"):
        (tmp_path / name).mkdir()
        if name != "tables":
            (tmp_path / name / "config.yaml").write_text("")
    (tmp_path / "tables" / "main.parquet").write_text("")
    with pytest.raises(ConfigError) as caught:
        load_config(tmp_path)
    assert str(caught.value) == (
        f"{tmp_path}: not a run folder: it has no config.yaml; it holds the runs seed=0, seed=1, "
        "seed=2 … (4); it holds the table tables/main.parquet; "
        f"lcc_rl.results.load('{tmp_path}') reads all runs"
    )


def test_nothing_to_see(tmp_path) -> None:
    assert status(tmp_path)[-1].endswith("0 runs: none")
    assert overview_line(tmp_path, [], 1).endswith("1 run: 1 waiting")
    done = run_command("status", "", cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "the name of the folder is empty" in done.stderr


def test_progress_that_is_none(tmp_path) -> None:
    (tmp_path / "run").mkdir()
    for text in ("[" * 100_000, '{"done": "x"}', "3", "{}"):
        for name in ("run/config.yaml", "run/progress.json", "sweep.json"):
            (tmp_path / name).write_text(text)
        assert "stopped" in status(tmp_path)[0], text[:20]
        assert [run.total for run in survey(tmp_path)] == [0], text[:20]


def shown(drawn) -> str:
    """Return what a terminal of 80 columns shows, without spaces and ends of lines."""
    console = Console(width=80, file=StringIO(), force_terminal=True, color_system=None)
    console.print(drawn)
    return "".join(console.file.getvalue().split())


def test_names_and_errors_are_whole_on_80_columns() -> None:
    name, error = f"score/{'a' * 60}/highway", "loss_actor became nan in iteration 3; " * 5
    states = [RunState(name, "failed", 3, 3, error=error), RunState("b", "running", 1, 3, 65.0)]
    text = shown(states_table(Path("outputs"), states, 2))
    assert text.count("became") == 5
    for whole in ("a" * 40, "ETA1:05", "failed3/3"):
        assert whole in text
    assert "…" not in text


def test_the_bar_of_a_training_fits_80_columns() -> None:
    console = Console(width=80, file=StringIO(), force_terminal=True, color_system=None)
    with ProgressReporter("train own_energy", 240, console=console) as progress:
        for done in (1, 240):
            progress.update(done, {"reward": -1234.0, "loss": 1234.0})
        assert "240/240reward-1234loss1234ETA0:000:00:00" in shown(progress.bar)
