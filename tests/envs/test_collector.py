"""StringCollector: a TorchRL collector whose transitions are those of TorchRL's own."""

from __future__ import annotations

import pytest
import torch
from helpers import TERMS, compose, make_agent, single_env, small_env, string
from tensordict.nn import TensorDictSequential
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs.transforms import RewardSum

from lcc_rl.agents.replay import LEARNED_FROM
from lcc_rl.envs import StringCollector
from lcc_rl.errors import ConfigError
from lcc_rl.policies import GaussianExploration, shared_policy

KEYS = (*LEARNED_FROM, ("next", *TERMS), ("vehicles", "gap"))
# Half the horizon ahead is far enough to run into the leader, so that episodes end early, too.
CRASHING = ("scenario.horizon=100", "training.gap_range=[0.1,0.5]")
MIXED = "(automated human)*2"


def policy(single: bool = False):
    agent = make_agent(compose("alcc"))
    with torch.no_grad():
        agent.policy.module[0][-1].bias.fill_(0.5)  # speeds up into the leader
    if single:
        return TensorDictSequential(agent.policy, GaussianExploration(0.3, "action"))
    return TensorDictSequential(shared_policy(agent.policy), GaussianExploration(0.3))


def environment(view: str, batch: int = 8):
    if view == "single":
        return single_env("alcc", batch, CRASHING)
    return small_env("alcc", batch, [*CRASHING, *([string(MIXED)] if view == "two" else [])])


@pytest.mark.parametrize("view", ["single", "one", "two"])
def test_transitions_are_those_of_torchrls_collector(view) -> None:
    acting, frames = policy(view == "single"), 8 * 40
    theirs = Collector(
        environment(view),
        acting,
        frames_per_batch=frames,
        total_frames=3 * frames,
        auto_register_policy_transforms=False,
    )
    ours = StringCollector(
        environment(view), acting, frames_per_batch=frames, total_frames=3 * frames
    )
    assert isinstance(ours, BaseCollector)
    seen = 0
    for wanted, batch in zip(theirs, ours, strict=True):
        assert batch.shape == (8, 40)
        # All entries but those of the collector itself.
        assert set(wanted.exclude("collector").keys(True, True)) == set(batch.keys(True, True))
        for key in batch.keys(True, True):
            assert torch.equal(batch[key], wanted[key]), key
        seen += batch.numel()
        over = wanted["next", "terminated"].any()
    assert over
    assert seen == 3 * frames
    theirs.shutdown()
    ours.shutdown()


def test_an_environment_may_be_made_by_a_function_and_its_state_restored() -> None:
    def segments(collector):
        return next(iter(collector))["vehicles", "speed"]

    one = StringCollector(lambda: small_env("alcc", 4), policy(), frames_per_batch=40)
    segments(one)
    state = one.state_dict()
    expected = segments(one)
    two = StringCollector(lambda: small_env("alcc", 4), policy(), frames_per_batch=40)
    two.load_state_dict(state)
    assert torch.equal(segments(two), expected)


def test_holds_what_is_asked_for() -> None:
    segment = first(small_env("alcc", 2), frames_per_batch=10)
    assert ("vehicles", "gap") in segment.keys(True)
    assert ("vehicles", "speed") not in segment.keys(True)
    assert "human" not in segment


def first(env, **settings):
    return next(iter(StringCollector(env, policy(), keys=KEYS, **settings)))


@pytest.mark.parametrize("frames", [0, 3, -2])
def test_frames_are_whole_steps_of_all_episodes(frames) -> None:
    with pytest.raises(ConfigError, match="must be a multiple of the 2 episodes"):
        first(small_env("alcc", 2), frames_per_batch=frames)


def test_a_transform_that_it_would_not_apply_is_refused() -> None:
    key = ("automated", "reward")
    env = small_env("alcc", 2).append_transform(RewardSum([key], [("automated", "episode_reward")]))
    with pytest.raises(ConfigError, match="RewardSum, which StringCollector does not apply"):
        first(env, frames_per_batch=2)


def test_without_a_compiler_one_line_and_the_plain_step(monkeypatch, caplog) -> None:
    from torch._inductor.exc import InductorError

    def broken(function, **settings):
        def fail(state):
            raise InductorError(RuntimeError("no C++ compiler"), None)

        return fail

    expected = first(small_env("alcc", 2), frames_per_batch=10)
    monkeypatch.setattr("lcc_rl.envs.compiled.compile", broken)
    caplog.set_level("INFO", "lcc_rl")
    segment = first(small_env("alcc", 2), frames_per_batch=10, compiled=True)
    assert torch.equal(
        segment["next", "automated", "reward"], expected["next", "automated", "reward"]
    )
    assert ["not compiling" in line for line in caplog.messages] == [True]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the compiler's own making
def test_compiled_agrees_and_repeats_itself() -> None:
    env = ["scenario.horizon=100"]
    plain = first(small_env("alcc", 8, env), frames_per_batch=800)
    one, two = (
        first(small_env("alcc", 8, env), frames_per_batch=800, compiled=True) for _ in range(2)
    )
    for key in plain.keys(True, True):
        torch.testing.assert_close(one[key], plain[key], rtol=1e-4, atol=1e-4)
        assert torch.equal(one[key], two[key]), key
