"""The platoon's commands as a user types them, shrunk to seconds."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
import torch
from commands import AGENT, HORIZON, run_command
from helpers import POPULATION, slow_but

from lcc_rl import results
from lcc_rl.agents.factory import build_agent
from lcc_rl.agents.replay import LEARNED_FROM, Trainer, transitions
from lcc_rl.commands import evaluation, training
from lcc_rl.config import identity, load
from lcc_rl.envs import build_env, load_inputs
from lcc_rl.io.files import read_parquet
from lcc_rl.results.policies import load_policy

TINY = ("experiment=smoke", HORIZON, "evaluation.profiles=3")


def tiny(entry: str, variant: str, *overrides: str):
    learned = AGENT if variant in ("ddpg", "hcfs") else ()
    return load(entry, [*TINY, f"variant={variant}", *learned, *overrides])


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("trained") / "hcfs"
    training.run(tiny("train", "hcfs"), folder, quiet=True)
    return folder


def test_hcfs_trains_its_parent_first(trained, tmp_path) -> None:
    rows = read_parquet(trained / "training.parquet")
    assert {"reward_velocity", "reward_jerk", "loss_value"} <= set(rows)
    assert rows["transitions"].iloc[-1] == 24 * 40 * 6  # episodes × steps × followers
    # The same settings train the same parent, whatever drives afterwards.
    training.run(tiny("train", "ddpg"), tmp_path / "ddpg", quiet=True)
    one, two = (load_policy(folder)[0] for folder in (trained, tmp_path / "ddpg"))
    assert all(torch.equal(one[key], two[key]) for key in one)
    episodes = read_parquet(trained / "episodes.parquet")
    assert set(episodes["case"]) == {"case 1", "case 2", "case 3", "windows"}
    assert episodes["learned_share"].between(0.0, 1.0).all()


@pytest.mark.slow
def test_hcfs_builds_on_a_given_policy(trained, tmp_path) -> None:
    rows = training.run(tiny("train", "hcfs", f"policy={trained}"), tmp_path, quiet=True)
    assert not (tmp_path / "training.parquet").exists()
    pd.testing.assert_frame_equal(rows, read_parquet(trained / "episodes.parquet"))


def test_the_gradient_through_the_simulator_trains_platoons_too(tmp_path) -> None:
    cfg = load("train", [*TINY, "variant=ddpg", "agent=analytic"])
    rows = training.run(cfg, tmp_path, quiet=True)
    assert set(rows["strategy"]) == {"ddpg"}
    assert load_policy(tmp_path)[1].agent["_target_"].endswith("Analytic")
    # Without the recipe its segments divide the platoon's episodes.
    cfg = load("train", ["variant=ddpg", "agent=analytic"])
    assert cfg.scenario.horizon % cfg.training.segment == 0


@pytest.mark.slow
def test_with_a_spacing_term_a_platoon_keeps_its_gaps(tmp_path) -> None:
    # A quarter of the recipe's length; 600 s behind a leader never trained on.
    short = ("training.episodes=7680", "evaluation.profiles=1", "evaluation.baselines=[]")
    words = ["variant=ddpg", "agent=analytic", "experiment=hcfs_spacing", "leader.cases={}", *short]
    rows = training.run(load("train", words), tmp_path, quiet=True)
    whole = rows[rows["case"] == "full length us06"]
    assert whole["frames"].min() > 2900
    assert whole["max_gap_error_m"].max() < 2.0
    assert whole["energy_ratio"].max() < 1.0


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_evaluate_every_variant(trained, tmp_path) -> None:
    yardsticks = {"cacc path", "cacc paper_like", "cacc tuned", "deadbeat", "deadbeat oracle"}
    expected = {
        "cacc": yardsticks,
        "ddpg": yardsticks | {"ddpg"},
        "hcfs": yardsticks | {"ddpg", "hcfs", "hcfs oracle"},
    }
    for variant, names in expected.items():
        given = () if variant == "cacc" else (f"policy={trained}",)
        # Not quiet: draws figures.
        rows = evaluation.run(tiny("evaluate", variant, *given), tmp_path / variant)
        assert set(rows["strategy"]) == names
        figures = {path.name for path in (tmp_path / variant / "figures").iterdir()}
        assert {"case_1_velocities.png", "case_3_jerk.png"} <= figures
        assert ("case_2_switching_hcfs.png" in figures) == (variant == "hcfs")
    # Rows do not depend on what else is evaluated, and the oracle bounds the rest.
    rows = [read_parquet(tmp_path / v / "episodes.parquet") for v in ("ddpg", "hcfs")]
    one, two = (r[r["strategy"] == "ddpg"].reset_index(drop=True) for r in rows)
    pd.testing.assert_frame_equal(one[one.columns.intersection(two.columns)], two[one.columns])
    reward = rows[1].groupby("strategy")["reward"].sum()
    assert reward.idxmax() == "deadbeat oracle"


@pytest.mark.parametrize("variant", slow_but(["hcfs"], ["cacc", "ddpg", "hcfs"]))
def test_pretrained_works_for_all_three(tmp_path, variant) -> None:
    cfg = load("evaluate", [*TINY, f"variant={variant}", "policy=pretrained"])
    rows = evaluation.run(cfg, tmp_path, quiet=True)
    assert not rows["collided"].any()
    reward = rows[rows["case"] == "windows"].groupby("strategy")["reward"].sum()
    if variant == "hcfs":
        assert reward["hcfs"] > 1.1 * max(reward["cacc tuned"], reward["ddpg"])


@pytest.mark.slow
def test_sweep_as_typed(tmp_path) -> None:
    words = ["-m", "variant=cacc,ddpg,hcfs", "seed=range(2)", *TINY, "training.episodes=8"]
    words.append("hydra.sweep.dir=sweep")
    done = run_command("lcc_rl.cli.train", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    frame = results.load(tmp_path / "sweep")
    assert frame.groupby(["variant", "seed"]).ngroups == 6
    assert {"agent.gamma", "gains.k3", "deployed.jerk_bound"} <= set(frame)


def test_transitions_are_those_of_every_follower(tmp_path) -> None:
    cfg = tiny("train", "ddpg", "training.episodes=48")
    env = build_env(cfg, load_inputs(cfg).training, POPULATION, cfg.training.environments)
    agent = build_agent(cfg, POPULATION)
    made = Trainer(agent, env, cfg.training, cfg.seed, tmp_path, identity(cfg))
    with torch.no_grad():
        source = made._source()
        source.reset()
        batch = next(iter(source))
    flat, (envs, steps) = transitions(batch), batch.shape
    assert flat.shape == (envs * steps * 6,)
    row = (3 * steps + 7) * 6 + 2  # environment 3, step 7, follower 2
    for key, name in LEARNED_FROM.items():
        if "terminated" not in key and "done" not in key:
            assert torch.equal(flat[name][row], batch[key][3, 7, 2]), name
