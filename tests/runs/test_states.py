"""How a run stands, read from its folder: locks, errors, what is missing."""

from __future__ import annotations

import json
import os
import signal
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console, Group

from lcc_rl.cli.status import main, watch
from lcc_rl.errors import ConfigError, Interrupted, ResultsError
from lcc_rl.runs.overview import counts, draw, headline, live, remaining
from lcc_rl.runs.states import (
    ERROR,
    LOCK,
    Busy,
    RunState,
    claim,
    inspect_run,
    is_claimed,
    run_folders,
    survey,
    working,
)


def test_a_claimed_folder_is_refused_to_others_and_free_afterwards(tmp_path) -> None:
    with claim(tmp_path):
        assert is_claimed(tmp_path)
        with pytest.raises(Busy, match="another process"), claim(tmp_path):
            pytest.fail("both hold the folder")
    assert not is_claimed(tmp_path)
    assert not (tmp_path / LOCK).exists()
    with claim(tmp_path):
        pass


def test_the_claim_of_a_killed_process_is_void(tmp_path) -> None:
    child = os.fork()
    if not child:
        with claim(tmp_path):
            os.kill(os.getpid(), signal.SIGKILL)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    assert (tmp_path / LOCK).exists()
    assert not is_claimed(tmp_path)
    with claim(tmp_path):
        assert is_claimed(tmp_path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder_is_one_clear_error(tmp_path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(ResultsError, match="cannot be written"), claim(tmp_path / "run"):
        pass


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
    assert (tmp_path / ERROR).read_text() == "agent.gamma must lie in [0, 1)\n"
    assert inspect_run(tmp_path).error == "agent.gamma must lie in [0, 1)"
    (tmp_path / "figures").mkdir()
    for name in (".episodes.parquet.1.tmp", "figures/.savings.png.1.tmp"):
        (tmp_path / name).write_text("half a fi")
    with working(tmp_path):
        assert set(tmp_path.rglob("*")) == {tmp_path / LOCK, tmp_path / "figures"}
    assert inspect_run(tmp_path).state == "stopped"


def test_a_bug_is_recorded_with_its_traceback_and_an_interrupt_not_at_all(tmp_path) -> None:
    with pytest.raises(ZeroDivisionError):
        fails(tmp_path, ZeroDivisionError("by zero"))
    text = (tmp_path / ERROR).read_text()
    assert text.startswith("ZeroDivisionError: by zero\n")
    assert "Traceback" in text
    assert "in fails" in text
    with pytest.raises(Interrupted):
        fails(tmp_path, Interrupted("stopped"))
    assert not (tmp_path / ERROR).exists()


def make_sweep(root: Path) -> None:
    for name in ("finished", "failed", "stopped", "running"):
        (root / name / ".hydra").mkdir(parents=True)
        (root / name / "config.yaml").write_text("")
    (root / "finished" / "episodes.parquet").write_text("")
    (root / "failed" / ERROR).write_text("disk full\nmore")
    for name, done in (("stopped", 2), ("running", 4)):
        state = {"done": done, "total": 8, "eta_s": 10.0}
        (root / name / "progress.json").write_text(json.dumps(state))
    (root / ".submitit" / "1").mkdir(parents=True)
    (root / "sweep.json").write_text(json.dumps({"runs": 6, "varied": ["seed"]}))


def test_survey_and_status_of_a_sweep(tmp_path, capsys) -> None:
    make_sweep(tmp_path)
    with claim(tmp_path / "running"):
        states = survey(tmp_path)
        main([str(tmp_path)])
    assert states == [
        RunState("failed", "failed", error="disk full"),
        RunState("finished", "finished"),
        RunState("running", "running", 4, 8, 10.0),
        RunState("stopped", "stopped", 2, 8),
    ]
    assert counts(states, 6)["waiting"] == 2
    # The running one has 10 s of 20 s left; two wait and one stopped, 20 s each, one at a time.
    assert remaining(states, 6) == pytest.approx(10 + 3 * 20)
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].split(maxsplit=2) == ["failed", "failed", "disk full"]
    assert printed[2].split() == ["running", "4/8", "running", "ETA", "0:10"]
    assert printed[-1].endswith(
        "6 runs: 1 finished, 1 running, 1 stopped, 1 failed, 2 waiting; about 1:10 left"
    )


def test_folders_that_only_hold_runs_are_no_runs(tmp_path) -> None:
    for name in ("job", "job/alcc", "job/evaluation"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.yaml").write_text("")
    assert [folder.name for folder in run_folders(tmp_path)] == ["alcc", "evaluation"]
    assert run_folders(tmp_path / "job" / "alcc") == [tmp_path / "job" / "alcc"]


def test_nothing_to_see(tmp_path, capsys) -> None:
    main([str(tmp_path)])
    assert capsys.readouterr().out.strip().endswith("0 runs: none")
    assert remaining([]) is None
    assert headline(tmp_path, [], 3).endswith("3 runs: 3 waiting")
    with pytest.raises(SystemExit) as caught:
        main([str(tmp_path / "nowhere")])
    assert caught.value.code == 2
    assert "no such folder" in capsys.readouterr().err


def test_an_empty_name_is_one_clear_error(capsys) -> None:
    with pytest.raises(SystemExit) as caught:
        main([""])
    assert caught.value.code == 2
    assert "the name of the folder is empty" in capsys.readouterr().err


def printed(what: Group) -> list[str]:
    console = Console(file=StringIO(), width=200)
    console.print(what)
    return console.file.getvalue().splitlines()


def test_where_room_is_short_the_runs_at_work_and_in_trouble_come_first(tmp_path) -> None:
    states = [RunState(f"run{i}", "finished", 8, 8) for i in range(30)]
    states += [RunState("late", "running", 4, 8, 10.0), RunState("bad", "failed", error="[disk]")]
    lines = printed(draw(tmp_path, states, 40, most=3))
    assert [line.split()[1] for line in lines[3:7]] == ["late", "bad", "run0", "…"]
    assert "ETA 0:10" in lines[3]
    assert "[disk]" in lines[4]
    assert "29 more" in lines[6]
    assert lines[-1].endswith(
        "40 runs: 30 finished, 1 running, 1 failed, 8 waiting; about 2:50 left"
    )
    assert len(printed(draw(tmp_path, states, 40))) == 32 + 5


def test_a_watched_folder_is_drawn_until_all_is_done(tmp_path) -> None:
    make_sweep(tmp_path)
    console = Console(file=StringIO(), force_terminal=True, width=200, highlight=False)
    with live(tmp_path, lambda: 4, console):
        (tmp_path / "running" / "episodes.parquet").write_text("")
    shown = console.file.getvalue()
    assert "4 runs: 2 finished, 1 stopped, 1 failed" in shown.replace("\n", " ")
    (tmp_path / "sweep.json").unlink()
    watch(tmp_path, console, every=60)
    assert console.file.getvalue().count("disk full") > shown.count("disk full")
