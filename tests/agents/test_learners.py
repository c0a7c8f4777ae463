"""PPO, and the learner that a page shows: deterministic, and resumable bit for bit."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any
from zlib import crc32

import pytest
import torch
from helpers import SMALL, check_refused, check_resuming, slow_but, small_env, small_loop, weights
from page_blocks import ROOT
from tensordict import TensorDict
from torch import nn

from lcc_rl.agents import PPO, TrainingLoop, derived_seed, shared_policy
from lcc_rl.agents.agent import Scene
from lcc_rl.errors import ConfigError, ResultsError

AGENTS = {
    "ppo": ("agent=ppo", "agent.batch_size=16", "agent.epochs=2", "agent.entropy=0.01"),
    "own": ("agent._target_=my_learner.Reinforce",),
}
EACH = pytest.mark.parametrize("agent", AGENTS)


@pytest.fixture(autouse=True)
def my_learner(monkeypatch) -> Any:
    """The learner of docs/recipes."""
    text = (ROOT / "docs" / "recipes" / "my_learner.py").read_text()
    module = ModuleType("my_learner")
    monkeypatch.setitem(sys.modules, "my_learner", module)
    module.text = text
    exec(text, vars(module))
    return module


def make(folder, agent: str, *overrides: str) -> TrainingLoop:
    return small_loop(folder, *AGENTS[agent], *SMALL, *overrides)


@EACH
def test_resuming_equals_never_having_stopped(tmp_path, agent) -> None:
    check_resuming(lambda place: make(place, agent), tmp_path)


def test_a_loop_of_ones_own_plays_by_itself(tmp_path, my_learner) -> None:
    class Search(TrainingLoop):  # a random search
        def source(self) -> Any:
            return shared_policy(self.agent.policy)

        def iterate(self, policy: Any) -> dict[str, float]:
            drawn = torch.Generator().manual_seed(derived_seed(self.seed, self.iteration))
            for weight in policy.parameters():
                weight.data += torch.randn(weight.shape, generator=drawn)
            self.env.set_seed(derived_seed(self.seed, self.iteration, "episodes"))
            played = self.env.rollout(self.horizon, policy, break_when_any_done=False)
            return self.record([played], [{"loss_value": 0.0}], (0.0, 0.0), played.numel(), {})

    my_learner.Reinforce.loop = Search
    check_resuming(lambda place: make(place, "own"), tmp_path)


@pytest.mark.parametrize(("hold", "decisions"), [(0.0, 10), (0.5, 2)])
def test_every_vehicle_is_a_trajectory_of_its_own(tmp_path, monkeypatch, hold, decisions) -> None:
    seen, update = [], PPO.update

    def seeing(self, data):
        seen.append(data.clone())
        return update(self, data)

    monkeypatch.setattr(PPO, "update", seeing)
    string = "scenario.string='automated human automated human'"
    loop = make(tmp_path, "ppo", string, f"agent.hold={hold}", "training.episodes=4")
    loop.run()
    data = seen[0]
    assert data.batch_size == (8, decisions)  # 4 environments × 2 vehicles
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


# What a learner of one's own has wrong, as what replaces what on the page, and the error.
STATE = "    def state_dict(self):\n        return {'best': 1.0}\n\n"
RATE = "    def anneal(self, share):\n        self.rate = share\n\n"
NOTHING = "    def state_dict(self):\n        pass\n\n"
MADE = "agent.policy = make_actor(batch['automated', 'observation'].shape[-1], 1, [8], 0)"
WRONG = [
    ("self.noise = GaussianExploration", "self.sound = abs", "must make noise, the exploration"),
    ("loop = ReinforceLoop", "loop = dict", "loop must be a class derived .* got <class 'dict'>"),
    ("lr=self.learning_rate)", "lr=1.0); self.policy = len", "policy must be .* got builtin"),
    ('"loss_value": returns', '"loss": returns', "must return numbers .* 'loss_value' among them"),
    ("(Agent)", "(Settings)", "expected a subclass of .*Agent, got my_learner.Reinforce"),
    ("    def setup(", f"{STATE}    def setup(", "lacks the policy's weight .*extend super"),
    ("    def setup(", f"{RATE}    def setup(", "learning_rate is None; .*anneal the policy's"),
    ("    def setup(", f"{NOTHING}    def setup(", "state_dict returns NoneType, expected a dict"),
    (
        "observation_size, 1,",
        "observation_size, 2,",
        r"policy fails .* \[2, 1, torch.float32\], got \[2, 2",
    ),
    ("self.noise =", "self.policy.double(); self.noise =", "policy fails for observations of 7"),
    ("loss.item()", "log_prob", "loss_actor is tensor.*; learn returns numbers by name"),
    ('"loss_actor"', '"episode_reward"', "learn returns episode_reward, a column of the record"),
    ('"loss_actor"', 'f"loss_{before}"', "learn must return the same names after every segment"),
    ("self.updates += 1", MADE, "the training replaced agent.policy: change its weights in place"),
]


def test_a_state_that_is_not_restored_is_refused(tmp_path, my_learner) -> None:
    lost = "    def load_state_dict(self, state):\n        pass\n\n    def setup("
    exec(my_learner.text.replace("    def setup(", lost), vars(my_learner))
    other = f"seed={crc32(lost.encode())}"
    small_loop(tmp_path, *AGENTS["own"], *SMALL, other).run()
    with pytest.raises(ResultsError, match="load_state_dict does not restore policy"):
        small_loop(tmp_path, *AGENTS["own"], *SMALL, other).load()


def test_what_a_learner_of_ones_own_lacks_is_one_line(tmp_path, my_learner) -> None:
    def run(old: str, new: str) -> None:
        text = my_learner.text.replace(old, new)
        assert text != my_learner.text
        exec(f"from lcc_rl.settings import Settings\n{text}", vars(my_learner))
        other = f"seed={crc32(new.encode())}"  # composed anew: the class is another one
        small_loop(tmp_path, *AGENTS["own"], *SMALL, other).run()

    check_refused(run, WRONG, ConfigError)


@pytest.mark.parametrize(
    "agent", slow_but(["sac", "ppo", "analytic"], ["ddpg", "td3", "sac", "ppo", "analytic"])
)
def test_activation_schedule_and_clipping_are_settings_of_every_learner(tmp_path, agent) -> None:
    words = (f"agent={agent}", *SMALL, "agent.final_lr_fraction=0.2", "agent.clip_norm=1e-12")
    words += ("agent.activation=tanh", "agent.schedule=linear", "agent.policy=network")
    if agent in ("ddpg", "td3", "sac"):
        words += ("agent.batch_size=16", "agent.saturation=0")
    loop = small_loop(tmp_path, *words)
    kinds = [type(layer) for layer in loop.agent.policy.modules()]
    assert kinds.count(nn.Tanh) == 3
    assert nn.ReLU not in kinds
    before = weights(loop)
    rates = loop.run()["learning_rate"]
    assert rates.tolist() == pytest.approx([rates[0] * x for x in (1.0, 0.8, 0.6, 0.4)])
    moved = (weights(loop) - before).abs().max()
    assert 0.0 < moved < 0.2 * rates[0]  # Adam steps by the whole rate unless gradients vanish
