"""Analytic policy gradient: deterministic, resumable, honest record, and it learns."""

from __future__ import annotations

import math

import pandas as pd
import pytest
import torch
from helpers import (
    REWARD,
    TERMS,
    check_resuming,
    compose,
    make_agent,
    slow_but,
    small_loop,
    string,
    weights,
)

from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.agent import derived_seed
from lcc_rl.agents.loop import TrainingLoop
from lcc_rl.config import load
from lcc_rl.errors import Diverged

SMALL = (
    "agent=analytic",
    "agent.hidden=[16,16]",
    "training.segment=10",
    "training.episodes=40",
    "training.environments=8",
    "training.checkpoint_every=2",
)
# Without a learned value: the gradient of the whole episode.
WHOLE = ("training.segment=${scenario.horizon}", "agent.bootstrap=false", "agent.gamma=1")


def make(folder, *overrides: str, variant: str = "alcc") -> TrainingLoop:
    return small_loop(folder, *SMALL, *overrides, variant=variant)


PAIR, PLATOON = "automated human", "(automated human*5)*2"
BOTH = [("alcc", PAIR), ("reference", PAIR), ("alcc", PLATOON), ("reference", PLATOON)]


@pytest.mark.parametrize(("variant", "vehicles"), slow_but([BOTH[3]], BOTH))
def test_same_seed_same_rows_and_weights(tmp_path, variant, vehicles) -> None:
    settings = (string(vehicles), "training.episodes=16")
    one, two = (make(tmp_path / name, *settings, variant=variant) for name in "ab")
    pd.testing.assert_frame_equal(one.run(), two.run(), check_exact=True)
    assert torch.equal(weights(one), weights(two))
    other = make(tmp_path / "c", *settings, "seed=1", variant=variant)
    other.run()
    assert not torch.equal(weights(one), weights(other))


@pytest.mark.parametrize("overrides", [(), pytest.param(WHOLE, marks=pytest.mark.slow)])
def test_resuming_equals_never_having_stopped(tmp_path, overrides) -> None:
    said = r"after iteration 3 of 5; .*resume="
    check_resuming(lambda folder: make(folder, *overrides), tmp_path, said)


def test_the_record_is_that_of_the_literal_reward(tmp_path) -> None:
    one_update = ("training.episodes=8", "training.segment=20", "seed=3")
    row = make(tmp_path, *one_update).run().iloc[0]
    fresh = make(tmp_path / "again", *one_update)
    fresh.env.set_seed(derived_seed(3, 0, "episodes"))
    with torch.no_grad():
        played = fresh.env.rollout(20, shared_policy(fresh.agent.policy), break_when_any_done=False)
    terms = played["next", *TERMS].sum(1).mean(0)
    for name in ("safety", "efficiency", "cav_energy", "hdv_energy"):
        assert row[f"reward_{name}"] == pytest.approx(float(terms[name]), rel=1e-5), name
    assert row["episode_reward"] == pytest.approx(float(played["next", *REWARD].sum(1).mean()))


@pytest.mark.parametrize("every", [1, 3, 10])
def test_the_value_is_fitted_to_returns_of_all_lengths(every) -> None:
    """Against the definition, episode by episode: the last stretch is short, one collides."""
    agent = make_agent(compose("alcc", *SMALL, f"agent.value_every={every}"))
    generator = torch.Generator().manual_seed(0)
    steps, own = 7, agent
    moments = torch.randn(3, steps + 1, 1, 7, generator=generator)
    rewards = torch.randn(3, steps, 1, generator=generator)
    running = torch.ones(3, steps, 1)
    running[1, 4:], rewards[1, 5:] = 0.0, 0.0
    begins, errors = list(range(0, steps, every)), []
    with torch.no_grad():
        seen, ahead = agent.value(moments).flatten(1), agent.target(moments).flatten(1)
        for episode in range(3):
            for place in begins:
                alive = running[episode, place - 1] if place else torch.ones(1)
                wanted, factor, last = torch.zeros(1), 1.0, 0.0
                # The mixture of the returns up to each later moment, each of weight (1 − λ) λ^n.
                for begin in [b for b in begins if b >= place]:
                    end = min(begin + every, steps)
                    stretch = sum(
                        own.gamma ** (t - begin) * rewards[episode, t] for t in range(begin, end)
                    )
                    wanted = wanted + factor * stretch
                    last = factor * own.gamma ** (end - begin) * running[episode, end - 1]
                    weight = own.td_lambda ** (end - begin) if end < steps else 0.0
                    wanted = wanted + last * (1.0 - weight) * ahead[episode, end]
                    factor = last * weight
                errors.append((seen[episode, place] - wanted) * alive)
    loss = agent._fit(rewards, running, moments)
    assert float(loss) == pytest.approx(float(torch.stack(errors).square().mean()), rel=1e-5)


# Setting of a term, experiment, and the settings of surrogates that follow from it.
FOLLOW = (
    ("", "", {"safety": {"limit": 4.0, "threshold": 4.2}, "efficiency": {"threshold": 2.3}}),
    ("", "limits", {"safety": {"threshold": 4.2}, "efficiency": {"limit": 2.5, "threshold": 2.4}}),
    ("reward.terms.safety.threshold=2.0", "", {"safety": {"limit": 2.0, "threshold": 2.2}}),
    ("reward.terms.safety.margin=0.5", "", {"safety": {"margin": 0.5}}),
    ("reward.terms.efficiency.threshold=1.2", "", {"efficiency": {"limit": 1.2, "threshold": 1.0}}),
    ("reward.terms.efficiency.threshold=1.2", "limits", {"efficiency": {"threshold": 1.1}}),
    ("scenario.pieces.time_gap.speed_floor=0.5", "limits", {"efficiency": {"speed_floor": 0.5}}),
    ("reward.terms.hdv_energy.scale=2000.0", "", {"hdv_energy": {"scale": 2000.0}}),
    ("reward.terms.cav_energy.scale=2000.0", "main", {"cav_energy": {"scale": 2000.0}}),
    ("~reward.terms.safety", "limits", {"safety": {"limit": 4.0}}),
    ("scenario.vehicle_length=4.0", "main", {"efficiency": {"vehicle_length": 4.0}}),
)


def test_surrogates_take_the_settings_of_their_terms(subtests) -> None:
    for word, experiment, expected in FOLLOW:
        words = [word, experiment and f"experiment={experiment}"]
        with subtests.test(words=words):
            cfg = load("train", ["variant=alcc", "agent=analytic", *filter(None, words)])
            for name, settings in expected.items():
                found = cfg.agent.settings["surrogates"][name].settings
                assert {key: found[key] for key in settings} == pytest.approx(settings)


def test_a_term_of_weight_zero_is_no_part_of_the_objective(tmp_path) -> None:
    words = ("surrogates@agent=limits", "agent.limits.safety=null")
    names = {}
    for word in ("reward.terms.efficiency.weight=0", "~reward.terms.efficiency"):
        objective = make(tmp_path / word, *words, word).objective
        limited = list(objective.limited(objective.limits))
        names[word] = [term.name for term, _ in objective.terms], limited
    first, second = names.values()
    assert (
        first == second == (["safety", "cav_energy", "hdv_energy", "collision", "smoothness"], [])
    )


def test_divergence_is_named(tmp_path) -> None:
    trainer = make(tmp_path)
    with torch.no_grad():
        next(trainer.agent.policy.parameters()).fill_(math.nan)
    with pytest.raises(
        Diverged, match=r"weight module.* is not finite in iteration 1 of 5; .*learning_rate"
    ):
        trainer.run()


# Through a second only a price that begins early can be felt; the loss holds the learned value of
# what follows, which begins at nothing and with little discount takes longer than this to settle.
EARLY = (
    "agent.surrogates.efficiency.weight=3.0",
    "agent.surrogates.efficiency.threshold=2.25",
    "agent.surrogates.efficiency.width=0.3",
    "agent.surrogates.safety.weight=1.0",
    "agent.gamma=0.95",
)


@pytest.mark.slow
@pytest.mark.parametrize("overrides", [EARLY, WHOLE])
def test_learns_to_keep_going(tmp_path, overrides) -> None:
    rows = make(
        tmp_path,
        *overrides,
        "scenario.horizon=100",
        "training.episodes=480",
        "training.environments=16",
        "agent.learning_rate=0.01",
        "training.gap_range=[0.8,1.2]",
    ).run()
    # The objective, not the literal reward, is what a handful of steps is sure to improve; how far
    # differs a little between processors.
    assert rows["loss_actor"].tail(3).mean() < 0.7 * rows["loss_actor"].head(3).mean()
