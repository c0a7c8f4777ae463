"""Stock TorchRL scripts, unchanged but for the environment, as its tutorials have them."""

from __future__ import annotations

import re

import pytest
import torch
from commands import DATA
from helpers import single_env
from pages import ROOT, blocks
from tensordict.nn import InteractionType, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import (
    Actor,
    AdditiveGaussianModule,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import ClipPPOLoss, DDPGLoss, SoftUpdate, ValueEstimators
from torchrl.objectives.value import GAE

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


def test_single_agent_ppo() -> None:
    env = single_env("alcc", 4)
    size = env.observation_spec["observation"].shape[-1]
    network = TensorDictModule(
        nn.Sequential(mlp(size, 2), NormalParamExtractor()), ["observation"], ["loc", "scale"]
    )
    actor = ProbabilisticActor(
        network,
        spec=env.action_spec,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0},
        default_interaction_type=InteractionType.RANDOM,
        return_log_prob=True,
    )
    value = ValueOperator(mlp(size, 1), in_keys=["observation"])
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=value, average_gae=True)
    loss = ClipPPOLoss(actor, value, entropy_coeff=1e-4)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    before, losses = vector(actor), []
    collector = Collector(env, actor, frames_per_batch=FRAMES, total_frames=ITERATIONS * FRAMES)
    for data in collector:
        for _ in range(2):
            advantage(data)
            losses.append(step(loss, data.reshape(-1), optimizer))
    collector.shutdown()
    assert torch.tensor(losses).isfinite().all()
    assert not torch.equal(vector(actor), before)


@pytest.mark.parametrize("centralised", [True, False], ids=["mappo", "ippo"])
def test_the_example_of_the_page_teaches_several_vehicles(centralised) -> None:
    page = blocks(ROOT / "docs" / "interfaces.md")
    (text,) = (block.text for block in page if "MultiAgentMLP" in block.text)
    small = {"centralised = True": f"centralised = {centralised}", "batch_size=64": "batch_size=4"}
    small |= {"19200": str(FRAMES), "192000": str(ITERATIONS * FRAMES), "[mixed]": "[mixed, *DATA]"}
    for much, little in small.items():
        assert much in text
        text = re.sub(rf"{re.escape(much)}\b" if much.isdigit() else re.escape(much), little, text)
    space = {"DATA": DATA}
    exec(text, space)
    assert space["env"].group_map == {"automated": ["automated_0", "automated_1"]}
    assert len(space["rewards"]) == ITERATIONS
    assert torch.tensor(space["rewards"]).isfinite().all()
    for state in space["optimizer"].state.values():  # of every weight of both networks
        assert torch.isfinite(state["exp_avg"]).all()
        assert state["exp_avg"].abs().sum() > 0.0
