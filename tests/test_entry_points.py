"""The commands as a user types them, shrunk to seconds."""

from __future__ import annotations

import json
import os
import re
import signal
from pathlib import Path

import pandas as pd
import pytest
import torch
from commands import (
    QUICK,
    TINY,
    UNTRAINED,
    assert_same_tables,
    jobs_in_threads,
    run_command,
    start,
    tiny,
    wait_for,
)

from lcc_rl import results
from lcc_rl.commands import evaluation, pipeline, training
from lcc_rl.config import load
from lcc_rl.errors import ConfigError, LccError
from lcc_rl.io.files import read_parquet
from lcc_rl.results.policies import load_policy


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("trained") / "alcc"
    training.run(tiny("train", "variant=alcc"), folder, quiet=True)
    return folder


def test_train_leaves_everything_that_is_promised(trained) -> None:
    names = {path.name for path in trained.iterdir()}
    assert names == {
        "config.yaml",
        "training.parquet",
        "timing.parquet",
        "checkpoint.pt",
        "policy.pt",
        "progress.json",
        "episodes.parquet",
        "steps.parquet",
    }
    rows = read_parquet(trained / "training.parquet")
    assert {"episode_reward", "reward_safety", "loss_actor", "updates", "transitions"} <= set(rows)
    assert json.loads((trained / "progress.json").read_text())["done"] == 3


def test_same_command_same_rows(trained, tmp_path) -> None:
    training.run(tiny("train", "variant=alcc"), tmp_path, quiet=True)
    assert_same_tables(trained, tmp_path)


def test_the_best_policy_is_that_of_the_run_and_the_last_one_is_kept(trained, tmp_path) -> None:
    assert not (trained / "policy_last.pt").exists()
    # Early weights are better than what this learning rate makes of them.
    words = ("variant=alcc", "agent.best_window=8", "agent.actor_lr=0.1", "training.keep_every=1")
    rows = training.run(tiny("train", *words), tmp_path, quiet=True)
    best = torch.load(tmp_path / "checkpoint.pt", weights_only=True)["memory"]["best"]
    kept = {name: load_policy(path)[0] for name, path in policies(tmp_path).items()}
    expected = kept[best["iteration"]]
    assert best["iteration"] < max(kept)
    for name, chosen in (("policy.pt", expected), ("policy_last.pt", kept[max(kept)])):
        found, _ = load_policy(tmp_path / name)
        assert all(torch.equal(found[key], chosen[key]) for key in chosen), name
    cfg = tiny("evaluate", "variant=alcc", f"policy={tmp_path}", agent=False)
    again = evaluation.run(cfg, tmp_path / "evaluation", quiet=True)
    own = again[again["strategy"] == "alcc"].reset_index(drop=True)
    assert own["total_energy_kj"].tolist() == rows["total_energy_kj"].tolist()


def policies(folder: Path) -> dict[int, Path]:
    return {int(path.stem): path for path in (folder / "policies").iterdir()}


def test_evaluate_a_policy_beside_the_baselines(trained, tmp_path) -> None:
    cfg = tiny("evaluate", "variant=alcc", f"policy={trained}")
    rows = evaluation.run(cfg, tmp_path)  # not quiet: draws figures
    assert set(rows["strategy"]) == {*UNTRAINED, "alcc"}
    # The training's own evaluation met the same episodes.
    own = read_parquet(trained / "episodes.parquet")
    again = rows[rows["strategy"] == "alcc"].reset_index(drop=True)[own.columns]
    pd.testing.assert_frame_equal(again, own, check_exact=True)
    figures = {path.name for path in (tmp_path / "figures").iterdir()}
    assert {"episode_alcc.png", "human_energy_alcc.png", "improvement_alcc_vs_idm.png"} <= figures


def test_a_policy_keeps_the_filter_it_was_trained_with(tmp_path) -> None:
    folder = tmp_path / "run"
    training.run(tiny("train", "variant=alcc", "+filter=cbf"), folder, quiet=True)
    own = read_parquet(folder / "episodes.parquet")
    ways = {"policy": (f"policy={folder}",), "compare": (f"compare=[{folder}]",)}
    for name, words in ways.items():
        cfg = tiny("evaluate", "variant=alcc", *words)
        rows = evaluation.run(cfg, tmp_path / name, own=name == "policy", quiet=True)
        again = rows[rows["strategy"] == "alcc"].reset_index(drop=True)[own.columns]
        pd.testing.assert_frame_equal(again, own, check_exact=True)


def test_baselines_share_the_scenario_under_study(trained, tmp_path) -> None:
    # A quieter scenario must reach the baselines as well, without changing what they are.
    calm = "scenario.controllers.human.noise=0"
    cfg = tiny("evaluate", "variant=alcc", f"policy={trained}", calm)
    rows = evaluation.run(cfg, tmp_path / "a", quiet=True)
    cfg = tiny("evaluate", "variant=idm", calm, agent=False)
    alone = evaluation.run(cfg, tmp_path / "b", quiet=True)
    for name in ("idm", "direct"):
        one, two = (r[r["strategy"] == name].reset_index(drop=True) for r in (rows, alone))
        pd.testing.assert_frame_equal(one, two, check_exact=True)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["variant=idm", "policy={trained}"], "learns nothing"),
        (["variant=reference", "policy={trained}"], "trained as variant alcc"),
        (["variant=alcc", "policy=nowhere"], "no such file"),
        (["variant=alcc", "policy={trained}/training.parquet"], "not a readable weights file"),
    ],
)
def test_policies_that_do_not_fit(trained, tmp_path, overrides, words) -> None:
    cfg = tiny("evaluate", *(item.format(trained=trained) for item in overrides), agent=False)
    with pytest.raises(LccError, match=words):
        evaluation.run(cfg, tmp_path)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("~scenario.pieces.ttc", r"lacks \['ttc'\], which the evaluation measures"),
        ("~scenario.pieces.predicted_power", r"reads human\.predicted_power, which no piece"),
        ("~scenario.controllers.human", r"has the role 'human', but scenario\.controllers names"),
    ],
)
def test_what_would_fail_late_fails_before_anything_is_written(tmp_path, override, words) -> None:
    with pytest.raises(ConfigError, match=words):
        training.run(tiny("train", override), tmp_path)
    assert not (tmp_path / "training.parquet").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_strings_of_followers_and_no_car_at_all(tmp_path) -> None:
    training.run(tiny("train", "variant=direct", agent=False), tmp_path / "direct", quiet=True)
    cfg = tiny("evaluate", "variant=idm", "scenario.string='automated human*3'", agent=False)
    rows = evaluation.run(cfg, tmp_path / "three")
    assert set(rows["strategy"]) == {*UNTRAINED}
    assert (tmp_path / "three" / "figures" / "episode_idm.png").exists()


@pytest.mark.usefixtures("blank_figures")
def test_pipeline_from_data_to_figures_and_completion(tmp_path, monkeypatch) -> None:
    jobs_in_threads(monkeypatch)
    overrides = [*TINY, QUICK, "variants=[reference,alcc]"]
    done = run_command("lcc_rl.cli.pipeline", *overrides, f"hydra.run.dir={tmp_path}", cwd=tmp_path)
    told = done.stdout.splitlines()
    assert len(told) <= 25, done.stdout
    assert told[-1] == f"page: {tmp_path / 'report.html'}"
    assert (tmp_path / "report.html").read_text().count("<img") >= 5
    assert "candidates: stretches" in (tmp_path / "pipeline.log").read_text()
    rows = read_parquet(tmp_path / "evaluation" / "episodes.parquet")
    assert set(rows["strategy"]) == {*UNTRAINED, "reference", "alcc"}
    for name in ("reference", "alcc"):
        assert (tmp_path / name / "policy.pt").exists()
    figures = {path.name for path in (tmp_path / "evaluation" / "figures").iterdir()}
    assert {"learning_curve.png", "improvement_alcc_vs_reference.png"} <= figures
    # The trainings used the drivers calibrated from the data, not the shipped ones.
    drivers = read_parquet(tmp_path / "calibration" / "drivers.parquet")
    assert rows["desired_speed_mps"].isin(drivers["desired_speed_mps"].astype("float32")).all()
    # Completing a complete job changes nothing.
    again = pipeline.run(load("pipeline", overrides), tmp_path, overrides)
    assert isinstance(again, pd.DataFrame)
    pd.testing.assert_frame_equal(rows, again, check_exact=True)


def test_multirun_sweep_and_results_load(tmp_path) -> None:
    words = [*TINY, "variant=alcc,reference", "seed=0,1", "hydra.sweep.dir=sweep"]
    run_command("lcc_rl.cli.train", "-m", *words, cwd=tmp_path, check=True)
    frame = results.load(tmp_path / "sweep")
    assert frame.groupby(["variant", "seed"]).ngroups == 4
    assert frame["run"].nunique() == 4
    assert {"agent.gamma", "reward.terms.safety.weight", "scenario.horizon"} <= set(frame)
    training = results.load(tmp_path / "sweep", "training")
    assert len(training) == 4 * 3
    assert training.groupby("seed")["episode_reward"].first().nunique() == 2


@pytest.mark.slow
def test_sigkill_and_resume_equal_an_uninterrupted_run(tmp_path) -> None:
    longer = ("training.episodes=160", "variant=alcc")
    training.run(tiny("train", *longer), tmp_path / "whole", quiet=True)
    with start("lcc_rl.cli.train", *TINY, *longer, "hydra.run.dir=run", cwd=tmp_path) as process:
        wait_for(tmp_path / "run" / "checkpoint.pt", process)
        process.send_signal(signal.SIGKILL)
    assert not (tmp_path / "run" / "episodes.parquet").exists()
    run_command("lcc_rl.cli.train", "resume=run", cwd=tmp_path, check=True)
    assert_same_tables(tmp_path / "whole", tmp_path / "run")


@pytest.mark.slow
def test_sigint_exits_with_130_and_one_line(tmp_path) -> None:
    words = (*TINY, "training.episodes=80000", "hydra.run.dir=run")
    with start("lcc_rl.cli.train", *words, cwd=tmp_path) as process:
        wait_for(tmp_path / "run" / "checkpoint.pt", process)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    said = r"stopped after iteration \d+ of 10000; (go on|resume) with: .*resume=.*run"
    assert re.search(said, errors)
    assert "Traceback" not in errors


@pytest.mark.slow
def test_an_interrupted_pipeline_is_completed(tmp_path, monkeypatch) -> None:
    words = [*TINY, QUICK, "training.episodes=400", "variants=[alcc]", "hydra.run.dir=job"]
    with start("lcc_rl.cli.pipeline", *words, cwd=tmp_path) as process:
        wait_for(tmp_path / "job/alcc/checkpoint.pt", process)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to every process of the job
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "resume=" in errors
    assert not (tmp_path / "job/alcc/episodes.parquet").exists()
    jobs_in_threads(monkeypatch)
    run_command("lcc_rl.cli.pipeline", "resume=job", cwd=tmp_path, check=True)
    assert len(read_parquet(tmp_path / "job/alcc/training.parquet")) == 50
    assert (tmp_path / "job/evaluation/figures/overview.png").exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["lcc_rl.cli.train", "variant=alccc"], "alccc"),
        (["lcc_rl.cli.train", "data=ngsim"], "data.path"),
        (["lcc_rl.cli.train", "data=ngsim", "data.path=nowhere.csv"], "nowhere.csv"),
        (["lcc_rl.cli.train", "resume=nowhere"], "nowhere"),
        (["lcc_rl.cli.pipeline", "variants=[]"], "variants"),
        (["lcc_rl.cli.pipeline", "variant=idm"], "variant=idm has no effect on lcc-rl run"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, words, expected) -> None:
    done = run_command(*words, cwd=tmp_path)
    assert done.returncode == 2
    assert expected in done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert not (tmp_path / "nowhere").exists()
