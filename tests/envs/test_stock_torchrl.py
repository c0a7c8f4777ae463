"""Stock TorchRL scripts, unchanged but for the environment, as its tutorials have them."""

from __future__ import annotations

import re

import pytest
import torch
from commands import DATA
from helpers import single_env
from page_blocks import ROOT, blocks
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import Actor, AdditiveGaussianModule, ValueOperator
from torchrl.objectives import DDPGLoss, SoftUpdate, ValueEstimators

FRAMES, ITERATIONS = 80, 3


@pytest.fixture(autouse=True)
def _seeded():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


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


@pytest.mark.filterwarnings("error:The env passed to:FutureWarning")
@pytest.mark.parametrize("kind", ["ppo", "mappo", "ippo"])
def test_the_examples_of_the_page_learn(kind) -> None:
    several = kind != "ppo"
    page = [block.text for block in blocks(ROOT / "docs" / "interfaces.md")]
    (text,) = (x for x in page if "ClipPPOLoss" in x and ("MultiAgentMLP" in x) == several)
    small = {"19200": str(FRAMES), "192000": str(ITERATIONS * FRAMES)}
    if several:
        small |= {"[mixed]": "[mixed, *DATA]", "batch_size=64": "batch_size=4"}
        small |= {"centralised = True": f"centralised = {kind == 'mappo'}"}
    else:
        small |= {"batch_size=64": "batch_size=4, overrides=DATA"}
    for much, little in small.items():
        assert much in text
        text = re.sub(rf"{re.escape(much)}\b" if much.isdigit() else re.escape(much), little, text)
    space = {"DATA": DATA}
    exec(text, space)
    if several:
        assert space["env"].group_map == {"automated": ["automated_0", "automated_1"]}
    assert len(space["rewards"]) == ITERATIONS
    assert torch.tensor(space["rewards"]).isfinite().all()
    for state in space["optimizer"].state.values():  # of every weight of both networks
        assert torch.isfinite(state["exp_avg"]).all()
        assert state["exp_avg"].abs().sum() > 0.0
