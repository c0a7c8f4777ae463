"""What is not a number ends an evaluation or a training with one error, and nothing is written."""

from __future__ import annotations

import math
import sys
from io import StringIO

import numpy as np
import pandas as pd
import pytest
import torch
from commands import tiny
from helpers import (
    ACTION,
    POPULATION,
    compose,
    make_agent,
    network,
    single_env,
    small_env,
    wavy_profiles,
)
from platoons import env_of, hcfs, ramps
from rich.console import Console

from lcc_rl.agents.factory import make_trainer
from lcc_rl.commands import evaluation, training
from lcc_rl.drivers.fit import fit
from lcc_rl.drivers.genetic import GeneticSettings, minimise
from lcc_rl.drivers.observed import Selection, observe
from lcc_rl.errors import DataError, Diverged
from lcc_rl.evaluation.rollout import play
from lcc_rl.figures.page import Page
from lcc_rl.results.tables import strategies_side_by_side

MODULE = """
import torch
from lcc_rl.pieces import IDM, Controller, Feature, MotorPower, RewardTerm

def lost(step, value, at=3):
    return torch.where(step == at, float("VALUE"), value)

class LostControl(Controller):
    reads = ("self.speed", "episode.step")

    def command(self, speed, step):
        return lost(step, 0.0 * speed)

class LostDriver(IDM):
    def command(self, *entries):
        return lost(entries[-1], super().command(*entries))

class LostReward(RewardTerm):
    reads = ("self.jerk", "episode.step")

    def reward(self, jerk, step):
        return lost(step, -jerk.abs())

class LostPower(MotorPower):
    def compute(self, *entries):
        return super().compute(*entries) / 0.0

class LostEntry(Feature):
    def setup(self, world):
        reads = [("vehicles", "speed"), ("episode", "step")]
        self.wire(reads, [("vehicles", "lost")], (len(world.string), 1))

    def compute(self, speed, step):
        return lost(step.unsqueeze(-2), speed, at=4)
"""
CONTROL = ("variant=idm", "scenario.controllers.automated._target_=lost_pieces.LostControl")
DRIVER = ("scenario.controllers.human._target_=lost_pieces.LostDriver",)
POWER = ("scenario.pieces.power._target_=lost_pieces.LostPower",)
TERM = ("+reward.terms.comfort={_target_: lost_pieces.LostReward, weight: 0.1}",)
ENTRY = (
    "+scenario.pieces.lost={_target_: lost_pieces.LostEntry}",
    "+observation.scales.self.lost=0.1",
)
SMALL_TRAINING = (
    "training.episodes=40",
    "training.environments=4",
    "training.segment=10",
    "agent.batch_size=32",
    "agent.buffer_size=200",
    "agent.hidden=[16,16]",
)
FILTER = ("+filter=cbf",)
EPISODE = r"of episode \d+"


@pytest.fixture(autouse=True, params=["nan"])
def value(request, tmp_path, monkeypatch) -> str:
    """The number that is none, as the pieces of lost_pieces write it."""
    # The module of the test before, of another number, would be found loaded.
    monkeypatch.delitem(sys.modules, "lost_pieces", raising=False)
    (tmp_path / "lost_pieces.py").write_text(MODULE.replace("VALUE", request.param))
    monkeypatch.syspath_prepend(tmp_path)
    return request.param


# -- evaluation ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "overrides", "words"),
    [
        (
            "inf",
            CONTROL,
            r"strategy lostcontrol: command.automated is {} at step 4",
        ),
        ("nan", DRIVER, r"strategy direct: command.human is {} at step 4"),
        (
            "nan",
            POWER,
            r"strategy direct: vehicles.power is -?inf at step 1",
        ),
    ],
    ids=["controller", "driver", "power"],
    indirect=["value"],
)
def test_an_evaluation_names_strategy_entry_step_and_episode(
    overrides, words, value, tmp_path
) -> None:
    folder = tmp_path / "run"
    cfg = tiny("evaluate", "variant=idm", *overrides, agent=False)
    with pytest.raises(Diverged, match=words.format(value) + f" {EPISODE}"):
        evaluation.run(cfg, folder, quiet=True)
    assert not list(folder.glob("*.parquet"))


@pytest.mark.parametrize("number", [math.nan, math.inf])
@pytest.mark.parametrize("overrides", [(), FILTER])
def test_the_action_counts_before_clamp_and_filter(overrides, number) -> None:
    env, good = small_env("alcc", 3, overrides), network(compose("alcc", *overrides))

    def policy(td):
        td = good(td)
        if int(td["episode", "step"][0]) == 5:
            td[ACTION][1] = number
        return td

    policy.in_keys = [*good.in_keys, ("episode", "step")]
    words = rf"strategy x: automated.action is {number} at step 6 of episode 1"
    with pytest.raises(Diverged, match=words):
        play(env, policy, None, [("vehicles", "gap")], "strategy x")


def test_what_follows_the_end_of_an_episode_does_not_count() -> None:
    env = small_env("alcc", 2, ["scenario.start.automated.time_gap=0.05"], nominal=True)

    def policy(td):
        crashed = (td["vehicles", "gap"] <= 0).any(-2, keepdim=True)
        return td.set(ACTION, torch.where(crashed, math.nan, torch.ones(2, 1, 1)))

    record, alive = play(env, policy, None, [("vehicles", "gap")])
    assert not alive[-1].any()
    assert record["vehicles", "gap"].isfinite().all()


# -- training --------------------------------------------------------------------------------------


REWARD_LOST = r"automated.reward is nan at step 3"
POWER_LOST = r"vehicles.power is -?inf at step 1"
ITERATION = r" in iteration 1 of .*; nothing is saved$"


@pytest.mark.parametrize(
    ("own", "overrides", "words"),
    [
        ("training.collector=string", TERM, REWARD_LOST),
        ("training.collector=torchrl", POWER, POWER_LOST),
        ("training.collector=string", DRIVER, "automated.observation is nan at step 4"),
        ("agent=analytic", TERM, "automated.reward_terms.comfort is nan at step 3"),
    ],
)
def test_a_training_names_what_it_would_have_learned_from(own, overrides, words, tmp_path) -> None:
    cfg = tiny("train", "variant=alcc", own, "training.segment=20", *overrides, agent=False)
    with pytest.raises(Diverged, match=f"{words} {EPISODE}{ITERATION}"):
        training.run(cfg, tmp_path / "run", quiet=True)
    assert not (tmp_path / "run" / "policy.pt").exists()


# -- the environment -------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_a_step_refuses_an_action_that_is_no_number(number) -> None:
    env = small_env("alcc", 2)
    td = env.rand_action(env.reset())
    td[ACTION][1] = number
    with pytest.raises(Diverged, match=rf"automated.action is {number} at step 1 of episode 1"):
        env.step(td)


@pytest.mark.parametrize("name", ["filtered", "single", "hcfs"])
def test_actions_beyond_the_range_count_as_its_ends(name) -> None:
    makers = {
        "filtered": lambda: small_env("alcc", 3, FILTER),
        "single": lambda: single_env("alcc", 3),
        "hcfs": lambda: env_of(ramps(), hcfs(safe_cap=False)),
    }
    env = makers[name]()
    reached = []
    for size in (1.0, 7.0):
        env.set_seed(0)
        td = env.rand_action(env.reset())
        key = "action" if name == "single" else ACTION
        reached.append(env.step(td.set(key, torch.full_like(td[key], size)))["next"])
    assert (reached[0].exclude(ACTION) == reached[1].exclude(ACTION)).all()


# -- what else computes ----------------------------------------------------------------------------


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_an_individual_whose_objective_is_no_number_is_unfit(number) -> None:
    bounds = torch.zeros(1), torch.ones(1)
    settings = GeneticSettings(population=8, generations=4)

    def objective(genes):
        value = (genes[..., 0] - 0.25).abs()
        return torch.where(genes[..., 0] > 0.5, number, value)

    found = minimise(objective, *bounds, 2, torch.Generator().manual_seed(0), settings)
    assert (found.best < 0.5).all()
    hopeless = minimise(
        lambda genes: torch.full(genes.shape[:-1], number),
        *bounds,
        2,
        torch.Generator().manual_seed(0),
        settings,
    )
    assert (hopeless.fitness == math.inf).all()


def test_a_calibration_without_any_fit_names_the_episode() -> None:
    time = 0.1 * np.arange(200)
    still = pd.DataFrame({"time_s": time, "follower_speed_mps": 0.0, "leader_speed_mps": 0.0})
    still = still.assign(episode=7, gap_m=5.0, follower_position_m=0.0, leader_position_m=10.0)
    observed = observe(still.assign(leader_length_m=5.0), Selection(min_mean_speed_mps=0.0))
    with pytest.raises(DataError, match=r"episode 7 .*no local parameters .* finite speed_rmspe"):
        fit(observed, genetic=GeneticSettings(population=4, generations=1))


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_no_table_shows_what_is_no_number(number, tmp_path) -> None:
    frame = pd.DataFrame({"strategy": ["a", "b"], "x": [1.0, number], "n": [1, 2]})
    frame = frame.assign(x_low=[number, number], x_high=[2.0, number])
    made = Page(tmp_path)
    made.add("s", tables=[("", "c", frame)])
    page = made.write("t").read_text()
    assert ">–<" in page
    rows = [("x", "x", "{:.2f}"), ("n", "n", "{:d}")]
    console = Console(file=StringIO(), width=80)
    console.print(strategies_side_by_side(frame, rows, "t", "c"))
    printed = console.file.getvalue()
    assert "–" in printed
    for text in (page.partition("<tbody>")[2], printed):
        assert "nan" not in text
        assert "inf" not in text


def test_no_logger_is_told_what_is_no_number(tmp_path) -> None:
    cfg = compose("alcc", *SMALL_TRAINING, "agent.critic_lr=1e9")
    trainer = make_trainer(cfg, make_agent(cfg), wavy_profiles(), POPULATION, tmp_path)
    told = []
    trainer.on_row = told.append
    with pytest.raises(Diverged, match=r"became (nan|-?inf) in iteration .* Lower agent.critic_lr"):
        trainer.run()
    assert all(math.isfinite(x) for row in told for x in row.values())
