"""Gymnasium's environments are this package's, step for step."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import lcc_rl

gymnasium = pytest.importorskip("gymnasium", reason="extra interfaces")

from gymnasium.utils.env_checker import check_env  # noqa: E402

import lcc_rl.interfaces.gym  # noqa: E402

SHORT = ["scenario.horizon=20", "data.platoons=2", "data.recordings=2", "data.duration_s=[32,40]"]


@pytest.fixture(scope="module")
def env():
    return gymnasium.make("lcc_rl/alcc-v0", overrides=SHORT)


@pytest.mark.filterwarnings("ignore:.*Box.*:UserWarning", "ignore:.*spec.*:UserWarning")
def test_gymnasium_accepts_it(env) -> None:
    check_env(env.unwrapped, skip_render_check=True)


def test_an_episode_is_that_of_the_torchrl_environment(env) -> None:
    own = lcc_rl.make_env("alcc", (), SHORT)
    own.set_seed(7)
    td = own.reset()
    seen, _ = env.reset(seed=7)
    rng = np.random.default_rng(0)
    for step in range(20):
        np.testing.assert_array_equal(seen, td["observation"].numpy())
        action = rng.uniform(-1, 1, 1).astype(np.float32)
        seen, reward, terminated, truncated, info = env.step(action)
        td = own.step(td.set("action", torch.as_tensor(action)))["next"]
        assert reward == pytest.approx(float(td["reward"]))
        assert sum(info["reward_terms"].values()) == pytest.approx(reward, abs=1e-4)
        if terminated:
            break
        assert truncated == (step == 19)
        td = td.exclude("reward", "reward_terms")


def test_the_vector_begins_anew_in_the_same_step_and_hands_over_the_last_observation() -> None:
    env = gymnasium.make_vec("lcc_rl/reference-v0", num_envs=3, overrides=SHORT)
    first, _ = env.reset(seed=3)
    again, _ = env.reset(seed=3)
    np.testing.assert_array_equal(first, again)
    assert env.observation_space.shape == (3, 4)
    for step in range(20):
        seen, reward, terminated, truncated, info = env.step(np.zeros((3, 1), np.float32))
        assert reward.shape == (3,)
        assert ("final_obs" in info) == bool((terminated | truncated).any())
        assert truncated[~terminated].all() == (step == 19)
    assert info["_final_obs"].all()
    assert not np.array_equal(seen, info["final_obs"])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_stable_baselines3_learns_on_it(env) -> None:
    sb3 = pytest.importorskip("stable_baselines3", reason="extra interfaces")
    model = sb3.DDPG("MlpPolicy", env, learning_starts=50, seed=0)
    model.learn(200)
    action, _ = model.predict(env.reset(seed=0)[0])
    assert env.action_space.contains(action)
