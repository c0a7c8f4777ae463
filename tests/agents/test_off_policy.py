"""TD3 and SAC: trained by DDPG's loop, deterministic and resumable like it."""

from __future__ import annotations

import pytest
import torch
from helpers import (
    ACTION,
    POPULATION,
    REPLAYED,
    check_resuming,
    compose,
    make_agent,
    small_loop,
    wavy_profiles,
)
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.objectives import SoftUpdate

from lcc_rl.agents import fused
from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.off_policy import leaves
from lcc_rl.agents.replay import KNOWN, Replay
from lcc_rl.envs import build_env

SMALL = (*REPLAYED, "agent.policy=network", "agent.actor_lr=1e-3")
EACH = pytest.mark.parametrize("agent", ["td3", "sac"])


@EACH
def test_resuming_equals_never_having_stopped(tmp_path, agent) -> None:
    check_resuming(lambda at: small_loop(at, f"agent={agent}", "agent.n_step=3", *SMALL), tmp_path)


def batch(size: int = 64, seed: int = 0) -> TensorDict:
    draw = torch.Generator().manual_seed(seed)
    flag = torch.rand(size, 1, generator=draw) < 0.3
    return TensorDict(
        {
            "observation": torch.randn(size, 7, generator=draw),
            "action": torch.rand(size, 1, generator=draw) * 1.8 - 0.9,
            "steps_to_next_obs": torch.randint(1, 4, (size, 1), generator=draw),
            "next": {
                "observation": torch.randn(size, 7, generator=draw),
                "reward": torch.randn(size, 1, generator=draw),
                "done": flag,
                "terminated": flag.clone(),
            },
        },
        [size],
    )


@pytest.mark.usefixtures("double")  # in which kernels of processors agree
@pytest.mark.parametrize("hidden", [[200, 100, 50], [16], [200, 40, 40]])
@pytest.mark.parametrize("agent", ["ddpg", "td3", "sac"])
def test_updates_equal_torchrls_loss_torchs_adam_and_torchrls_soft_update(
    agent, hidden, monkeypatch
) -> None:
    idle = len(set(hidden)) == 2
    monkeypatch.setattr(fused, "LEAST_ROWS", 0 if idle else 10**9)
    settings = (*SMALL, "agent.tau=0.05", "agent.critic_lr=0.002", f"agent.hidden={hidden}")
    made, plain = (
        make_agent(compose("alcc", f"agent={agent}", *settings, f"agent.fused={by_hand}"))
        for by_hand in ("true", "false")
    )
    loss = plain.loss
    for weights in (made.loss, plain.loss) if idle else ():
        for name, value in weights.state_dict().items():
            if name.endswith("bias") and value.shape[-1] > 1:
                value[..., ::2] -= 100.0  # these units are zero in all rows
    values = getattr(loss, f"{'value' if agent == 'ddpg' else 'qvalue'}_network_params")
    own = {
        "actor": torch.optim.Adam(leaves(loss.actor_network_params), lr=1e-3),
        "value": torch.optim.Adam(leaves(values), lr=2e-3),
        "alpha": torch.optim.Adam([getattr(loss, "log_alpha", torch.nn.Parameter())], lr=1e-3),
    }
    updater = SoftUpdate(loss, tau=0.05)

    def step(name: str) -> None:
        for each in own if name == "all" else [name]:
            own[each].step()

    plain._step, plain._follow = step, lambda *_: updater.step()
    for number in range(12):
        data = batch(seed=number)
        found, expected = made.update(data.clone()), plain.update(data.clone())
        for name in expected:
            torch.testing.assert_close(found[name], expected[name], rtol=1e-7, atol=1e-7)
    assert not idle or all(len(x) < 101 for *_, x in made.written.actor.passed[1:])
    state = plain.loss.state_dict()
    for name, value in made.loss.state_dict().items():
        torch.testing.assert_close(value, state[name], rtol=0.0, atol=1e-7)


@pytest.mark.usefixtures("double")
def test_target_values_that_are_kept_equal_those_computed_anew() -> None:
    every = "agent.target_every={actor: 2, critic: 3}"
    made = [make_agent(compose("alcc", "agent=ddpg", *SMALL, "agent.tau=1", every)) for _ in "ab"]
    rows = batch(40)
    buffer = Replay(50, 32, torch.Generator().manual_seed(0), "cpu")
    buffer.extend(rows.clone().set(KNOWN, torch.full((40, 2), -1.0)))
    for number in range(12):
        drawn = buffer.draw()
        data = drawn, drawn.exclude(KNOWN)
        losses = [agent.update(x) for agent, x in zip(made, data, strict=True)]
        buffer.note()
        assert (buffer.columns[KNOWN][0][:, 1] == number // 2 + number // 3).sum() >= 10
        for name, value in losses[1].items():
            torch.testing.assert_close(losses[0][name], value, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("filled", [40, 100, 130])
def test_batches_are_drawn_as_torchrls_buffer_draws_them(filled) -> None:
    generator = torch.Generator()
    buffer = ReplayBuffer(storage=LazyTensorStorage(100), batch_size=32, generator=generator)
    buffer.extend(batch(filled))
    generator.manual_seed(3)
    expected = [buffer.sample() for _ in range(3)]
    ours = Replay(100, 32, generator.manual_seed(3), "cpu")
    for part in batch(filled).split(25):
        ours.extend(part)
    for one in expected:
        found = ours.draw()
        for key in found.keys(True, True):
            assert torch.equal(found.get(key), one.get(key)), key


def test_td3_moves_its_policy_every_second_update() -> None:
    made = make_agent(compose("alcc", "agent=td3", *SMALL))
    policy = next(made.policy.parameters())
    moved = []
    for _ in range(4):
        before = policy.detach().clone()
        made.update(batch())
        moved.append(not torch.equal(before, policy))
    assert moved == [False, True, False, True]


def test_sac_explores_around_the_policy_that_is_kept() -> None:
    cfg = compose("alcc", "agent=sac", *SMALL)
    made = make_agent(cfg)
    env = build_env(cfg, wavy_profiles(), POPULATION, 512)
    td = shared_policy(made.policy)(env.reset())
    kept = td[ACTION].clone()
    spread = (made.noise(td)[ACTION] - kept).std()
    assert spread > 0.02
    made.noise.sigma.fill_(0.0)
    assert torch.allclose(made.noise(td)[ACTION], kept, atol=1e-5)
