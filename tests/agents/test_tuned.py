"""Tuning by search: deterministic, resumable, and it finds better constants."""

from __future__ import annotations

import pandas as pd
import pytest
import torch
from helpers import POPULATION, compose, make_agent, wavy_profiles

from lcc_rl.agents.agent import derived_seed
from lcc_rl.agents.tuned import SearchLoop
from lcc_rl.config import identity
from lcc_rl.envs import build_env

pytest.importorskip("cmaes")
SMALL = ("agent=tuned", "agent.candidates=4", "training.environments=8", "training.episodes=96")


def make(folder, *overrides: str) -> SearchLoop:
    cfg = compose("alcc", *SMALL, "training.segment=${scenario.horizon}", *overrides)
    env = build_env(cfg, wavy_profiles(), POPULATION, cfg.training.environments)
    return SearchLoop(make_agent(cfg), env, cfg.training, cfg.seed, folder, identity(cfg))


def constants(loop: SearchLoop) -> torch.Tensor:
    return torch.cat([entry.detach().flatten() for entry in loop.agent.policy.parameters()])


def test_resuming_equals_never_having_stopped(tmp_path) -> None:
    whole = make(tmp_path / "whole")
    expected = whole.run()
    stopped = make(tmp_path / "parts")
    stopped.iterations = 6  # in the middle of a generation
    stopped.run()
    resumed = make(tmp_path / "parts")
    resumed.load()
    pd.testing.assert_frame_equal(resumed.run(), expected, check_exact=True)
    assert torch.equal(constants(resumed), constants(whole))


def test_candidates_of_a_generation_drive_the_same_episodes(tmp_path) -> None:
    loop = make(tmp_path, "agent.sigma=1e-6")
    rows = loop.run()
    costs = rows["cost"].to_numpy().reshape(-1, 4)
    # The same weights, but for a millionth, cost the same on the same episodes.
    assert abs(costs / costs[:, :1] - 1.0).max() < 1e-3
    assert abs(costs[0, 0] / costs[1, 0] - 1.0) > 1e-3
    assert rows["price_efficiency"].nunique() > 1
    assert (rows["price_efficiency"].to_numpy().reshape(-1, 4).std(1) == 0.0).all()


@pytest.mark.slow
def test_it_finds_better_constants(tmp_path) -> None:
    # From a driver who keeps far too great a distance.
    loop = make(tmp_path, "agent.constants={time_gap: 4.0}", "training.episodes=640")

    def cost() -> float:
        loop.env.set_seed(derived_seed(0, "test"))
        source = loop._source()
        with torch.no_grad():
            network = loop.agent.policy.module
            _, record = source.play(source.start(), network, loop.horizon)
            return -float(loop.objective.score(source.assemble(record)).sum(1).mean())

    before = cost()
    loop.run()
    loop.objective.limits.logarithms = dict.fromkeys(loop.objective.limits.logarithms, 0.0)
    assert cost() < 0.9 * before
