"""Segments: the transitions of TorchRL's collector, without its bookkeeping."""

from __future__ import annotations

import pytest
import torch
from helpers import POPULATION, compose, small_env
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector

from lcc_rl.agents.training import LEARNED_FROM
from lcc_rl.envs.factory import build_agent
from lcc_rl.envs.stepping import Segments
from lcc_rl.policies import GaussianExploration

KEYS = (*LEARNED_FROM, ("next", "reward_terms"), ("cav", "gap"))
# Half the horizon ahead is far enough to run into the leader, so that episodes end early, too.
CRASHING = ("scenario.horizon=100", "scenario.pieces.cav.initial_gap_range=[0.1,0.5]")


def policy():
    agent = build_agent(compose("alcc"), POPULATION)
    with torch.no_grad():
        agent.policy.module[0][-1].bias.fill_(0.5)  # speeds up into the leader
    return TensorDictSequential(agent.policy, GaussianExploration(0.3))


def test_transitions_are_those_of_the_collector() -> None:
    acting, steps = policy(), 50
    theirs = Collector(
        small_env("alcc", 8, CRASHING),
        acting,
        frames_per_batch=8 * steps,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )
    ours = Segments(small_env("alcc", 8, CRASHING), acting, steps, KEYS)
    for wanted, segment, _ in zip(theirs, ours, range(3), strict=False):
        assert segment.shape == (8, steps)
        for key in segment.keys(True, True):
            assert torch.equal(segment[key], wanted[key]), key
    assert wanted["next", "terminated"].any()
    assert set(segment["next", "reward_terms"].keys()) == set(wanted["next", "reward_terms"].keys())


def test_holds_what_is_asked_for() -> None:
    segment = next(Segments(small_env("alcc", 2), policy(), 5, KEYS))
    assert ("cav", "gap") in segment.keys(True)
    assert ("cav", "speed") not in segment.keys(True)
    assert "hdv" not in segment


def test_without_a_compiler_one_line_and_the_plain_step(monkeypatch, caplog) -> None:
    from torch._inductor.exc import InductorError

    def broken(function, **settings):
        def fail(state):
            raise InductorError(RuntimeError("no C++ compiler"), None)

        return fail

    expected = next(Segments(small_env("alcc", 2), policy(), 5, KEYS))
    monkeypatch.setattr(torch, "compile", broken)
    caplog.set_level("INFO", "lcc_rl")
    segment = next(Segments(small_env("alcc", 2), policy(), 5, KEYS, compiled=True))
    assert torch.equal(segment["next", "reward"], expected["next", "reward"])
    assert ["not compiling" in line for line in caplog.messages] == [True]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the compiler's own making
def test_compiled_agrees_and_repeats_itself() -> None:
    acting, steps = policy(), 100
    plain = next(Segments(small_env("alcc", 8, ["scenario.horizon=100"]), acting, steps, KEYS))
    first, second = (
        next(Segments(small_env("alcc", 8, ["scenario.horizon=100"]), acting, steps, KEYS, True))
        for _ in range(2)
    )
    for key in plain.keys(True, True):
        torch.testing.assert_close(first[key], plain[key], rtol=1e-4, atol=1e-4)
        assert torch.equal(first[key], second[key]), key
