"""Humans first: what is learned and measured on a ring begins in the wave that they made."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from helpers import OBSERVATION, check_refused, compose, make_agent
from torch import nn

from lcc_rl.agents.factory import make_trainer, training_env
from lcc_rl.config import load
from lcc_rl.envs import build_env, load_inputs
from lcc_rl.envs.factory import after_uncounted
from lcc_rl.envs.rollout import DifferentiableRollout
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.episodes import evaluate
from lcc_rl.evaluation.strategies import baseline

RING = ("variant=alcc", "task=ring-22", "scenario.string=automated human*5")
SHORT = ("scenario.circumference=72", "scenario.horizon=30")
MOTION = [("vehicles", name) for name in ("speed", "gap", "acceleration")]
RANGES = {
    "scenario.circumference_range": "[0.8, 1.25]",
    "scenario.controllers.human.wiener_range": "[0.5, 2]",
    "scenario.controllers.human.time_gap_range": "[0.8, 1.2]",
}


def test_a_training_takes_over_where_humans_are(tmp_path) -> None:
    """Its first moment is that of an environment in which a human drives the automated car."""
    sizes = ("agent.humans_first=20", "training.segment=30", "training.environments=3")
    cfg = load("train", [*RING, *SHORT, *sizes, "training.compiled=false"])  # as people drives
    inputs = load_inputs(cfg)
    env = training_env(cfg, inputs.training, inputs.population)
    trainer = make_trainer(cfg, make_agent(cfg), env, tmp_path)
    source = trainer.source()
    trainer.env.set_seed(3)
    begun = source.skip(source.start(), trainer.agent.burn_in)
    driver = {"automated": cfg.scenario.controllers["human"]}
    changes = {"controllers": driver, "filters": {"automated": None}, "horizon": 200}
    cfg = cfg.with_(scenario=changes)
    people = build_env(cfg, inputs.training, inputs.population, 3, 3)
    reached = people.rollout(200)["next"]
    for key in MOTION:
        assert torch.equal(begun[key], reached[key][:, -1]), key
    # The episode is as long as the scenario says, and the policy drives in it.
    assert (trainer.horizon, trainer.env.base_env.horizon) == (30, 230)
    brake = nn.Linear(begun[OBSERVATION].shape[-1], 1)  # at full strength
    nn.init.constant_(brake.bias, -100.0)
    told = DifferentiableRollout(trainer.env, brake, [("automated", "command")])
    begun = told.skip(told.start(), trainer.agent.burn_in)
    after, _ = told.play(begun, 1)
    torch.testing.assert_close(
        after["automated", "command"], torch.full((3, 1, 1), -3.0), atol=0, rtol=0
    )


def test_an_evaluation_measures_what_follows() -> None:
    """Against the same episodes played as one, the first part cut off by hand."""
    sizes = ("evaluation.profiles=2", "scenario.circumference=72", "evaluation.warm_up=0")
    cfg = load("evaluate", [*RING, *sizes, "scenario.horizon=30", "evaluation.humans_first=20"])
    inputs = load_inputs(cfg)
    rows, steps = evaluate(baseline(cfg, "follower_stopper"), inputs, None, 8, 0, 1)
    whole = baseline(load("evaluate", [*RING, *sizes, "scenario.horizon=230"]), "handover")
    people = {"from_s": 20.0, "before": cfg.scenario.controllers["human"]}
    driver = whole.cfg.scenario.controllers["automated"].changed(**people)
    whole = replace(whole, cfg=whole.cfg.driven_by(driver))
    _, played = evaluate(whole, inputs, None, 8, 0, 1)
    assert rows["duration_s"].tolist() == pytest.approx([3.0, 3.0])
    for name in ("cav_speed", "cav_gap", "hdv1_speed"):
        assert steps[name].tolist() == played[name].tolist()[200:], name


def test_a_damping_time_begins_at_the_handover(monkeypatch) -> None:
    """It counts the warm-up, too; the other measures do not."""
    monkeypatch.setattr("lcc_rl.evaluation.metrics.CALM", 0.05)  # [m/s]
    sizes = ("evaluation.profiles=2", "scenario.circumference=90", "evaluation.humans_first=20")
    found = []
    for warm_up in (0, 5):
        words = (*RING, *sizes, "scenario.horizon=300", f"evaluation.warm_up={warm_up}")
        cfg = load("evaluate", words)
        rows, _ = evaluate(baseline(cfg, "follower_stopper"), load_inputs(cfg), None, 8, 0, 1)
        found.append(rows)
    times, warm = (rows["damping_time_s"].tolist() for rows in found)
    assert times == warm
    assert min(times) > 0.0
    assert (found[0]["speed_spread_mps"] > found[1]["speed_spread_mps"]).all()


def test_rings_differ_in_training_and_not_in_an_evaluation(subtests) -> None:
    for nominal in [False, True]:
        with subtests.test(nominal=nominal):
            cfg = compose(
                "alcc", "task=ring-22", *(f"{key}={value}" for key, value in RANGES.items())
            )
            inputs = load_inputs(cfg)
            start = build_env(
                cfg, inputs.training, inputs.population, 64, 0, nominal=nominal
            ).reset()
            time_gaps = start["human", "desired_time_gap"]
            factors = {
                "[0.8, 1.25]": (start["vehicles", "gap"].sum(-2) + 22 * 5.0) / 260.0,
                "[0.8, 1.2]": time_gaps[:, 0] / 1.0,
            }
            assert time_gaps.std(-2).max() < 1e-6  # the drivers of an episode share the factor
            for name, drawn in factors.items():
                low, high = (1.0, 1.0) if nominal else json.loads(name)
                assert drawn.min().item() == pytest.approx(low, abs=0.05)
                assert drawn.max().item() == pytest.approx(high, abs=0.05)
                assert bool(((drawn > low - 1e-5) & (drawn < high + 1e-5)).all())


def test_noise_differs_in_training(subtests) -> None:
    """The first step of equal drivers differs by the noise alone; its size by the episode."""
    for nominal in [False, True]:
        with subtests.test(nominal=nominal):
            words = [f"{key}={value}" for key, value in RANGES.items() if "wiener" in key]
            cfg = compose("alcc", "task=ring-22", *words, "scenario.controllers.human.wiener=1")
            inputs = load_inputs(cfg)
            env = build_env(cfg, inputs.training, inputs.population, 256, 0, nominal=nominal)
            moved = env.step(env.rand_action(env.reset()))["next", "human", "command"]
            size = moved.std(-2).flatten() * 0.1**0.5
            ends = size.quantile(torch.tensor([0.05, 0.95])).tolist()
            assert ends == pytest.approx([0.74, 1.26] if nominal else [0.5, 2.0], rel=0.15)


def test_what_cannot_be_left_uncounted_is_refused() -> None:
    cases = [
        ("humans_first=20", "humans_first needs a ring"),
        ("warm_up=60", "warm_up must be below the 60 s"),
        ("warm_up=0.25", "warm_up must be a multiple of the time step"),
    ]
    check_refused(
        lambda word: after_uncounted(load("evaluate", ["variant=idm", f"evaluation.{word}"])),
        cases,
        ConfigError,
    )
