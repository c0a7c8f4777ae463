"""Stock TorchRL scripts, unchanged but for the environment, as its tutorials have them."""

from __future__ import annotations

import pytest
import torch
from helpers import ACTION, OBSERVATION, REWARD, single_env, small_env, string
from tensordict.nn import InteractionType, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import RewardSum
from torchrl.modules import (
    Actor,
    AdditiveGaussianModule,
    MultiAgentMLP,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import ClipPPOLoss, DDPGLoss, SoftUpdate, ValueEstimators
from torchrl.objectives.value import GAE

FRAMES, ITERATIONS = 80, 3
AGENTS = string("automated human automated human automated human automated human")


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


def test_multi_agent_ppo() -> None:
    """As TorchRL's multi-agent tutorial: one policy and one critic for the group."""
    env = small_env("alcc", 4, [AGENTS])
    env = env.append_transform(RewardSum([REWARD], [("automated", "episode_reward")]))
    assert env.group_map == {"automated": [f"automated_{i}" for i in range(4)]}
    size = env.observation_spec[OBSERVATION].shape[-1]

    def shared(outputs: int, centralised: bool) -> MultiAgentMLP:
        return MultiAgentMLP(
            n_agent_inputs=size,
            n_agent_outputs=outputs,
            n_agents=4,
            centralised=centralised,
            share_params=True,
            depth=1,
            num_cells=32,
        )

    network = TensorDictModule(
        nn.Sequential(shared(2, False), NormalParamExtractor()),
        [OBSERVATION],
        [("automated", "loc"), ("automated", "scale")],
    )
    log_prob = ("automated", "action_log_prob")
    policy = ProbabilisticActor(
        network,
        spec=env.full_action_spec_unbatched,
        in_keys=[("automated", "loc"), ("automated", "scale")],
        out_keys=[ACTION],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0},
        return_log_prob=True,
        log_prob_key=log_prob,
    )
    critic = TensorDictModule(shared(1, True), [OBSERVATION], [("automated", "state_value")])
    loss = ClipPPOLoss(policy, critic, entropy_coeff=1e-4, normalize_advantage=False)
    loss.set_keys(
        reward=REWARD,
        action=ACTION,
        sample_log_prob=log_prob,
        value=("automated", "state_value"),
        done=("automated", "done"),
        terminated=("automated", "terminated"),
    )
    loss.make_value_estimator(ValueEstimators.GAE, gamma=0.9, lmbda=0.9)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    before, losses = vector(policy), []
    collector = Collector(env, policy, frames_per_batch=FRAMES, total_frames=ITERATIONS * FRAMES)
    for data in collector:
        # Done is that of the string; the losses want one for each agent.
        shape = data["next", *REWARD].shape
        for name in ("done", "terminated"):
            own = data["next", name].unsqueeze(-2).expand(shape)
            data.set(("next", "automated", name), own)
        with torch.no_grad():
            loss.value_estimator(
                data,
                params=loss.critic_network_params,
                target_params=loss.target_critic_network_params,
            )
        assert data["advantage"].shape == shape
        losses += [step(loss, data.reshape(-1), optimizer) for _ in range(2)]
    collector.shutdown()
    assert torch.tensor(losses).isfinite().all()
    assert not torch.equal(vector(policy), before)
    assert shape == (4, FRAMES // 4, 4, 1)
