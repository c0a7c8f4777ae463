"""TorchRL's contracts, played past the ends of episodes: alone, in series, in processes, threads.

docs/interfaces.md lists each contract with its test.
"""

from __future__ import annotations

from functools import partial

import pytest
import torch
from helpers import check_refused
from torchrl.envs import AsyncEnvPool, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.transforms import Compose, RewardSum, StepCounter, Transform
from torchrl.envs.utils import check_env_specs

import lcc_rl
from lcc_rl.envs import StringCollector
from lcc_rl.errors import ConfigError
from lcc_rl.pieces import JerkReward, SafetyReward, TimeGap
from lcc_rl.pieces.base import SEED, STEP

HORIZON = 5
WORDS = ["data.platoons=2", "data.recordings=2", f"scenario.horizon={HORIZON}"]
# From a tenth of a recorded gap, as in training, random actions may collide before the horizon.
WORDS += ["scenario.start.automated.time_gap=1.5", "training.gap_range=[1,1]"]
make = partial(lcc_rl.make_env, "alcc", (), WORDS)
PROCESSES = {"mp_start_method": "fork"}
WRAPPERS = {
    "alone": lambda: lcc_rl.make_env("alcc", 2, WORDS),
    "transformed": lambda: TransformedEnv(lcc_rl.make_env("alcc", 2, WORDS)),
    "serial": lambda: SerialEnv(2, make),
    "serial without buffers": lambda: SerialEnv(2, make, use_buffers=False),
    "parallel": lambda: ParallelEnv(2, make, **PROCESSES),
    "parallel without buffers": lambda: ParallelEnv(2, make, use_buffers=False, **PROCESSES),
    "threads": lambda: AsyncEnvPool([make, make], backend="threading"),
}


def past_the_end(env) -> None:
    counted = TransformedEnv(env, StepCounter(), auto_unwrap=False)
    played = counted.rollout(3 * HORIZON, break_when_any_done=False)
    steps = played["next", *STEP].flatten(1)
    assert steps.tolist() == 2 * [3 * [*range(1, HORIZON + 1)]]
    assert (played["next", "step_count"].flatten(1) == steps).all()
    assert len(played[SEED].unique()) == 2 * 3  # each episode is another one
    assert played["next", "reward"].isfinite().all()


def step_from_an_earlier_state(env) -> None:
    """The second step from a state equals the first, whatever was driven in between."""
    start = env.reset().clone()
    action = torch.full(env.action_spec.shape, 0.3)
    first = env.step(start.clone().set("action", action)).clone()
    for _ in range(2):
        env.step(env.step_mdp(first).set("action", -action))
    again = env.step(start.clone().set("action", action))
    for key in first["next"].keys(True, True):
        assert torch.equal(again["next"][key], first["next"][key]), key


def reset_with_a_state(env) -> None:
    reached = env.rollout(3)[:, -1]["next"].exclude("reward")
    assert not (env.reset(reached.clone(), set_state=False)[SEED] == reached[SEED]).any()
    reached["_reset"] = torch.tensor([[True], [False]])
    new = env.reset(reached.clone(), set_state=False)
    assert (new[SEED] == reached[SEED]).flatten().tolist() == [False, True]
    assert new[STEP].flatten().tolist() == [0, 3]
    state = reached.exclude("_reset")
    again = env.reset(state.clone(), set_state=True)
    for key in ("observation", ("vehicles", "gap"), ("leader", "speed"), STEP, SEED):
        assert torch.equal(again[key], state[key]), key


def options_of_a_reset(env) -> None:
    seeds = [[7], [7]] if not isinstance(env, (SerialEnv, ParallelEnv)) else [7]
    first = env.reset(options={"episode.seed": torch.tensor(seeds)})
    assert first[SEED].flatten().tolist() == [7, 7]


PLAYS = (past_the_end, step_from_an_earlier_state, reset_with_a_state, options_of_a_reset)
# TorchRL 0.14's AsyncEnvPool passes a state and options of resets to no environment.
THREADS = (past_the_end, step_from_an_earlier_state)


@pytest.mark.filterwarnings("error::FutureWarning", "ignore:.*fork:DeprecationWarning")
def test_each_contract_in_each_wrapper(subtests) -> None:
    for name, wrap in WRAPPERS.items():
        env = wrap()
        if name != "threads":  # whose specs TorchRL does not check
            check_env_specs(env)
        for play in THREADS if name == "threads" else PLAYS[::-1]:
            with subtests.test(name=name, play=play.__name__):
                play(env)
        env.close(raise_if_closed=False)


def test_a_part_of_a_state_is_refused() -> None:
    env = WRAPPERS["alone"]()
    state = env.reset()
    for given, how in (
        (state.select(SEED), {}),
        (state.exclude(("vehicles", "gap")), {"set_state": True}),
        (state.select(), {"set_state": True}),
    ):
        with pytest.raises(ConfigError, match=r"whole state .* lacks .*vehicles\.gap.*options=…"):
            env.reset(given, **how)


def test_several_automated_vehicles_are_a_group_of_agents(subtests) -> None:
    """As in PettingZooWrapper: the dimension of agents, and ends at the shape of the reward."""
    words = [*WORDS, "scenario.string='automated human automated human'"]
    several = partial(lcc_rl.make_env, "alcc", (), words)
    wrappers = {
        "alone": lambda: lcc_rl.make_env("alcc", 2, words),
        "serial": lambda: SerialEnv(2, several),
        "parallel": lambda: ParallelEnv(2, several, **PROCESSES),
        "parallel without buffers": lambda: ParallelEnv(2, several, use_buffers=False, **PROCESSES),
        "threads": lambda: AsyncEnvPool([several, several], backend="threading"),
    }
    for name, wrap in wrappers.items():
        env = wrap()
        with subtests.test(name=name):
            if name != "threads":  # whose specs TorchRL does not check
                check_env_specs(env)
            counted = TransformedEnv(env, Compose(RewardSum(), StepCounter()), auto_unwrap=False)
            after = counted.rollout(2 * HORIZON, break_when_any_done=False)["next"]
            group, ends = after["automated"], ("done", "terminated", "truncated")
            assert group.batch_size == group["reward_terms"].batch_size == (2, 2 * HORIZON, 2)
            assert group["reward"].shape == group["done"].shape == (2, 2 * HORIZON, 2, 1)
            assert group["done"].any()
            for end in ends:
                assert (group[end] == after[end].unsqueeze(-2)).all()
            total = group["reward"][:, :HORIZON].sum(1)
            torch.testing.assert_close(group["episode_reward"][:, HORIZON - 1], total)
        env.close(raise_if_closed=False)
    for keys in (None, [("next", "automated", "reward"), ("next", "done")]):
        collector = StringCollector(wrappers["alone"](), None, frames_per_batch=4, keys=keys)
        group = next(iter(collector))["next", "automated"]
        assert group.batch_size == (2, 2, 2)
        assert group["done"].shape == group["reward"].shape


# -- what users change in an environment -----------------------------------------------------------


class Doubled(Transform):
    """A reward without its last dimension, as transforms of others may write."""

    def _call(self, next_tensordict):
        reward = next_tensordict.get("reward", None)
        return next_tensordict if reward is None else next_tensordict.set("reward", reward[..., 0])


def test_rewards_of_other_transforms_keep_their_shape() -> None:
    env = WRAPPERS["alone"]()
    env.append_transform(Doubled())
    assert env.rollout(3)["next", "reward"].shape == (2, 3, 1)


def test_the_total_counts_the_terms_that_there_are() -> None:
    env = lcc_rl.make_env("alcc", 2, WORDS, single=False)
    count = len(env.transform)
    env.transform.insert(count - 3, JerkReward(weight=1.0))
    terms = ("automated", "reward_terms")
    for _ in range(2):
        after = env.rand_step()["next"]
        total = sum(after[terms].values())
        torch.testing.assert_close(after["automated", "reward"], total)
        names = [getattr(piece, "name", "") for piece in env.transform]
        if "jerk" in names:
            assert "jerk" in after[terms].keys()  # noqa: SIM118  a TensorDict is no dict
            env.transform.pop(names.index("jerk"))
    assert len(env.transform) == count


def test_the_total_counts_the_terms_that_are_left_or_replaced() -> None:
    terms = ("automated", "reward_terms")
    for change, names in (
        (lambda chain, at: chain.__delitem__(at), {"efficiency"}),
        (lambda chain, at: chain.__delitem__(slice(at, at + 1)), {"efficiency"}),
        (lambda chain, at: chain.__setitem__(at, JerkReward(weight=1.0)), {"efficiency", "jerk"}),
        (lambda chain, at: chain.__setitem__(at, TimeGap()), {"efficiency"}),
    ):
        env = lcc_rl.make_env("alcc", 2, WORDS, single=False)
        kinds = [type(piece) for piece in env.transform]
        before = set(env.rand_step()["next", terms].keys())
        change(env.transform, kinds.index(SafetyReward))
        after = env.rand_step()["next"]
        assert set(after[terms].keys()) == before - {"safety"} | names
        torch.testing.assert_close(after["automated", "reward"], sum(after[terms].values()))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # the compiler's own
def test_what_cannot_be_changed_is_refused() -> None:
    env = lcc_rl.make_env("alcc", 2, WORDS, single=False)
    compiled = lcc_rl.make_env("alcc", 2, WORDS, single=False).compile()
    late = lcc_rl.make_env("alcc", 2, WORDS, single=False)
    places = [type(piece).__name__ for piece in late.transform]
    late.transform.pop(places.index("TimeGap"))
    late.transform.append(TimeGap())
    gone = lcc_rl.make_env("alcc", 2, WORDS, single=False)
    gone.transform.pop(places.index("StringMotion"))
    safety = next(piece for piece in compiled.transform if isinstance(piece, SafetyReward))
    cases = [
        (env.double, "call torch.set_default_dtype before"),
        (env.half, "call torch.set_default_dtype before"),
        (lambda: setattr(safety, "weight", 2.0), r"weight cannot change after env\.compile"),
        (late.rand_step, r"EfficiencyReward reads .*time_gap.*, which no piece before it writes"),
        (gone.reset, r"reads .*vehicles\.\w+.*, which nothing has written"),
    ]
    check_refused(lambda change: change(), cases, ConfigError)
