"""Sweeps: started again they skip, resume and list; their folders are found again."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pandas as pd
import pytest
from commands import DATA, HORIZON, run_command, tiny
from omegaconf import OmegaConf

from lcc_rl import results
from lcc_rl.agents.replay import Trainer
from lcc_rl.cli import entry
from lcc_rl.commands import training
from lcc_rl.config import identity, load
from lcc_rl.config.schemas import as_plain
from lcc_rl.errors import ConfigError, Interrupted, LccError, ResultsError
from lcc_rl.io.files import read_parquet
from lcc_rl.runs.states import ERROR, Busy, claim
from lcc_rl.runs.sweeps import (
    Plan,
    SweepCallback,
    conclude,
    make_plan,
    parallel_jobs,
    read_plan,
    run_job,
    run_name,
    sweep_name,
)

ROOT = Path(__file__).resolve().parents[2]


def test_the_same_command_gets_the_same_folder() -> None:
    one = sweep_name(None, ["seed=0,1", "variant=alcc"])
    assert one == sweep_name(None, ["variant=alcc", "seed=0,1", "logger=rows"])
    assert one != sweep_name(None, ["variant=alcc", "seed=0,1,2"])
    assert sweep_name("mine", ["seed=0,1"]) == "mine"


def hydra_like(sweep: Path, *overrides: str):
    """Return a job's whole configuration as Hydra builds it: the run's, and Hydra's own node."""
    cfg = OmegaConf.create(as_plain(load("train", overrides)))
    own = {"overrides": {"task": list(overrides)}, "sweep": {"dir": str(sweep)}, "sweeper": {}}
    own["job"] = {"config_name": "train"}
    cfg.hydra = own
    return cfg


def test_run_names_are_one_level_short_and_found_again_by_hash(tmp_path) -> None:
    path = "data.path='/some/where/a b.parquet'"
    cfg = hydra_like(tmp_path, "data=episodes", path, "seed=3", "sweep=x")
    (tmp_path / "sweep.json").write_text(json.dumps({"runs": 1, "varied": ["seed", "data.path"]}))
    name = run_name(_root_=cfg)
    mark = identity(load("train", ["data=episodes", path, "seed=3"]))[:8]
    assert name == f"data.path=-some-where-a-b.parquet-,seed=3_{mark}"
    # The same settings under another name: what was extended or typed in another order.
    (tmp_path / f"old_{mark}").mkdir()
    assert run_name(_root_=cfg) == f"old_{mark}"
    long = hydra_like(tmp_path, "data=episodes", "data.path=" + "x" * 300)
    assert len(run_name(_root_=long)) < 120


def test_a_sweep_removes_the_half_written_plan_of_a_killed_one(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(SweepCallback, "folder", None)
    monkeypatch.setattr(SweepCallback, "target", None)
    cfg = hydra_like(tmp_path / "new", "seed=4")
    cfg.hydra.launcher = {"_target_": "hydra._internal.core_plugins.BasicLauncher"}
    SweepCallback().on_multirun_start(cfg)  # its folder is new
    (tmp_path / "new" / ".sweep.json.1.tmp").write_text("{")
    SweepCallback().on_multirun_start(cfg)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["sweep.json"]


def test_plans_know_grids_and_searches(tmp_path) -> None:
    cfg = hydra_like(tmp_path, "seed=4")
    cfg.hydra.overrides.task = ["seed=range(8)", "variant=alcc,reference", "agent.gamma=0.9"]
    assert make_plan(cfg) == Plan(16, ["seed", "variant"])
    # Where its rows are sent to does not make another run.
    cfg.hydra.overrides.task = ["seed=range(8)", "logger=none,rows"]
    assert make_plan(cfg) == Plan(8, ["seed"])
    cfg.hydra.sweeper = {"n_trials": 40, "params": {"agent.tau": "interval(0.001,0.01)"}}
    cfg.hydra.overrides.task = []
    assert make_plan(cfg) == Plan(40, ["agent.tau"])
    assert read_plan(tmp_path) == Plan()


def test_jobs_leave_no_core_to_two_threads(monkeypatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    assert [parallel_jobs(threads) for threads in (1, 2, 3, 16)] == [8, 4, 2, 1]


def test_a_failed_run_is_recorded_and_the_next_goes_on(tmp_path) -> None:
    def breaks(cfg):
        raise ConfigError("too much")

    assert run_job(breaks, tiny("train"), tmp_path / "a") is None
    assert (tmp_path / "a" / ERROR).read_text() == "too much\n"
    with pytest.raises(LccError, match="1 of 1 runs failed"):
        conclude(tmp_path)

    def busy(cfg):
        raise Busy("another process")

    assert run_job(busy, tiny("train"), tmp_path / "b") is None
    assert not (tmp_path / "b").exists()

    def stopped(cfg):
        raise Interrupted("stopped after iteration 1")

    # Not an Exception: a launcher would take that for one run's failure and begin the next.
    with pytest.raises(KeyboardInterrupt):
        run_job(stopped, tiny("train"), tmp_path / "c")


def test_a_sweep_of_nothing_is_an_error(tmp_path) -> None:
    with pytest.raises(LccError, match=r"nothing was swept, in .*is a list of values empty"):
        conclude(tmp_path)


def test_a_search_of_which_every_run_failed_names_them(tmp_path, monkeypatch) -> None:
    def command() -> None:
        monkeypatch.setattr(SweepCallback, "folder", tmp_path)
        assert run_job(lambda cfg: 1 / 0, tiny("train"), tmp_path / "a") is None

    with pytest.raises(LccError, match="1 of 1 runs failed"):
        entry.sweep(command)
    assert SweepCallback.folder is None


def test_a_run_is_skipped_where_finished_and_resumed_where_stopped(tmp_path, monkeypatch) -> None:
    cfg = tiny("train", "variant=alcc", "training.episodes=32")
    whole = training.complete(cfg, tmp_path / "whole")
    written = (tmp_path / "whole" / "episodes.parquet").stat().st_mtime_ns
    again = training.complete(cfg, tmp_path / "whole")
    pd.testing.assert_frame_equal(again, whole, check_exact=True)
    assert (tmp_path / "whole" / "episodes.parquet").stat().st_mtime_ns == written

    iterate = Trainer._iterate

    def dies(self, collector):
        if self.iteration == 2:
            raise MemoryError
        return iterate(self, collector)

    folder = tmp_path / "parts"
    monkeypatch.setattr(Trainer, "_iterate", dies)
    with pytest.raises(MemoryError):
        training.complete(cfg, folder)
    assert (folder / ERROR).read_text().startswith("MemoryError")
    with pytest.raises(ResultsError, match=r"no episodes\.parquet"):
        results.load(folder)
    assert len(results.load(tmp_path, "training")) == 4 + 2  # readable while others are not done
    begun: list[int] = []

    def counted(self, collector):
        begun.append(self.iteration)
        return iterate(self, collector)

    monkeypatch.setattr(Trainer, "_iterate", counted)
    pd.testing.assert_frame_equal(training.complete(cfg, folder), whole, check_exact=True)
    assert begun == [2, 3]
    one, two = (read_parquet(tmp_path / f / "training.parquet") for f in ("whole", "parts"))
    pd.testing.assert_frame_equal(one, two, check_exact=True)
    assert not (folder / ERROR).exists()


def test_a_run_that_another_process_does_is_refused(tmp_path) -> None:
    with claim(tmp_path), pytest.raises(Busy):
        training.run(tiny("train", "variant=idm", agent=False), tmp_path)


def test_objectives_are_columns_of_the_summary(tmp_path) -> None:
    cfg = tiny("train", "variant=idm", "objective=[kj_per_km,collisions]", agent=False)
    rows = training.run(cfg, tmp_path, quiet=True)
    values = training.objective(cfg, rows)
    assert values[1] == rows["collided"].sum()
    with pytest.raises(ConfigError, match=r"unknown objective 'kj_per_k'.*'kj_per_km'"):
        training.run(tiny("train", "objective=kj_per_k"), tmp_path / "b")


SWEEP = ("experiment=smoke", "variant=idm", *DATA, HORIZON, "sweep=mine")


def test_a_sweep_with_failures_finishes_the_rest_and_skips_it_next_time(tmp_path) -> None:
    words = ["lcc_rl.cli.train", "-m", *SWEEP, "scenario.controllers.automated.time_gap=1.2,-1"]
    first = run_command(*words, cwd=tmp_path)
    assert first.returncode == 2, first.stderr
    assert "1 of 2 runs failed" in first.stderr
    assert "Traceback" not in first.stderr
    assert "failed: scenario.controllers.automated.time_gap=-1_" in first.stdout
    folder = tmp_path / "outputs" / "train" / "mine"
    assert read_plan(folder) == Plan(2, ["scenario.controllers.automated.time_gap"])
    assert results.load(folder)["run"].nunique() == 1
    second = run_command(*words, cwd=tmp_path)
    assert "finished before" in second.stdout
    assert second.returncode == 2


def on_terminal(cwd: Path, *words: str) -> str:
    """Do a sweep on a terminal and return what that showed."""
    ours, its = pty.openpty()
    typed = [sys.executable, "-m", "lcc_rl.cli.train", "-m", *words]
    env = {**os.environ, "TERM": "xterm", "COLUMNS": "150", "LINES": "40"}
    child = subprocess.Popen(typed, cwd=cwd, stdin=its, stdout=its, stderr=its, env=env)
    os.close(its)
    shown = b""
    with suppress(OSError), open(ours, "rb", buffering=0) as screen:
        while part := screen.read(65536):
            shown += part
    assert child.wait(60) == 2, shown.decode()
    return shown.decode()


@pytest.mark.slow
def test_on_a_terminal_a_sweep_is_one_table(tmp_path) -> None:
    shown = on_terminal(tmp_path, *SWEEP, "scenario.controllers.automated.time_gap=1.2,1.3,-1")
    table, _, end = shown.rpartition("┘")
    assert "waiting" in table
    assert "3 runs: 2 finished, 1 failed" in end
    assert "2 of 3 runs finished" in end
    assert "failed: scenario.controllers.automated.time_gap=-1_" in end
    # Log lines stay in the files, also Hydra's own between two runs.
    assert "[lcc_rl][INFO]" not in shown
    assert "#2 :" not in shown
    (log,) = (tmp_path / "outputs/train/mine").glob(
        "scenario.controllers.automated.time_gap=1.3_*/train.log"
    )
    assert "synthetic stream" in log.read_text()


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["joblib", "submitit_local", "ray"])
def test_launchers_give_the_rows_of_the_serial_one(tmp_path, launcher) -> None:
    package = f"hydra_{launcher.removesuffix('_local')}_launcher"
    pytest.importorskip(f"hydra_plugins.{package}", reason="extras sweeps, ray")
    small = ["experiment=smoke", "agent.batch_size=64", "agent.hidden=[16,16]"]
    words = ["-m", *small, "training.episodes=24", "variant=alcc,reference", "seed=0"]
    for name in ("basic", f"lcc_{launcher}"):
        where = [f"hydra/launcher={name}", f"hydra.sweep.dir={tmp_path / name}"]
        subprocess.run([sys.executable, "-m", "lcc_rl.cli.train", *words, *where], check=True)
    for table in ("training", "episodes", "steps"):
        serial, other = (
            results.load(tmp_path / name, table) for name in ("basic", f"lcc_{launcher}")
        )
        pd.testing.assert_frame_equal(other, serial, check_exact=True)


@pytest.mark.slow
def test_random_kills_lose_nothing() -> None:
    """Ten kills that met a command at work; by hand: python tools/kill_test.py --kills 200."""
    words = [sys.executable, str(ROOT / "tools" / "kill_test.py"), "--kills=10"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    assert "nothing lost, all readable, rows identical" in done.stdout
