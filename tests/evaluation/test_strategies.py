"""Strategies: tuned baselines, names, and policies that do not fit."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from commands import tiny
from helpers import ACTION, POPULATION, check_refused, compose, wavy_profiles
from tensordict.nn import TensorDictModule

from lcc_rl.commands.pipeline import _episodes, read_once
from lcc_rl.config.compose import load, with_inputs
from lcc_rl.config.nodes import Node
from lcc_rl.envs import Inputs, build_env
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation import strategies
from lcc_rl.evaluation.comparison import Comparison
from lcc_rl.evaluation.entrants import Entrants, check_distinct, named_apart
from lcc_rl.evaluation.fit import check_policy, other_traffic
from lcc_rl.evaluation.named import TUNED
from lcc_rl.evaluation.strategies import Strategy, baseline, name_of, trained
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.pieces.base import Piece
from lcc_rl.results.policies import load_policy


@pytest.mark.parametrize("name", TUNED)
def test_a_tuned_rule_behind_the_filter_is_called_so_and_has_constants_for_it(name, caplog) -> None:
    margin = "scenario.filters.automated.margin"
    cfg, other = (compose("alcc", "+filter=cbf", f"{margin}={x}") for x in (0.2, 2))
    free, filtered = (baseline(cfg, one).cfg.scenario for one in (name, f"{name}_filtered"))
    assert free.filters.get(AUTOMATED) is None
    assert filtered.filters[AUTOMATED].settings["time_gap"] == 2.45
    one, two = (scenario.controllers[AUTOMATED] for scenario in (free, filtered))
    assert one.made().time_gap != two.made().time_gap
    named = baseline(cfg, "behind the filter", f"{name}_filtered").cfg.scenario
    assert named.filters[AUTOMATED]
    assert named.controllers[AUTOMATED] == two
    strategies._of_training(cfg, other, "mine")
    assert "mine: the filter of this command replaces" in caplog.text
    assert "training: margin=0.2 in place of 2" in caplog.text
    # A human driver has no filter.
    human = baseline(compose("alcc", "+filter=cbf"), "idm").cfg.scenario
    assert human.filters.get(AUTOMATED) is None


def test_drivers_on_whom_no_row_depends_are_said(caplog) -> None:
    inputs = Inputs(wavy_profiles(), wavy_profiles(), POPULATION)
    for string in ("automated", "automated human"):
        cfg = load("evaluate", ["variant=idm", f"scenario.string={string}", "scenario.horizon=250"])
        caplog.clear()
        Comparison(cfg, inputs, [baseline(cfg, "acc")])
        assert ("depends on the human drivers" in caplog.text) == (string == "automated")


def test_policies_of_one_variant_are_named_by_what_they_learned_with() -> None:
    policy = TensorDictModule(torch.nn.Linear(1, 1), ["a"], ["b"])
    ddpg, td3 = (
        Strategy("alcc", compose("alcc", f"agent={name}"), policy, 0) for name in ("ddpg", "td3")
    )
    assert [one.name for one in named_apart([ddpg, replace(ddpg, seed=1)])] == ["alcc", "alcc"]
    assert [one.name for one in named_apart([ddpg, td3])] == ["alcc ddpg", "alcc td3"]
    other = replace(ddpg, cfg=compose("alcc", "agent.gamma=0.5"), source="runs/b/policy.pt")
    named = named_apart([replace(ddpg, source="runs/a.pt"), other])
    assert [one.name for one in named] == ["alcc a", "alcc b"]
    # Seeds of one training keep one name beside another training.
    runs = [replace(ddpg, seed=x, source=f"runs/sweep/seed={x}") for x in range(2)]
    named = [one.name for one in named_apart([*runs, other])]
    assert named == ["alcc sweep", "alcc sweep", "alcc b"]
    dated = replace(other, source="runs/2026-11-25_14-26-58-976217_alcc_seed0/policy.pt")
    named = named_apart([replace(ddpg, source="runs/a.pt"), dated])
    assert [one.name for one in named] == ["alcc a", "alcc 14-26-58"]


def test_an_agents_variant_with_another_agent_is_named_by_that_one() -> None:
    assert [name_of(compose(x, "agent=sac")) for x in ("ddpg", "alcc")] == ["sac", "alcc"]


def test_rows_are_told_apart_by_whatever_differs_but_the_seed() -> None:
    policy = TensorDictModule(torch.nn.Linear(1, 1), ["a"], ["b"])
    weight, cfg = "reward.terms.safety.weight", compose("alcc")

    def run(seed: int, source: str, *words: str) -> Strategy:
        return Strategy("alcc", cfg, policy, seed, source, compose("alcc", f"seed={seed}", *words))

    own = [run(0, "w0", f"{weight}=0.0"), run(1, "w1", f"{weight}=5.0", "training.episodes=48")]
    assert [one.name for one in named_apart(own)] == ["alcc w0", "alcc w1"]
    swept = [run(s, f"sweep/{w}{s}", f"{weight}={w}") for w in (0.0, 5.0) for s in (0, 1)]
    names = [one.name for one in named_apart(swept)]
    assert names == ["alcc safety.weight=0.0"] * 2 + ["alcc safety.weight=5.0"] * 2
    # The seeds of a training share a row, whatever folders hold them and however they were drawn.
    seeds = [run(s, f"day{s}/run", f"evaluation.drivers={s + 2}", "table=all") for s in (0, 1)]
    assert [one.name for one in named_apart(seeds)] == ["alcc", "alcc"]
    assert [x.name for x in named_apart([*seeds, own[0]])] == ["alcc day0", "alcc day0", "alcc w0"]
    beside = [replace(one, source=f"run-{one.seed}") for one in seeds]
    here = f"alcc {Path.cwd().name}"
    assert [x.name for x in named_apart([*beside, own[0]])] == [here, here, "alcc w0"]


def test_policies_of_one_training_are_named_by_their_files_and_one_file_is_refused() -> None:
    policy = TensorDictModule(torch.nn.Linear(1, 1), ["a"], ["b"])
    shipped = Strategy("alcc", compose("alcc"), policy, 0, "pretrained/i24-mixed")
    own = replace(shipped, source="runs/mine/policy.pt")
    named = named_apart([shipped, own])
    assert [one.name for one in named] == ["alcc i24-mixed", "alcc mine"]
    check_distinct(named)
    twice = named_apart([own, replace(own, source="runs/mine")])
    with pytest.raises(ConfigError, match=r"alcc mine with training seed 0.*compare=\{first"):
        check_distinct(twice)


def test_a_policy_of_other_settings_is_refused() -> None:
    cfg = compose("alcc").with_(policy="p.pt")
    check_policy(cfg, compose("alcc"))
    cases = [
        ("reference", "was trained as variant reference"),
        ("alcc", "observation.scales.self.gap=0.2", "scales.self.gap=0.2, got 0.1"),
        ("alcc", "+knowledge=memory", r"with memory\.entries in its .* 'compare=\[p\.pt\]'"),
        ("alcc", "~observation.scales.ahead", r"trained without ahead\.speed in its"),
        ("alcc", "+knowledge=memory", "~observation.scales.memory", "widths.memory=4, got None"),
        ("alcc", "scenario.time_step=0.2", "scenario.time_step=0.2, got 0.1"),
    ]
    check_refused(lambda *words: check_policy(cfg, compose(*words)), cases, ConfigError)


def test_files_of_a_pipeline_are_those_that_it_was_given(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("drivers").write_text("")
    read_once(job := tiny("pipeline"), Path())
    people = {"_target_": "lcc_rl.drivers.population.bootstrap", "path": "drivers"}
    made = {"data": _episodes(job, Path()), "drivers": Node.of(people, "drivers")}
    own = with_inputs(tiny("train").with_(**made))
    words = ("drivers=calibrated", f"drivers.path={tmp_path}/drivers")
    assert not other_traffic("p.pt", own, tiny("evaluate", *words))
    other = tiny("evaluate", *words, "data.seed=3", "drivers.mode=global")
    named = "other data (path=trajectories.parquet), drivers (path=drivers): use"
    assert named in other_traffic("p.pt", own, other)


class Trend(Piece):
    """A piece of a user."""

    seconds: float = 2.0


def test_a_policy_keeps_the_pieces_that_it_observes(monkeypatch) -> None:
    monkeypatch.setattr(strategies, "with_weights", lambda cfg, *_: Strategy("alcc", cfg))
    terrain = ["+slope=hills", "+knowledge=terrain", "scenario.pieces.terrain.distances=[9.0,99.0]"]
    own = f"+scenario.pieces.trend={{_target_: {__name__}.Trend}}"
    cases = {"terrain.distances=[9.0,98.0]": terrain, "trend.seconds=9.0": [own]}
    for change, words in cases.items():
        policy, cfg = (
            compose("alcc", *words, *x).with_(policy="p.pt")
            for x in ([], [f"scenario.pieces.{change}"])
        )
        check_policy(policy, policy)
        with pytest.raises(ConfigError, match=re.escape(change.split("=")[0])):
            check_policy(cfg, policy)
        kept = trained(cfg, "p.pt", ({}, policy), POPULATION).cfg.scenario.pieces
        assert kept == policy.scenario.pieces


def test_a_policy_meets_the_conditions_of_the_command(monkeypatch, caplog) -> None:
    monkeypatch.setattr(strategies, "with_weights", lambda cfg, *_: Strategy("alcc", cfg))
    at, ahead = (
        "scenario.pieces.traffic",
        ["+knowledge=traffic", "scenario.string='human automated'"],
    )
    policy, late = (
        compose("alcc", *ahead, *words).with_(policy="p.pt") for words in ([], [f"{at}.delay=2.0"])
    )
    check_policy(late, policy)
    other = compose("alcc", *ahead, f"{at}.delay=2.0", f"{at}.places=[7]")
    for cfg in (late, other):
        piece = trained(cfg, "p.pt", ({}, policy), POPULATION).cfg.scenario.pieces["traffic"]
        assert piece == policy.scenario.pieces["traffic"].changed(delay=2.0)
    assert "p.pt: the traffic of this command replaces" in caplog.text
    assert "delay=2.0 in place of 0.0" in caplog.text
    caplog.clear()
    strategies.studied(late, ({}, policy), POPULATION)
    assert "policy=p.pt: the traffic of this command replaces" in caplog.text
    # What it keeps is said if another value was typed.
    words = ["task=i24-fleet", "compare=[pretrained/i24-traffic]", "knowledge=[spread,traffic]"]
    for change, kept in (
        ("traffic.delay=2.0", False),
        ("traffic.places=[5,10,20,40]", False),
        ("spread.seconds=[9.0,30.0]", True),
    ):
        typed = f"scenario.pieces.{change}"
        caplog.clear()
        Entrants(load("evaluate", [*words, typed]), typed=[f"++{typed}"])
        text = f"pretrained/i24-traffic observes as in its training, without {typed}"
        assert (text in caplog.text) == kept


def test_a_policy_of_a_task_is_refused_without_a_task_and_in_another_scenario() -> None:
    own = compose("alcc", "task=i24-follow5")
    with pytest.raises(ConfigError, match="add task=i24-follow5"):
        check_policy(compose("alcc"), own)
    with pytest.raises(ConfigError, match="in the scenario leading_cruise, not in ring"):
        check_policy(compose("alcc", "task=ring-22"), own)


def test_a_policy_that_may_be_the_last_drives_where_it_never_is() -> None:
    weights, own = load_policy("pretrained/i24-mixed")  # learned at drawn places
    cfg = compose("alcc", "task=i24-mixed", "scenario.string=automated human*2 automated human")
    strategy = trained(cfg, "pretrained/i24-mixed", (weights, own), POPULATION)
    env = build_env(strategy.cfg, wavy_profiles(), POPULATION, 2)
    observed = strategy.policy(env.reset())
    assert observed[ACTION].shape == (2, 2, 1)
    assert (observed["automated", "observation"][..., -1] == 1.0).all()
