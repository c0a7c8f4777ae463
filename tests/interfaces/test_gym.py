"""Gymnasium's environments are this package's, step for step."""

from __future__ import annotations

import pickle
import warnings

import numpy as np
import pytest
import torch
from helpers import check_refused
from torch import nn

import lcc_rl
from lcc_rl.envs.arrays import ArrayEpisodes
from lcc_rl.errors import ConfigError, LccError
from lcc_rl.figures.animation import ROLE_COLOURS
from lcc_rl.pieces.base import SEED

gymnasium = pytest.importorskip("gymnasium", reason="extra interfaces")

from gymnasium.utils.env_checker import check_env  # noqa: E402

import lcc_rl.interfaces.gym  # noqa: E402
from lcc_rl.evaluation.foreign import network_of  # noqa: E402

DATA = ["data.platoons=2", "data.recordings=2", "data.duration_s=[62,70]"]
SHORT = [*DATA, "scenario.horizon=20"]
RING = "scenario.string=automated human*21"
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


# "module:id" imports the module first: a process that another program started knows the name.
NAME = "lcc_rl.interfaces.gym:lcc_rl/alcc-v0"


def test_gymnasium_accepts_it() -> None:
    env = gymnasium.make(NAME, overrides=SHORT)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    pickle.dumps(env)  # also one that was played


@pytest.mark.parametrize(
    ("variant", "overrides", "translated"),
    [
        ("reference", ["scenario.string=automated human*2", "+filter=cbf"], True),
        *(
            pytest.param("alcc", [word], translated, marks=pytest.mark.slow)
            for word, translated in (
                ("scenario.controllers.human.wiener=0.1", True),
                ("scenario.string={size: 3, penetration: 0.3}", False),  # places are drawn
            )
        ),
    ],
)
def test_whole_episodes_are_those_of_the_torchrl_environment(
    variant, overrides, translated
) -> None:
    count, overrides = 8, [*DATA, "scenario.horizon=300", *overrides]
    own = lcc_rl.make_env(variant, count, overrides)
    episodes = ArrayEpisodes(lcc_rl.make_env(variant, count, overrides))
    assert episodes.advance.translated == translated
    seen = episodes.reset(np.arange(count), range(count))
    td = own.reset(options={SEED: torch.as_tensor(episodes.state[:, :1]).long()})
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
                assert info["_final_info"][place]
                final = {x: each[place] for x, each in info["final_info"]["reward_terms"].items()}
                assert final == pytest.approx(own["reward_terms"])
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
    np.testing.assert_array_equal(seen, own.reset(options=given)["observation"])


def test_an_action_of_double_precision_changes_no_type(env, many) -> None:
    for each, action in ((env, np.full(1, 0.3)), (many, np.full((3, 1), 0.3))):
        seen = []
        for given in (action, action.astype(np.float32)):
            each.reset(seed=0)
            seen.append(each.step(given)[0])
        assert seen[0].dtype == np.float32
        np.testing.assert_array_equal(*seen)


def test_what_cannot_take_effect_is_refused_and_changes_nothing(env, many) -> None:
    given = [
        (many, {"seed": []}, "seed must be a number or a list of 3"),
        (many, {"options": {"reset_mask": np.zeros(3, bool)}}, "one true"),
        (many, {"options": {"reset_mask": [0, 1, 1]}}, "3 truth values"),
        (many, {"options": {"reset_mask": np.zeros((64, 2))}}, "3 truth values"),
        (many, {"options": {"reset_mask": [[True], [], []]}}, "3 truth values"),
        (env, {"options": {"leader.profil": 1}}, "leader.profil"),
        (env, {"options": {"leader.profile": 0.5}}, "1 whole number"),
        (env, {"options": {"leader.profile": 10**6}}, "must lie in 0…"),
        (many, {"options": {"leader.start": [1, 2]}}, "1 or 3 whole numbers"),
        *((env, {"seed": bad}, WHOLE) for bad in BAD_SEEDS[0]),
        *((many, {"seed": bad}, WHOLE) for bad in BAD_SEEDS[1]),
        *((x, {"options": bad}, words) for x in (env, many) for bad, words in BAD_OPTIONS),
    ]

    def reset(each, words) -> None:
        each.reset(seed=5)
        expected, _ = each.reset()
        each.reset(seed=5)
        try:
            each.reset(**{"seed": 9, **words})
        finally:
            np.testing.assert_array_equal(each.reset()[0], expected)

    check_refused(reset, given)


def test_an_action_that_is_none_is_refused_and_changes_nothing(env, many) -> None:
    real = "actions must be real numbers"
    no_array = (STILL + 0j, STILL > 0, STILL.astype(object), STILL.astype(str), None, {})
    no_number = (0j, [1j], True, [True], {"action": 0.0}, [None], "0", 0.1)
    given = [
        (many, np.zeros((2, 1)), r"numbers \[3, 1\], got \[2, 1\]"),
        (env, [0.1, 0.2], r"numbers \[1\], got \[2\] float64"),
        (many, STILL + np.nan, "automated.action is nan at step 1"),
        *((many, action, real) for action in (*no_array, [[0.1], [0.2, 0.3], [0.4]])),
        *((env, action, real) for action in no_number),
    ]
    env.reset(seed=0)
    many.reset(seed=0)
    check_refused(lambda each, action: each.step(action), given)
    assert np.isfinite(many.step(STILL)[0]).all()


def test_seeds_may_be_whole_numbers_of_numpy(env, many) -> None:
    for each, seed, same in ((env, 3, SEEDS[0]), (many, 3, SEEDS[0]), (many, [3, 4, 5], SEEDS)):
        expected, _ = each.reset(seed=seed)
        np.testing.assert_array_equal(each.reset(seed=same)[0], expected)


@pytest.mark.filterwarnings("ignore:.*render_mode")
def test_what_cannot_be_made_is_refused_in_one_line() -> None:
    cases = [
        (gymnasium.make, {"render_mode": "ansi"}, "rgb_array.*got 'ansi'"),
        (gymnasium.make_vec, {"render_mode": "human"}, "rgb_array.*got 'human'"),
        (gymnasium.make_vec, {"autoreset_mode": "SameStpe"}, "SameStep"),
        (gymnasium.make_vec, {"autoreset_mode": None}, "SameStep"),
        (gymnasium.make_vec, {"max_episode_steps": 10}, "scenario.horizon=10"),
    ]
    check_refused(lambda make, given: make("lcc_rl/alcc-v0", overrides=SHORT, **given), cases)


def test_an_episode_that_has_ended_takes_no_further_step(env) -> None:
    env.reset(seed=0)
    while not any(env.step(STILL[0])[2:4]):
        pass
    with pytest.raises(gymnasium.error.ResetNeeded, match="after the last"):
        env.step(STILL[0])


def ending(mode: str, steps: int):
    """Play a vector whose places end at different steps; a reset of those that ended by hand."""
    many = gymnasium.make_vec(NAME, num_envs=3, overrides=SHORT, autoreset_mode=mode)
    many.reset(seed=3)
    many.reset(options={"reset_mask": np.array([True, False, False])})
    for _ in range(5):
        many.step(STILL + 0.2)
    many.reset(seed=[None, 9, None], options={"reset_mask": np.array([False, True, False])})
    for _ in range(steps):
        results = many.step(STILL + 0.2)
        done = results[2] | results[3]
        yield many, results, done
        if mode == "Disabled" and done.any():
            yield many, (many.reset(options={"reset_mask": done})[0], *results[1:]), None


def test_every_autoreset_mode_plays_the_same_episodes() -> None:
    series = {}
    for mode, name in (("SameStep", "final_obs"), ("NextStep", ""), ("Disabled", "")):
        played = [[], [], []]
        before = np.zeros(3, bool)
        for many, (seen, rewards, *_, info), done in ending(mode, 48):
            assert many.metadata["autoreset_mode"].value == mode
            if done is None:
                continue  # begun anew by hand
            last = info.get(name, seen)
            for place in range(3):
                if mode == "NextStep" and before[place]:
                    assert rewards[place] == 0.0
                    assert not done[place]
                else:
                    played[place].append((*last[place], rewards[place]))
            before = done
        series[mode] = played
    for place in range(3):
        same = np.array(series["SameStep"][place])
        for mode in ("NextStep", "Disabled"):
            found = np.array(series[mode][place])
            np.testing.assert_array_equal(found, same[: len(found)])
        assert len(same) > len(series["NextStep"][place])


def test_gymnasiums_normaliser_of_vectors_takes_the_next_step_only() -> None:
    from gymnasium.wrappers.vector import NormalizeObservation, NormalizeReward

    for mode in ("SameStep", "NextStep", "Disabled"):
        many = gymnasium.make_vec(NAME, num_envs=3, overrides=SHORT, autoreset_mode=mode)
        NormalizeReward(many)
        if mode != "NextStep":
            with pytest.raises(ValueError, match="NEXT_STEP"):
                NormalizeObservation(many)
            continue
        scaled = NormalizeObservation(many)
        scaled.reset(seed=0)
        seen = [scaled.step(STILL)[0] for _ in range(48)]  # past two ends of episodes
        assert np.isfinite(seen).all()
        assert scaled.obs_rms.count > 3 * 48


def test_disabled_resets_are_asked_for() -> None:
    many = gymnasium.make_vec(NAME, num_envs=2, overrides=SHORT, autoreset_mode="Disabled")
    many.reset(seed=0)
    while not (results := many.step(STILL[:2]))[3].all():
        pass
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"places \[0, 1\]"):
        many.step(STILL[:2])
    assert results[3].all()


def test_a_vector_that_crashes_goes_on() -> None:
    many = gymnasium.make_vec(NAME, num_envs=3, overrides=DATA, autoreset_mode="NextStep")
    many.reset(seed=0)
    crashed = sum(many.step(STILL + 1.0)[2].sum() for _ in range(200))
    assert crashed >= 3


def test_the_first_reset_without_a_seed_is_random() -> None:
    first = [gymnasium.make(NAME, overrides=SHORT).reset()[0] for _ in range(2)]
    assert not np.array_equal(*first)


@pytest.mark.parametrize(
    ("overrides", "cars"),
    [
        (SHORT, {"automated": 1, "human": 1}),
        ([*SHORT, "scenario.string={size: 4, penetration: 0.25}"], {"automated": 1, "human": 3}),
        pytest.param(
            ["scenario=ring", "drivers=ring", "scenario.horizon=20", RING],
            {"automated": 1, "human": 21},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_pictures_show_the_road(overrides, cars) -> None:
    env = gymnasium.make(NAME, overrides=overrides, render_mode="rgb_array_list")
    env.reset(seed=0)
    for _ in range(5):
        env.step(STILL[0] + 0.5)
    pictures = np.stack(env.render())
    assert pictures.shape[0] == 6
    assert pictures.shape[3] == 3
    assert pictures.dtype == np.uint8
    assert all(size % 2 == 0 for size in pictures.shape[1:3])  # as films want it
    film = env.unwrapped.episodes.films[0]
    assert not np.array_equal(pictures[0], pictures[-1])
    for role, count in cars.items():
        colour = np.array([int(ROLE_COLOURS[role][i : i + 2], 16) for i in (1, 3, 5)])
        assert (np.abs(pictures[0].astype(int) - colour).sum(-1) < 12).sum() > 20 * count, role
    assert len(film.moments) == 6


def test_a_vector_draws_every_place(many) -> None:
    drawn = gymnasium.make_vec(NAME, num_envs=2, overrides=SHORT, render_mode="rgb_array")
    with pytest.raises(LccError, match="call reset before render"):
        drawn.render()
    drawn.reset(seed=0)
    for _ in range(22):
        drawn.step(STILL[:2])
    one, two = drawn.render()
    assert one.shape == two.shape
    assert not np.array_equal(one, two)
    assert [len(film.moments) for film in drawn.episodes.films] == [3, 3]
    assert many.render() is None


# -- stable-baselines3 -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sb3():
    pytest.importorskip("stable_baselines3", reason="extra interfaces")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of its own imports
        import stable_baselines3
    return stable_baselines3


def test_stable_baselines3_accepts_it(sb3) -> None:
    from stable_baselines3.common.env_checker import check_env as check

    env = gymnasium.make(NAME, overrides=SHORT, render_mode="rgb_array").unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(env, skip_render_check=False)


@pytest.mark.filterwarnings("ignore")
def test_stable_baselines3_learns_on_it_by_name(sb3) -> None:
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import SubprocVecEnv

    few = {"overrides": SHORT}
    for name, kind in (("lcc_rl/alcc-v0", None), (NAME, SubprocVecEnv)):
        start = {"start_method": "fork"} if kind else {}
        env = make_vec_env(name, 2, env_kwargs=few, vec_env_cls=kind, vec_env_kwargs=start)
        model = sb3.PPO("MlpPolicy", env, n_steps=20, batch_size=20, n_epochs=1, device="cpu")
        model.learn(40)
        action, _ = model.predict(env.reset())
        assert action.shape == (2, 1)
        env.close()
    assert sb3.PPO("MlpPolicy", NAME, n_steps=20, device="cpu").observation_space.shape == (7,)
    ddpg = sb3.DDPG("MlpPolicy", NAME, learning_starts=10, seed=0, device="cpu")
    ddpg.learn(20)


@pytest.mark.filterwarnings("ignore")
def test_models_of_stable_baselines3_are_compared_and_exported(sb3, tmp_path) -> None:
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    pytest.importorskip("onnxruntime", reason="extra interfaces")
    words = [
        *SHORT,
        "evaluation.warm_up=0",
        "evaluation.baselines=[]",
        "evaluation.profiles=2",
        "evaluation.drivers=2",
    ]
    for kind, more in (
        *((name, {"n_steps": 10}) for name in ("PPO", "A2C")),
        *((name, {"learning_starts": 10}) for name in ("SAC", "TD3", "DDPG")),
    ):
        env = VecNormalize(make_vec_env(NAME, 2, env_kwargs={"overrides": SHORT}), clip_obs=2.0)
        model = getattr(sb3, kind)("MlpPolicy", env, device="cpu", seed=0, **more)
        model.learn(20)
        seen = 10.0 * np.random.default_rng(0).normal(size=(50, 7)).astype(np.float32)
        action, _ = model.predict(env.normalize_obs(seen), deterministic=True)
        network = network_of(model)
        np.testing.assert_allclose(network(torch.as_tensor(seen)).detach(), action, atol=1e-5)
        if kind == "PPO":
            alone = network_of(model.load(model.save(tmp_path / "m") or tmp_path / "m"), env)
            assert torch.equal(alone(torch.as_tensor(seen)), network(torch.as_tensor(seen)))
            file = lcc_rl.export(model, tmp_path / "ppo.onnx", overrides=SHORT)
            rows = lcc_rl.compare({"model": model, "file": file}, overrides=words).rows
            energy = rows.groupby("strategy")["total_path_energy_kj"].mean()
            assert energy["model"] == pytest.approx(energy["file"], rel=1e-5)
    wide = nn.Linear(9, 1)
    cases = [
        (wide, "Linear fails for observations of 7"),
        (object(), "expected a run, a file or a controller, got"),
    ]
    check_refused(lambda who: lcc_rl.export(who, tmp_path / "x.onnx"), cases, ConfigError)
    with pytest.raises(ConfigError, match="needs a run or a policy file"):
        lcc_rl.export(model, tmp_path / "x.html")


def trained(
    sb3, kind="PPO", wrap=None, around=None, policy="MlpPolicy", seed=0, words=(), **settings
):
    """Return a model of a few steps whose weights are as large as those of a trained one."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    wrap = wrap or (lambda env: env)
    env = DummyVecEnv([lambda: wrap(gymnasium.make(NAME, overrides=[*SHORT, *words]))])
    few = {"n_steps": 20, "batch_size": 20} if kind == "PPO" else {"learning_starts": 10}
    env = around(env) if around else env
    model = getattr(sb3, kind)(policy, env, device="cpu", seed=seed, **few, **settings)
    model.learn(40)
    torch.manual_seed(1)
    for weight in model.policy.parameters():
        if weight.ndim == 2:
            torch.nn.init.normal_(weight, 0.0, 3.0 / np.sqrt(weight.shape[1]))
    return model


@pytest.mark.filterwarnings("ignore")
def test_a_model_acts_as_in_the_environment_of_its_training(sb3) -> None:
    from gymnasium.wrappers import NormalizeReward, RescaleAction
    from stable_baselines3.common.vec_env import VecNormalize

    def shares(low, high):
        return lambda env: RescaleAction(NormalizeReward(env), low, high)

    squashed = {"use_sde": True, "policy_kwargs": {"squash_output": True}}
    cases = [
        ({}, 0.0, 1.0),
        (squashed, 0.0, 1.0),
        ({"wrap": shares(-3.0, 3.0)}, 0.0, 3.0),
        ({"wrap": shares(0.0, 1.0), "around": VecNormalize}, 0.5, 0.5),
        ({"wrap": shares(0.0, 1.0), **squashed}, 0.5, 0.5),
        ({"wrap": shares(-3.0, 3.0), "kind": "SAC"}, 0.0, 3.0),
        ({"wrap": shares(-1.0, 2.0), "kind": "TD3"}, 0.5, 1.5),
    ]
    seen = 0.3 * np.random.default_rng(0).normal(size=(50, 7)).astype(np.float32)
    for settings, middle, half in cases:
        model = trained(sb3, **settings)
        norm = model.get_vec_normalize_env()
        own = norm.normalize_obs(seen) if norm else seen
        wanted = (model.predict(own, deterministic=True)[0] - middle) / half
        assert np.ptp(wanted) > 0.1
        found = network_of(model)(torch.as_tensor(seen)).detach()
        np.testing.assert_allclose(found, wanted, atol=1e-4, err_msg=str(settings))


@pytest.mark.filterwarnings("ignore")
def test_models_that_would_act_differently_are_refused(sb3, tmp_path) -> None:
    from gymnasium.wrappers import NormalizeObservation, TransformAction, TransformObservation
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.common.vec_env import SubprocVecEnv, VecFrameStack, VecNormalize

    class Remembering(ActorCriticPolicy):
        def _predict(
            self, observation, deterministic=False
        ):  # as one with an LSTM, more than layers
            return super()._predict(observation, deterministic) * 0.5

    def alone(model):
        return model.load(model.save(tmp_path / "model") or tmp_path / "model")

    box = gymnasium.spaces.Box(-1.0, 0.5, (1,), np.float32)
    bounded = trained(sb3, wrap=lambda env: TransformAction(env, lambda a: a, box))
    seen = trained(sb3, wrap=NormalizeObservation)
    shifted = trained(
        sb3, wrap=lambda env: TransformObservation(env, lambda x: x + 1, env.observation_space)
    )
    normalized = trained(sb3, around=VecNormalize)
    stacked = trained(sb3, around=lambda env: VecFrameStack(env, 4))
    closed = trained(sb3, around=lambda _: SubprocVecEnv([lambda: gymnasium.make(NAME)], "fork"))
    closed.get_env().close()
    other = sb3.PPO("MlpPolicy", "Pendulum-v1", device="cpu")
    discrete = sb3.DQN("MlpPolicy", "CartPole-v1", device="cpu", buffer_size=10)
    cannot = "PPO was trained with {}, which cannot be carried over: pass a torch module from"
    spaces = "PPO: its spaces .* are not those of this package's environment, and no wrapper"
    cases = [
        (bounded, cannot.format("TransformAction")),
        (seen, cannot.format("NormalizeObservation")),
        (shifted, cannot.format("TransformObservation")),
        (stacked, cannot.format("VecFrameStack")),
        (
            trained(sb3, around=lambda env: VecNormalize(VecNormalize(env))),
            cannot.format("wrappers"),
        ),
        (trained(sb3, policy=Remembering), "its Remembering cannot be carried over: predict"),
        (alone(bounded), spaces),
        (alone(seen), spaces),
        (alone(stacked), "fails for observations of 7 numbers"),
        (alone(normalized), r"lacks the VecNormalize of .* load it by PPO.load\(path, env="),
        (alone(trained(sb3, "SAC")), r"SAC lacks the VecNormalize .*, or the vector without one"),
        (closed, "PPO: the wrappers of its environment cannot be read; is it closed"),
        (other, cannot.format(".*PendulumEnv.*")),
        (discrete, "DQN was trained with .*CartPoleEnv"),
        (alone(discrete), "DQN: its spaces Discrete"),
    ]
    check_refused(lambda model: lcc_rl.export(model, tmp_path / "x.pt2"), cases, ConfigError)
    with pytest.raises(ConfigError, match="NormalizeObservation"):
        lcc_rl.compare({"x": seen})


@pytest.mark.filterwarnings("ignore")
def test_a_model_with_another_observation_than_its_environment_is_refused(sb3, tmp_path) -> None:
    words = ["observation.scales.self.gap=1.0"]
    model = trained(sb3, words=words)
    wrong = r"was trained with observation\.scales\.self\.gap=1\.0, which are other here: give the"
    with pytest.raises(ConfigError, match=wrong):
        lcc_rl.simulate([9.0] * 20, "automated human", model)
    with pytest.raises(ConfigError, match=wrong):
        lcc_rl.export(model, tmp_path / "x.onnx")
    assert lcc_rl.simulate([9.0] * 20, "automated human", model, overrides=words)
    assert lcc_rl.export(model, tmp_path / "x.onnx", overrides=words)
