"""Gymnasium's environments are this package's, step for step."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import lcc_rl
from lcc_rl.envs.arrays import ArrayEpisodes
from lcc_rl.errors import LccError
from lcc_rl.pieces.base import SEED

gymnasium = pytest.importorskip("gymnasium", reason="extra interfaces")

from gymnasium.utils.env_checker import check_env  # noqa: E402

import lcc_rl.interfaces.gym  # noqa: E402

DATA = ["data.platoons=2", "data.recordings=2", "data.duration_s=[32,40]"]
SHORT = [*DATA, "scenario.horizon=20"]
STILL = np.zeros((3, 1), np.float32)
SEEDS, WHOLE = np.array([3, 4, 5]), "seed must be a whole number from 0 to 4294967295, got"
EVERYWHERE = (-1, 3.0, True, np.True_, "3", 2**32, 2**64)
BAD_SEEDS = (
    (*EVERYWHERE, [3]),
    (*EVERYWHERE, 2**32 - 2, [-1, 3, 4], [3, 4, 2**64], [3.0, 4, 5], SEEDS / 1.0, SEEDS > 3),
)
BAD_OPTIONS = (
    ({5: 5}, "option '5'; valid"),
    ("x", "options must be"),
    ([1], "options must be"),
    *(({"leader.profile": given}, "whole number") for given in ([[1], []], 2**63, True, "1")),
)


@pytest.fixture(scope="module")
def env():
    return gymnasium.make("lcc_rl/alcc-v0", overrides=SHORT)


@pytest.fixture(scope="module")
def many():
    return gymnasium.make_vec("lcc_rl/alcc-v0", num_envs=3, overrides=SHORT)


def test_gymnasium_accepts_it(env) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize(
    ("variant", "overrides", "translated"),
    [
        ("alcc", [], True),
        ("reference", ["scenario.string=automated human*2", "+filter=cbf"], True),
        ("alcc", ["scenario.controllers.human.wiener=0.1"], True),
        ("alcc", ["scenario.string={size: 3, penetration: 0.3}"], False),  # places are drawn
    ],
)
def test_whole_episodes_are_those_of_the_torchrl_environment(
    variant, overrides, translated
) -> None:
    count, overrides = 8, [*DATA, *overrides]
    own = lcc_rl.make_env(variant, count, overrides)
    episodes = ArrayEpisodes(lcc_rl.make_env(variant, count, overrides))
    assert episodes.advance.translated == translated
    seen = episodes.reset(np.arange(count), range(count))
    td = own.reset(TensorDict({SEED: torch.as_tensor(episodes.state[:, :1]).long()}, [count]))
    rng, running = np.random.default_rng(0), np.ones(count, bool)
    for _ in range(300):
        np.testing.assert_allclose(seen[running], td["observation"][running], atol=1e-5)
        action = rng.uniform(-0.5, 0.3, (count, 1)).astype(np.float32)
        results, seen = episodes.step(action), episodes.observation
        td = own.step(td.set("action", torch.as_tensor(action)))["next"]
        terms = [td["reward_terms", name] for name in episodes.terms]
        found = torch.cat([td["reward"], td["terminated"], td["truncated"], *terms], -1)
        np.testing.assert_allclose(results[running], found[running], atol=1e-5)
        running &= ~td["terminated"].squeeze(-1).numpy()
        td = td.exclude("reward", "reward_terms")
    assert running.sum() >= 2
    assert td["done"].all()


def test_a_place_of_the_vector_plays_what_one_environment_of_its_seed_plays(env, many) -> None:
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (45, 3, 1)).astype(np.float32)
    first, _ = many.reset(seed=3)
    together = [many.step(each) for each in actions]
    for place in range(3):
        seen, _ = env.reset(seed=3 + place)
        np.testing.assert_array_equal(first[place], seen)
        for given, (after, rewards, *_, info) in zip(actions[:, place], together, strict=True):
            seen, reward, terminated, truncated, own = env.step(given)
            assert reward == rewards[place]
            assert sum(own["reward_terms"].values()) == pytest.approx(reward, abs=1e-4)
            assert ("final_obs" in info and info["_final_obs"][place]) == (terminated or truncated)
            if terminated or truncated:
                np.testing.assert_array_equal(info["final_obs"][place], seen)
                seen, _ = env.reset()
            np.testing.assert_array_equal(after[place], seen)


def test_seeds_masks_and_options_take_effect(env, many) -> None:
    first, _ = many.reset(seed=[3, 4, 3])
    np.testing.assert_array_equal(first[0], first[2])
    moved, *_ = many.step(STILL)
    only_one = {"reset_mask": np.array([False, True, False])}
    again, _ = many.reset(seed=[None, 3, None], options=only_one)
    np.testing.assert_array_equal(again[1], first[0])
    np.testing.assert_array_equal(again[0], moved[0])
    other, _ = many.reset(options={"episode.seed": [5, 6, 5], "leader.profile": 1})
    np.testing.assert_array_equal(other[0], other[2])
    options = {"episode.seed": 5, "leader.profile": 1, "human.driver": 7}
    seen, _ = env.reset(options=options)
    own = lcc_rl.make_env("alcc", (), SHORT)
    given = {tuple(name.split(".")): torch.tensor([value]) for name, value in options.items()}
    given["human", "driver"] = given["human", "driver"].unsqueeze(-1)
    np.testing.assert_array_equal(seen, own.reset(TensorDict(given, []))["observation"])


def test_an_action_of_double_precision_changes_no_type(env, many) -> None:
    for each, action in ((env, np.full(1, 0.3)), (many, np.full((3, 1), 0.3))):
        seen = []
        for given in (action, action.astype(np.float32)):
            each.reset(seed=0)
            seen.append(each.step(given)[0])
        assert seen[0].dtype == np.float32
        np.testing.assert_array_equal(*seen)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda one, many: many.reset(seed=[]), "seed must be a number or a list of 3"),
        (lambda one, many: many.reset(options={"reset_mask": np.zeros(3, bool)}), "one true"),
        (lambda one, many: many.reset(options={"reset_mask": [0, 1, 1]}), "3 truth values"),
        (lambda one, many: one.reset(options={"leader.profil": 1}), "leader.profil"),
        (lambda one, many: one.reset(options={"leader.profile": 0.5}), "1 whole number"),
        (lambda one, many: many.reset(options={"leader.start": [1, 2]}), "1 or 3 whole numbers"),
        (lambda one, many: one.reset(options={"leader.profile": 10**6}), "must lie in 0…"),
        (lambda one, many: many.reset(options={"reset_mask": np.zeros((64, 2))}), "3 truth values"),
        (lambda one, many: many.reset(options={"reset_mask": [[True], [], []]}), "3 truth values"),
        *(
            (lambda one, many, seed=seed, place=place: (one, many)[place].reset(seed=seed), WHOLE)
            for place, seeds in enumerate(BAD_SEEDS)
            for seed in seeds
        ),
        *(
            (lambda one, many, given=given, place=place: (one, many)[place].reset(options=given), x)
            for place in (0, 1)
            for given, x in BAD_OPTIONS
        ),
        (lambda one, many: many.step(np.zeros((2, 1))), r"must be \[3, 1\], got \[2, 1\]"),
        (lambda one, many: many.step(STILL + np.nan), "automated.action is nan at step 1"),
    ],
)
def test_what_cannot_take_effect_is_refused_in_one_line(env, many, call, message) -> None:
    env.reset(seed=0)
    many.reset(seed=0)
    with pytest.raises(LccError, match=message) as error:
        call(env, many)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "given",
    [
        {"options": {"leader.profil": 1}},
        {"options": {"leader.profile": 10**6}},
        {"options": {"reset_mask": [True]}},
        {"options": "x"},
        {"seed": -1},
    ],
)
def test_a_refused_reset_changes_nothing(env, many, given) -> None:
    for each, seed in ((env, 9), (many, [9, 9, 9])):
        each.reset(seed=5)
        expected, _ = each.reset()
        each.reset(seed=5)
        with pytest.raises(LccError):
            each.reset(**{"seed": seed, **given})
        np.testing.assert_array_equal(each.reset()[0], expected)


def test_seeds_may_be_whole_numbers_of_numpy(env, many) -> None:
    for each, seed, same in ((env, 3, SEEDS[0]), (many, 3, SEEDS[0]), (many, [3, 4, 5], SEEDS)):
        expected, _ = each.reset(seed=seed)
        np.testing.assert_array_equal(each.reset(seed=same)[0], expected)


@pytest.mark.parametrize(
    ("make", "given", "message"),
    [
        (gymnasium.make, {"render_mode": "human"}, "render_mode must be None, got 'human'"),
        (gymnasium.make_vec, {"render_mode": "human"}, "render_mode must be None, got 'human'"),
        (gymnasium.make_vec, {"max_episode_steps": 10}, "scenario.horizon=10"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*render_mode")
def test_what_cannot_be_made_is_refused_in_one_line(make, given, message) -> None:
    with pytest.raises(LccError, match=message):
        make("lcc_rl/alcc-v0", overrides=SHORT, **given)


def test_an_episode_that_has_ended_takes_no_further_step(env) -> None:
    env.reset(seed=0)
    while not any(env.step(STILL[0])[2:4]):
        pass
    with pytest.raises(gymnasium.error.ResetNeeded, match="after the last"):
        env.step(STILL[0])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_stable_baselines3_learns_on_it(env) -> None:
    sb3 = pytest.importorskip("stable_baselines3", reason="extra interfaces")
    model = sb3.DDPG("MlpPolicy", env, learning_starts=50, seed=0)
    model.learn(200)
    action, _ = model.predict(env.reset(seed=0)[0])
    assert env.action_space.contains(action)
