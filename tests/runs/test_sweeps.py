"""Sweeps: started again they skip, repeat and list; their folders are found again."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from pathlib import Path

import pandas as pd
import pytest
from commands import AGENT, NO_AGENT, TINY, run_command
from helpers import slow_but
from omegaconf import OmegaConf

from lcc_rl import results
from lcc_rl.cli.table import main as table_main
from lcc_rl.config import load
from lcc_rl.envs import inputs
from lcc_rl.runs import sweeps
from lcc_rl.runs.states import claim
from lcc_rl.runs.sweeps import run_name

ROOT = Path(__file__).resolve().parents[2]
GAP = "scenario.controllers.automated.time_gap"
SWEEP = ("-m", *NO_AGENT, "variant=idm")
INTERRUPTED = ("agents.loop.ProgressReporter.update", "commands.training.build_agent")


def test_a_sweep_with_failures_finishes_the_rest_and_skips_it_next_time(tmp_path) -> None:
    words = (*SWEEP, f"{GAP}=1.2,-1")
    first = run_command("train", *words, cwd=tmp_path)
    assert first.returncode == 2, first.stderr
    assert "1 of 2 runs failed" in first.stderr
    assert "Traceback" not in first.stderr
    assert f"failed: {GAP}=-1_" in first.stdout
    begun = first.stdout.index("Launching 2 jobs")
    assert f"will fail: {GAP}=-1: {GAP} must be greater than 0" in first.stdout[:begun]
    (folder,) = (tmp_path / "outputs" / "train").iterdir()
    (table,) = folder.glob("*/episodes.parquet")
    (error,) = folder.glob("*/error.txt")
    assert table.parent.name.startswith(f"{GAP}=1.2_")
    assert "time_gap" in error.read_text()
    written = table.stat().st_mtime_ns
    (folder / ".sweep.json.1.tmp").write_text("{")
    # The order of the settings does not change a folder's name.
    second = run_command("train", "-m", *reversed(words[1:]), cwd=tmp_path)
    assert "finished before" in second.stdout
    assert second.returncode == 2
    assert table.stat().st_mtime_ns == written
    assert not list(folder.glob(".*.tmp"))
    table.unlink()
    with claim(table.parent):  # another process works on it
        third = run_command("train", *words, cwd=tmp_path)
    assert "another process" in third.stdout
    assert not table.exists()


@pytest.mark.parametrize("where", slow_but(INTERRUPTED[:1], INTERRUPTED))
def test_a_sweep_that_is_interrupted_names_the_way_to_resume(tmp_path, monkeypatch, where) -> None:
    """Within an iteration, and where a library answers an interrupt with an error of its own."""

    def interrupted(*_: object) -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt as error:
            raise RuntimeError("broken") from error

    monkeypatch.setattr(f"lcc_rl.{where}", interrupted)
    words = ("-m", *TINY, "variant=alcc", "seed=0,1", "sweep=mine")
    done = run_command("train", *words, cwd=tmp_path)
    line = "lcc_rl: stopped; the same command resumes it in outputs/train/mine\n"
    assert (done.returncode, done.stderr) == (130, line)
    assert not list(tmp_path.rglob("error.txt"))
    assert len(list(tmp_path.rglob("train.log"))) == 1  # the second run has not begun


def test_a_sweep_whose_process_is_killed_names_the_way_to_resume(tmp_path, monkeypatch) -> None:
    def killed(*_: object) -> None:
        raise BrokenProcessPool("a worker was unexpectedly terminated")

    monkeypatch.setattr("lcc_rl.cli.entry.run_job", killed)
    done = run_command("train", *SWEEP, "seed=0,1", "sweep=mine", cwd=tmp_path)
    *_, last = done.stderr.splitlines()
    assert done.returncode == 2
    assert last.endswith("; the same command resumes the sweep in outputs/train/mine")


def test_a_sweep_is_read_as_one_table(tmp_path, capsys) -> None:
    inputs._last.clear()  # what other sweeps of this process have read
    one = [*TINY, "variant=alcc", "training.episodes=16", "evaluation.baselines=[human]"]
    words = [*one, "seed=0,1", "reward.terms.safety.weight=0,2", "sweep=mine"]
    done = run_command("train", "-m", *words, cwd=tmp_path, check=True)
    assert done.stdout.count(inputs.SHARED) == 3  # by all runs but the first
    assert "side by side: lcc-rl table outputs/train/mine --figure" in done.stdout
    folder = tmp_path / "outputs" / "train" / "mine"
    frame = results.load(folder, settings=["seed", "agent.gamma", "reward.*"])
    assert frame.groupby("seed")["run"].nunique().tolist() == [2, 2]
    assert {"agent.gamma", "reward.terms.safety.weight"} <= set(frame)
    rows = results.load(folder, "training")
    assert len(rows) == 4 * 2
    assert rows.groupby("seed")["episode_reward"].first().nunique() == 2
    # Rows are named by what differs, seeds share one: in its table and figure, beside others.
    names = [f"network (safety.weight={weight})" for weight in (0, 2)]
    table_main([str(folder), "--format=csv", "--figure", str(tmp_path / "sweep.pdf")])
    lines = capsys.readouterr().out.splitlines()[1:]
    assert {line.split(",")[0] for line in lines} == {
        f"alcc safety.weight={weight}" for weight in (0, 2)
    }
    assert (tmp_path / "sweep.pdf").stat().st_size > 5000
    alone = [*NO_AGENT, "variant=alcc", "evaluation.baselines=[human]", f"compare=[{folder}]"]
    told = run_command("evaluate", *alone, cwd=tmp_path, check=True)
    assert all(told.stdout.count(f"{name}: the policy of") == 2 for name in names)


def test_runs_of_a_sweep_over_two_settings_are_named_without_quotes(tmp_path) -> None:
    (tmp_path / "sweep.json").write_text(json.dumps({"runs": 4, "varied": [GAP, "seed"]}))
    told = {"sweep": {"dir": str(tmp_path)}, "job": {"config_name": "train"}}
    told |= {"overrides": {"task": ["variant=idm", f"{GAP}=1.2", "seed=1"]}}
    name = run_name(_root_=OmegaConf.create({"hydra": told}))
    assert name.rpartition("_")[0] == f"{GAP}=1.2+seed=1"
    for words in (f"compare=[idm,{tmp_path}/{name},mpc]", f"compare=[idm,'{tmp_path}/{name}',mpc]"):
        assert load("evaluate", [words]).compare == ["idm", f"{tmp_path}/{name}", "mpc"]
    assert load("evaluate", [f"policy='{tmp_path}/a=1,b=2_3f'"]).policy == f"{tmp_path}/a=1,b=2_3f"


def test_what_was_typed_may_refer_to_settings() -> None:
    typed = ["seed=${agent.gamma},1", "agent.gamma=0.9"]
    config = OmegaConf.create({"hydra": {"overrides": {"task": typed}, "sweeper": {}}})
    values = [["$\\{agent.gamma\\}", "1"]]
    assert sweeps.make_plan(config) == sweeps.SweepPlan(2, ["seed"], values)


def test_a_value_that_is_typed_twice_is_one() -> None:
    typed = {"task": ["variant=alcc", "experiment=smoke", "seed=0,1", "agent.gamma=0.9,0.9"]}
    hydra = {"overrides": typed, "sweeper": {}, "job": {"config_name": "train"}}
    config = OmegaConf.create({"hydra": hydra})
    plan = sweeps.make_plan(config)
    assert plan.values == [["0", "1"], ["0.9"]]
    # The hashes belong to the cells of the plan, in their order.
    assert len(set(sweeps.check_cells(config, plan.varied))) == plan.runs == 2


def test_a_range_of_decimals_is_told_to_be_listed(caplog) -> None:
    typed = {"task": ["agent.tau=range(0,0.9,0.3)", "seed=range(3)", "agent.gamma=0.25,1e-3"]}
    plan = sweeps.make_plan(OmegaConf.create({"hydra": {"overrides": typed, "sweeper": {}}}))
    sweeps.warn_of_rounding(plan)
    assert len(plan.values[0]) == 4  # three wanted
    (told,) = caplog.messages
    assert "agent.tau=0.8999999999999999" in told
    assert told.endswith("list the values: agent.tau=0.0,0.3,0.6,0.9")


CELLS = {
    ("reward.without=null,safty", "seed=0,1"): [
        f"will fail: reward.without=safty seed={seed}: unknown term of the reward"
        for seed in (0, 1)
    ],
    ("training.episodes=8,none", "seed=3"): [
        "will fail: training.episodes=none: training.episodes"
    ],
    ("seed=0,1",): [],
    ("reward.terms.safety.weight=1,1.0", "seed=0,1"): [
        "reward.terms.safety.weight=1.0 is the same run as reward.terms.safety.weight=1"
    ],
    ("seed=",): ["will fail: seed"],
    ("seed=0,1", "data=episodes", "data.path=${hydra:runtime.cwd}/pairs.csv"): [],
}


def test_cells_that_will_fail_are_named_before_the_first_run(caplog, capsys) -> None:
    def check(*words: str) -> None:
        typed = {"task": ["variant=alcc", "experiment=smoke", *words]}
        hydra = {"overrides": typed, "sweeper": {}, "job": {"config_name": "train"}}
        config = OmegaConf.create({"hydra": hydra})
        sweeps.check_cells(config, sweeps.make_plan(config).varied)

    for words, expected in CELLS.items():
        caplog.clear()
        check(*words)
        assert len(caplog.messages) == len(expected), words
        assert all(map(str.startswith, caplog.messages, expected)), caplog.messages
    with pytest.raises(SystemExit):  # Hydra starts no sweep with it
        check("agent=ddpg,nosuch")
    assert "unknown choice of agent 'nosuch'" in capsys.readouterr().err


def test_a_run_of_a_sweep_is_refused_what_has_no_effect(tmp_path) -> None:
    words = (
        "-m",
        "experiment=smoke",
        "compare=[acc]",
        "+filter=cbf",
        "evaluation.seed=0",
        "sweep=s",
    )
    done = run_command("evaluate", *words, cwd=tmp_path)
    assert "+filter=cbf has no effect: nothing drives behind the filter (acc)" in done.stdout


def test_a_sweep_of_nothing_is_one_line(tmp_path) -> None:
    done = run_command("train", *SWEEP, "seed=range(0)", cwd=tmp_path)
    assert done.returncode == 2
    assert "nothing is swept: a list of values is empty" in done.stderr
    assert not [*tmp_path.iterdir()]


def on_terminal(cwd: Path, *words: str) -> str:
    """Do a sweep on a terminal and return what that showed."""
    ours, its = pty.openpty()
    typed = [sys.executable, "-m", "lcc_rl", "train", *words]
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
    shown = on_terminal(tmp_path, *SWEEP, f"{GAP}=1.2,1.3,-1", "sweep=mine")
    table, _, end = shown.rpartition("3 runs: 2 finished, 1 failed")
    assert "waiting" in table
    assert f"failed: {GAP}=-1_" in end
    # Log lines stay in the files, also Hydra's own between two runs.
    assert "synthetic stream" not in shown
    assert "#2 :" not in shown
    (log,) = (tmp_path / "outputs/train/mine").glob(f"{GAP}=1.3_*/train.log")
    assert "synthetic stream" in log.read_text()


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["joblib", "submitit_local", "ray"])
def test_launchers_give_the_rows_of_the_serial_one(tmp_path, launcher) -> None:
    package = f"hydra_{launcher.removesuffix('_local')}_launcher"
    pytest.importorskip(f"hydra_plugins.{package}", reason="extras sweeps, ray")
    words = ["-m", "experiment=smoke", *AGENT, "training.episodes=24", "variant=alcc,reference"]
    for name in ("basic", f"lcc_{launcher}"):
        where = [f"hydra/launcher={name}", f"hydra.sweep.dir={tmp_path / name}"]
        subprocess.run([sys.executable, "-m", "lcc_rl", "train", *words, *where], check=True)
    for table in ("training", "episodes", "steps"):
        both = (results.load(tmp_path / name, table) for name in ("basic", f"lcc_{launcher}"))
        pd.testing.assert_frame_equal(*both, check_exact=True)


@pytest.mark.slow
def test_random_kills_lose_nothing() -> None:
    """Ten kills that ended an active command; by hand: python tools/kill_test.py --kills 200."""
    words = [sys.executable, str(ROOT / "tools" / "kill_test.py"), "--kills=10"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    assert "all files are present and readable, rows are identical" in done.stdout


def test_a_sweep_on_slurm_without_slurm_is_refused_in_one_line(
    tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.setattr(sweeps, "make_plan", lambda config: sweeps.SweepPlan(sweeps.MOST_RUNS + 1))
    launcher = {"_target_": "hydra_plugins.submitit.SlurmLauncher"}
    parts = {"launcher": launcher, "sweep": {"dir": str(tmp_path / "sweep")}}
    for srun in (None, "/usr/bin/srun"):
        monkeypatch.setattr(sweeps, "which", lambda name, srun=srun: srun)
        with pytest.raises(SystemExit):
            sweeps.SweepCallback().on_multirun_start(OmegaConf.create({"hydra": parts}))
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert ("use hydra/launcher=lcc_submitit_local" in said) == (srun is None)
    assert not list(tmp_path.iterdir())
