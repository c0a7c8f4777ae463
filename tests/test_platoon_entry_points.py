"""The platoon's commands as a user types them, shrunk to seconds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from commands import AGENT, HORIZON
from helpers import check_refused, slow_but

from lcc_rl.api import Run
from lcc_rl.commands import evaluation, training
from lcc_rl.config import load
from lcc_rl.config.nodes import Node
from lcc_rl.io.files import read_parquet
from lcc_rl.pieces import Action, Hybrid, PISaturation
from lcc_rl.results.policies import load_policy
from lcc_rl.settings import TARGET, path_of

TINY = ("experiment=smoke", HORIZON, "evaluation.profiles=3")
RULES = {"cacc path", "cacc paper_like", "cacc tuned", "deadbeat", "deadbeat oracle"}


def tiny(entry: str, variant: str, *overrides: str):
    learned = AGENT if variant in ("ddpg", "hcfs") else ()
    return load(entry, [*TINY, f"variant={variant}", *learned, *overrides])


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("trained") / "hcfs"
    training.run(tiny("train", "hcfs"), folder, quiet=True)
    return folder


def test_a_string_without_automated_vehicles_is_refused(tmp_path) -> None:
    calls = {"train": training.run, "evaluate": evaluation.run}
    check_refused(
        lambda entry: calls[entry](tiny(entry, "cacc", "scenario.string=human*3"), tmp_path),
        [(entry, "needs an automated vehicle in scenario.string") for entry in calls],
    )


def test_hcfs_trains_its_parent_first(trained, tmp_path) -> None:
    rows = read_parquet(trained / "training.parquet")
    assert {"reward_velocity", "reward_jerk", "loss_value"} <= set(rows)
    assert rows["transitions"].iloc[-1] == 24 * 20 * 6  # episodes × steps × followers
    # The same settings train the same parent, whatever drives afterwards.
    training.run(tiny("train", "ddpg"), tmp_path / "ddpg", quiet=True)
    one, two = (load_policy(folder)[0] for folder in (trained, tmp_path / "ddpg"))
    assert all(torch.equal(one[key], two[key]) for key in one)
    episodes = read_parquet(trained / "episodes.parquet")
    assert set(episodes["case"]) == {"case 1", "case 2", "case 3", "windows"}
    assert episodes["learned_share"].between(0.0, 1.0).all()
    # A given policy is built on without any training.
    given = training.run(tiny("train", "hcfs", f"policy={trained}"), tmp_path / "on", quiet=True)
    assert not (tmp_path / "on" / "training.parquet").exists()
    pd.testing.assert_frame_equal(given, episodes)


def test_the_gradient_through_the_simulator_trains_platoons_too(tmp_path) -> None:
    cfg = load("train", [*TINY, "variant=ddpg", "agent=analytic"])
    rows = training.run(cfg, tmp_path, quiet=True)
    assert set(rows["strategy"]) == {"analytic"}
    # Without the recipe its segments divide the platoon's episodes.
    cfg = load("train", ["variant=ddpg", "agent=analytic"])
    assert cfg.scenario.horizon % cfg.training.segment == 0


def test_leaders_without_cases_have_no_figures_of_cases(tmp_path) -> None:
    record = tmp_path / "mine.csv"
    seconds = np.arange(0.0, 120.0, 0.2)
    speeds = 10.0 + 2.0 * np.sin(seconds / 8.0)
    pd.DataFrame({"time_s": seconds, "speed_mps": speeds}).to_csv(record, index=False)
    words = ["variant=cacc", "leader=record", f"leader.path={record}", "evaluation.profiles=1"]
    words += ["evaluation.full_length=false", "evaluation.baselines=[cacc tuned]"]
    rows = evaluation.run(load("evaluate", words), tmp_path)  # not quiet: draws figures
    assert set(rows["strategy"]) == {"cacc tuned"}
    assert not (tmp_path / "figures").exists()


@pytest.mark.slow
def test_with_a_spacing_term_a_platoon_keeps_its_gaps(tmp_path) -> None:
    # A quarter of the recipe's length; 600 s behind a leader never trained on.
    short = ("training.episodes=7680", "evaluation.profiles=1")
    words = ["variant=ddpg", "agent=analytic", "experiment=hcfs_spacing", "leader.cases={}", *short]
    rows = training.run(load("train", words), tmp_path, quiet=True)
    whole = rows[rows["case"] == "full length us06"]
    assert whole["frames"].min() > 2900
    assert whole["max_gap_error_m"].max() < 2.0
    assert whole["energy_ratio"].max() < 1.0


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_rows_do_not_depend_on_what_else_is_evaluated(trained, tmp_path) -> None:
    learned = {"ddpg": {"ddpg"}, "hcfs": {"ddpg", "hcfs", "hcfs oracle"}}
    for variant, names in learned.items():
        # Not quiet: draws figures.
        cfg = tiny("evaluate", variant, f"policy={trained}")
        rows = evaluation.run(cfg, tmp_path / variant)
        assert set(rows["strategy"]) == RULES | names
        figures = {path.name for path in (tmp_path / variant / "figures").iterdir()}
        assert {"case_1_velocities.png", "case_3_jerk.png"} <= figures
        assert ("case_2_switching_hcfs.png" in figures) == (variant == "hcfs")
    rows = [read_parquet(tmp_path / v / "episodes.parquet") for v in learned]
    one, two = (r[r["strategy"] == "ddpg"].reset_index(drop=True) for r in rows)
    pd.testing.assert_frame_equal(one[one.columns.intersection(two.columns)], two[one.columns])
    reward = rows[1].groupby("strategy")["reward"].sum()
    assert reward.idxmax() == "deadbeat oracle"  # it bounds the rest


class Gentler(Hybrid):
    reads = ("self.gap",)

    def choose(self, rule, learned, gap):
        return (learned.abs() < rule.abs()) & (gap > 3.0)


class Number(Gentler):
    def choose(self, rule, learned, gap):
        return 1.0


@pytest.mark.usefixtures("blank_figures")
def test_an_own_choice_is_named_and_has_no_oracle(tmp_path) -> None:
    cfg = load("evaluate", [*TINY, "variant=hcfs", "policy=pretrained", "evaluation.baselines=[]"])

    def evaluated(kind: type, **settings: object) -> pd.DataFrame:
        node = Node.of({TARGET: path_of(kind), **settings}, "deployed")
        return evaluation.run(cfg.with_(deployed=node), tmp_path)

    cacc = cfg.deployed.settings["rule"]
    refused = [(Action, {}, "deployed: expected a subclass of .*Hybrid, got .*Action")]
    refused += [(Number, {"rule": cacc}, "Number.choose must return a tensor of bool, got 1.0")]
    memory = {"rule": {TARGET: path_of(PISaturation)}}
    refused += [(Gentler, memory, r"Gentler.rule: PISaturation remembers .*; it must not")]
    check_refused(lambda kind, settings: evaluated(kind, **settings), refused)
    rows = evaluated(Gentler, rule=cacc).set_index("strategy")
    assert [*rows.index.unique()] == ["cacc", "ddpg", "Gentler"]
    driven = rows.loc["Gentler", ["learned_share", "switches", "drawn_energy_kj_per_km"]].mean()
    assert driven.min() > 0.0
    assert driven["learned_share"] < 1.0
    assert (tmp_path / "figures" / "case_1_switching_Gentler.png").exists()


@pytest.mark.parametrize("variant", slow_but(["hcfs"], ["ddpg", "hcfs"]))
def test_pretrained_works_for_variants_with_a_policy(tmp_path, variant) -> None:
    cfg = load("evaluate", [*TINY, f"variant={variant}", "policy=pretrained"])
    rows = evaluation.run(cfg, tmp_path, quiet=True)
    assert not rows["collided"].any()
    assert set(rows["strategy"]) >= RULES
    every = Run(tmp_path, rows, cfg).table
    assert {*every["of"]} == {*rows["case"]}
    assert every["speed_error_sum_mps"].notna().all()
    reward = rows[rows["case"] == "windows"].groupby("strategy")["reward"].sum()
    if variant == "hcfs":
        assert reward["hcfs"] > 1.1 * max(reward["cacc tuned"], reward["ddpg"])
