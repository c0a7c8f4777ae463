"""The commands as a user types them, shrunk to seconds, and the same as functions."""

from __future__ import annotations

import json
import re

import pandas as pd
import pytest
import torch
from commands import QUICK, TINY, UNTRAINED, jobs_in_threads, run_command, tiny

import lcc_rl
from lcc_rl.agents.replay import ReplayLoop
from lcc_rl.commands import evaluation, training
from lcc_rl.commands.pipeline import calibrate_once, read_once
from lcc_rl.config.words import with_variant
from lcc_rl.errors import LccError
from lcc_rl.io.files import read_parquet
from lcc_rl.results.policies import load_policy
from lcc_rl.runs.states import fresh_folder


def test_train_leaves_everything_that_is_promised(trained) -> None:
    assert {path.name for path in trained.iterdir()} == {
        *(
            "config.yaml",
            "origin.txt",
            "training.parquet",
            "timing.parquet",
            "checkpoint.pt",
            "policy.pt",
        ),
        *("progress.json", "episodes.parquet", "steps.parquet"),
    }
    rows = read_parquet(trained / "training.parquet")
    assert {"episode_reward", "reward_safety", "loss_actor", "updates", "transitions"} <= set(rows)
    assert json.loads((trained / "progress.json").read_text())["done"] == 3


def test_the_best_policy_is_that_of_the_run_and_the_last_one_is_kept(tmp_path, monkeypatch) -> None:
    keep_best = ReplayLoop._keep_best

    def ever_worse(self: ReplayLoop) -> None:  # whatever the updates of this processor make of it
        self.rows[-1]["episode_reward"] = -float(len(self.rows))
        keep_best(self)

    monkeypatch.setattr(ReplayLoop, "_keep_best", ever_worse)
    words = ("variant=alcc", "agent.best_window=8", "training.keep_every=1", "seed=1")
    rows = training.run(tiny("train", *words), tmp_path, quiet=True)
    best = torch.load(tmp_path / "checkpoint.pt", weights_only=True)["memory"]["best"]["iteration"]
    kept = sorted((tmp_path / "policies").iterdir())
    assert best < len(kept)
    for name, path in (("policy.pt", kept[best - 1]), ("policy_last.pt", kept[-1])):
        (found, _), (expected, _) = load_policy(tmp_path / name), load_policy(path)
        assert all(torch.equal(found[key], expected[key]) for key in expected), name
    cfg = tiny("evaluate", "variant=alcc", f"policy={tmp_path}", agent=False)
    again = evaluation.run(cfg, tmp_path / "evaluation", quiet=True)
    own = again[again["strategy"] == "alcc"]
    assert own["total_energy_kj"].tolist() == rows["total_energy_kj"].tolist()


def test_a_policy_keeps_the_filter_it_was_trained_with(tmp_path) -> None:
    folder = tmp_path / "run"
    training.run(tiny("train", "variant=alcc", "+filter=cbf"), folder, quiet=True)
    own = read_parquet(folder / "episodes.parquet")
    cfg = tiny("evaluate", "variant=alcc", "evaluation.baselines=[]", f"compare=[{folder}]")
    rows = evaluation.run(cfg, tmp_path / "again", own=False, quiet=True)
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


@pytest.mark.usefixtures("blank_figures")
def test_pipeline_from_data_to_figures_and_completion(tmp_path, monkeypatch) -> None:
    jobs_in_threads(monkeypatch)
    monkeypatch.setattr("lcc_rl.drivers.twins.DELAYS", (0.0, 0.2))
    words = [*TINY, QUICK, "variants=[alcc]", "hydra.run.dir=job"]
    done = run_command("run", *words, cwd=tmp_path, check=True)
    job = tmp_path / "job"
    lines = done.stdout.splitlines()
    assert len(lines) <= 28, done.stdout
    assert lines[-1].startswith("page: ")
    assert (job / "report.html").read_text().count("<img") >= 5
    assert "candidates: stretches" in (job / "pipeline.log").read_text()
    rows = read_parquet(job / "evaluation" / "episodes.parquet")
    assert set(rows["strategy"]) == {*UNTRAINED, "alcc"}
    figures = {path.name for path in (job / "evaluation" / "figures").iterdir()}
    assert {"learning_curve.png", "improvement_alcc_vs_idm.png"} <= figures
    # The trainings used the drivers calibrated from the data, not the shipped ones.
    drivers = read_parquet(job / "calibration" / "drivers.parquet")
    assert rows["desired_speed_mps"].isin(drivers["desired_speed_mps"].astype("float32")).all()
    # The same table with a row more, as docs/extend.md has it.
    own = f"compare=[{job}/alcc,lcc_rl.pieces.ConstantAcceleration]"
    people = ["drivers=calibrated", f"drivers.path={job}/calibration/drivers.parquet"]
    beside = evaluation.run(tiny("evaluate", own, *people), tmp_path / "beside", quiet=True)
    added = beside["strategy"] == "ConstantAcceleration"
    assert added.any()
    pd.testing.assert_frame_equal(beside[~added].reset_index(drop=True)[rows.columns], rows)
    # Completing a complete job changes nothing.
    run_command("run", "resume=job", cwd=tmp_path, check=True)
    again = read_parquet(job / "evaluation" / "episodes.parquet")
    pd.testing.assert_frame_equal(rows, again, check_exact=True)


@pytest.mark.slow
def test_both_ways_of_a_calibration_are_reported_and_drivers_count_once(tmp_path, caplog) -> None:
    both = [QUICK, "calibration=both", QUICK.replace("local", "global")]
    with caplog.at_level("INFO", logger="lcc_rl"):
        cfg = tiny("pipeline", *both)
        read_once(cfg, tmp_path)
        path = calibrate_once(cfg, tmp_path)
    count = len(read_parquet(path)) // 2
    words = rf"calibrated {count} drivers: mean RMSPE local \d+\.\d\d %, global \d+\.\d\d %"
    assert re.fullmatch(words, caplog.messages[-1])


@pytest.mark.parametrize(
    ("words", "title"),
    [([], "2 held-out windows × "), (["split.evaluation_share=1"], " 2 windows × ")],
)
def test_windows_are_held_out_only_from_a_training(tmp_path, capsys, words, title) -> None:
    cfg = tiny("evaluate", "variant=idm", "evaluation.baselines=[]", *words, agent=False)
    evaluation.run(cfg, tmp_path / "run")
    assert title in capsys.readouterr().out


# -- as functions ----------------------------------------------------------------------------------


@pytest.mark.usefixtures("blank_figures")
def test_learn_and_compare_give_the_rows_and_tables_of_the_commands(
    trained, tmp_path, caplog
) -> None:
    run = lcc_rl.learn("alcc", TINY, tmp_path / "run")
    pd.testing.assert_frame_equal(run.rows, read_parquet(run.folder / "episodes.parquet"))
    pd.testing.assert_frame_equal(run.rows, read_parquet(trained / "episodes.parquet"))
    assert list(run.table["strategy"]) == ["alcc"]
    assert "was trained with other" not in caplog.text
    assert len(run.training) == 3
    shrunk = [word for word in TINY if not word.startswith("agent.")]
    shrunk += ["figure_formats=[svg]"]
    found = lcc_rl.compare([run, "idm_acc"], "alcc", shrunk, tmp_path / "found")
    assert {"alcc", "idm_acc", "idm"} <= set(found.table["strategy"])
    drawn = {path.name for path in (found.folder / "figures").iterdir()}
    assert {"episode_alcc.png", "episode_alcc.svg"} <= drawn
    own = found.rows[found.rows["strategy"] == "alcc"].reset_index(drop=True)
    columns = ["profile_id", "driver_id", "total_energy_kj"]
    pd.testing.assert_frame_equal(own[columns], run.rows[columns])


@pytest.mark.parametrize(
    ("asked", "beside"),
    [([], ["constant_filtered", "idm_acc_filtered"]), (["evaluation.behind_filter=[]"], [])],
)
def test_a_filtered_policy_stands_beside_the_baselines_asked_for(
    trained, tmp_path, caplog, asked, beside
) -> None:
    words = ["evaluation.baselines=[human]", "+filter=cbf", "drivers=highway", *asked]
    # A policy may have the name of its own variant, and no other one's.
    cfg = tiny("evaluate", f"compare={{alcc: {trained}}}", *words, agent=False)
    rows = evaluation.run(cfg, tmp_path / "run", quiet=True)
    assert list(rows["strategy"].unique()) == [*beside, "human", "alcc"]
    assert f"{trained} was trained with other drivers: use drivers=… as in" in caplog.text
    cfg = cfg.with_(compare={"reference": str(trained)})
    with pytest.raises(LccError, match="reference, which stands for 'network, own energy'"):
        evaluation.run(cfg, tmp_path / "named")


def test_a_training_that_changed_nothing_says_so(tmp_path, caplog) -> None:
    cfg = tiny("train", "variant=alcc", "agent.batch_size=4096")  # more than it ever collects
    training.run(cfg, tmp_path, quiet=True)
    assert "changed nothing" in caplog.text
    folders = [fresh_folder("evaluate", "alcc") for _ in range(2)]
    assert folders[0] != folders[1]  # within one second
    assert with_variant("alcc", "seed=3") == ["variant=alcc", "seed=3"]  # not letters


@pytest.mark.slow
def test_policies_of_two_agents_stand_side_by_side(tmp_path) -> None:
    for agent in ("ddpg", "analytic"):
        cfg = tiny("train", "variant=alcc", f"agent={agent}", agent=False)
        training.run(cfg, tmp_path / agent, quiet=True)
    compared = f"compare=[{tmp_path / 'analytic'}]"
    cfg = tiny("evaluate", "variant=alcc", f"policy={tmp_path / 'ddpg'}", compared, agent=False)
    rows = evaluation.run(cfg, tmp_path / "both")  # not quiet: draws figures
    assert list(rows["strategy"].unique()) == [*UNTRAINED, "alcc analytic", "alcc ddpg"]
    energies = rows.groupby("strategy")["total_energy_kj"].mean()
    assert energies["alcc analytic"] != energies["alcc ddpg"]
    figures = {path.name for path in (tmp_path / "both" / "figures").iterdir()}
    assert "human_energy_alcc_ddpg.png" in figures
