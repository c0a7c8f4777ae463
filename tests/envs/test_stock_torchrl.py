"""Stock TorchRL scripts, unchanged but for the environment, as its tutorials have them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import pytest
import torch
from commands import DATA
from helpers import single_env
from page_blocks import ROOT
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import Actor, AdditiveGaussianModule, ValueOperator
from torchrl.objectives import DDPGLoss, SoftUpdate, ValueEstimators

import lcc_rl
from lcc_rl.evaluation.foreign import as_given

FRAMES, ITERATIONS = 80, 3


def mlp(inputs: int, outputs: int, *more: nn.Module) -> nn.Module:
    return nn.Sequential(nn.Linear(inputs, 32), nn.Tanh(), nn.Linear(32, outputs), *more)


def vector(module: nn.Module) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in module.parameters()])


def step(loss: nn.Module, batch, optimizer) -> float:
    losses = loss(batch)
    total = sum(value for key, value in losses.items() if key.startswith("loss_"))
    optimizer.zero_grad()
    total.backward()
    optimizer.step()
    return float(total.detach())


def test_single_agent_ddpg() -> None:
    env = single_env("alcc", 4)
    size = env.observation_spec["observation"].shape[-1]
    network, spec = mlp(size, 1, nn.Tanh()), env.action_spec_unbatched
    actor = Actor(network, spec=spec, in_keys=["observation"], safe=True)

    class Joined(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.network = mlp(size + 1, 1)

        def forward(self, observation, action):
            return self.network(torch.cat([observation, action], -1))

    value = ValueOperator(Joined(), in_keys=["observation", "action"])
    noise = AdditiveGaussianModule(env.action_spec, sigma_init=0.3, sigma_end=0.3)
    loss = DDPGLoss(actor, value, delay_actor=True, delay_value=True)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
    targets = SoftUpdate(loss, eps=0.9)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    buffer = ReplayBuffer(storage=LazyTensorStorage(1000), batch_size=32)
    before, losses = vector(actor), []
    collector = Collector(
        env,
        TensorDictSequential(actor, noise),
        frames_per_batch=FRAMES,
        total_frames=ITERATIONS * FRAMES,
        auto_register_policy_transforms=True,
    )
    for data in collector:
        buffer.extend(data.reshape(-1))
        for _ in range(4):
            losses.append(step(loss, buffer.sample(), optimizer))
            targets.step()
    collector.shutdown()
    assert len(buffer) == ITERATIONS * FRAMES
    assert len(losses) == 4 * ITERATIONS
    assert torch.tensor(losses).isfinite().all()
    assert not torch.equal(vector(actor), before)


# -- docs/recipes ----------------------------------------------------------------------------------

FOLDER = ROOT / "docs" / "recipes"
RECIPES = {name: f"{name}.py" for name in ("ppo", "recurrent", "frames", "mappo")}
RECIPES |= {"ippo": "mappo.py"}
SMALL = {"19200": str(FRAMES), "768000": str(ITERATIONS * FRAMES), '1.2]"]': f'1.2]", *{DATA}]'}


def run_recipe(monkeypatch, kind: str, changes: dict[str, str]) -> dict[str, Any]:
    """Run the program of a recipe, changed; what it compares is left as ``compared``."""

    def changed(text: str) -> str:
        for much, little in changes.items():
            text = text.replace(much, little)
        return text

    shared = ModuleType("my_ppo")
    exec(changed((FOLDER / "my_ppo.py").read_text()), vars(shared))
    monkeypatch.setitem(sys.modules, "my_ppo", shared)
    text = (FOLDER / RECIPES[kind]).read_text()
    text = text.replace("centralised = True", f"centralised = {kind != 'ippo'}")
    space: dict[str, Any] = {}

    def compared(policies: dict[str, Any], overrides: Sequence[str] = ()) -> None:
        space.update(compared=policies, overrides=list(overrides))

    monkeypatch.setattr(lcc_rl, "compare", compared)
    exec(changed(text), space)
    monkeypatch.undo()
    return space


@pytest.mark.filterwarnings("error:The env passed to:FutureWarning")
@pytest.mark.parametrize("kind", RECIPES)
def test_the_recipes_of_the_page_learn(monkeypatch, kind) -> None:
    space = run_recipe(monkeypatch, kind, {**SMALL, "batch_size=64": "batch_size=4"})
    if kind in ("mappo", "ippo"):
        assert space["env"].group_map == {"automated": ["automated_0", "automated_1"]}
    rewards = space.get("rewards") or [0.0] * ITERATIONS
    assert len(rewards) == ITERATIONS
    assert torch.tensor(rewards).isfinite().all()
    ((name, policy),) = space["compared"].items()
    mixed = [word for word in space["overrides"] if "string" in word]
    env = lcc_rl.make_env("alcc", 1, [*DATA, *mixed], single=False)
    as_given(policy, name).tried(env.reset())
    for weight in policy.parameters():
        assert weight.isfinite().all()
        assert weight.grad is None or weight.grad.abs().sum() > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", RECIPES)
def test_the_recipes_of_the_page_drive(monkeypatch, kind) -> None:
    """Judged by speed, distance and energy: a policy that stands still has a fair reward, too."""
    space = run_recipe(monkeypatch, kind, {"768000": str(20 * 19200)})
    words = [*space["overrides"], "evaluation.drivers=12", "evaluation.baselines=[human]"]
    rows = lcc_rl.compare(space["compared"], overrides=words).rows
    own, human = rows[rows["strategy"] != "human"], rows[rows["strategy"] == "human"]
    assert own["mean_speed_mps"].mean() > 0.8 * human["mean_speed_mps"].mean()
    assert own["cav_distance_m"].mean() > 0.8 * human["cav_distance_m"].mean()
    assert own["collided"].mean() < 0.02
    energy = [part["total_path_energy_kj"].mean() for part in (own, human)]
    assert energy[0] < 2.5 * energy[1]


@pytest.mark.slow
def test_two_workers_train_as_the_page_says(tmp_path) -> None:
    small = {**SMALL, 'alcc", 32': 'alcc", 4'}
    for name in ("my_ppo", "two_workers"):
        text = (FOLDER / f"{name}.py").read_text()
        for much, little in small.items():
            text = text.replace(much, little)
        text = text.replace('"evaluation.drivers=24"', repr([*DATA, "experiment=smoke"])[1:-1])
        (tmp_path / f"{name}.py").write_text(text)
    words = [sys.executable, "two_workers.py"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "PPO, two workers" in done.stdout
