"""PPO, and the learner that a page shows: deterministic, and resumable bit for bit."""

from __future__ import annotations

import sys
from types import ModuleType

import pytest
from helpers import (
    check_resuming,
    small_env,
    small_loop,
)
from page_blocks import ROOT, blocks
from tensordict import TensorDict

from lcc_rl.agents import PPO, TrainingLoop
from lcc_rl.agents.agent import Scene

SMALL = (
    *("training.episodes=16", "training.environments=4", "training.checkpoint_every=2"),
    *("training.segment=10", "agent.hidden=[16,16]"),
)
AGENTS = {
    "ppo": ("agent=ppo", "agent.batch_size=16", "agent.epochs=2", "agent.entropy=0.01"),
    "own": ("agent._target_=my_learner.Reinforce",),
}
EACH = pytest.mark.parametrize("agent", AGENTS)


@pytest.fixture(autouse=True)
def my_learner(monkeypatch) -> None:
    """The module that docs/extend.md tells to write."""
    page = (block.text for block in blocks(ROOT / "docs" / "extend.md"))
    (text,) = (text for text in page if text.startswith("# my_learner.py"))
    module = ModuleType("my_learner")
    monkeypatch.setitem(sys.modules, "my_learner", module)
    exec(text, vars(module))


def make(folder, agent: str, *overrides: str) -> TrainingLoop:
    return small_loop(folder, *AGENTS[agent], *SMALL, *overrides)


@EACH
def test_resuming_equals_never_having_stopped(tmp_path, agent) -> None:
    check_resuming(lambda place: make(place, agent), tmp_path)


def test_every_vehicle_is_a_trajectory_of_its_own(tmp_path, monkeypatch) -> None:
    seen, update = [], PPO.update

    def seeing(self, data):
        seen.append(data.clone())
        return update(self, data)

    monkeypatch.setattr(PPO, "update", seeing)
    loop = make(tmp_path, "ppo", "scenario.string='automated human automated human'")
    loop.run()
    data = seen[0]
    assert data.batch_size == (8, 10)  # 4 environments × 2 vehicles, 10 steps
    running = ~data["next", "done"][:, :-1]
    same = (data["next", "observation"][:, :-1] == data["observation"][:, 1:]).all(-1, keepdim=True)
    assert same[running].all()


def test_the_clipped_ratio_is_of_the_policy_that_played() -> None:
    """Before the first step the ratio is 1: the objective is the mean of normalised advantages."""
    env = small_env("alcc", 4)
    agent = PPO(epochs=1, batch_size=10_000, learning_rate=1e-9).start(Scene(7))
    data = env.rollout(20, break_when_any_done=False)
    rows = {
        "observation": data["automated", "observation"][:, :, 0],
        "action": data["automated", "action"][:, :, 0].clamp(-0.9, 0.9),
    }

    after = {
        "observation": data["next", "automated", "observation"][:, :, 0],
        "reward": data["next", "automated", "reward"][:, :, 0],
        "done": data["next", "done"],
        "terminated": data["next", "terminated"],
    }
    losses = agent.update(TensorDict({**rows, "next": after}, [4, 20]))
    assert losses["loss_actor"].abs() < 1e-5
    assert losses["sigma"] == pytest.approx(0.5, rel=1e-4)
