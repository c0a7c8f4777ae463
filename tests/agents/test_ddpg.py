"""The fused DDPG update against TorchRL's loss."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict

from lcc_rl.agents import DDPG
from lcc_rl.agents.ddpg import DDPGSettings


def transitions(count: int, seed: int) -> TensorDict:
    draw = torch.Generator().manual_seed(seed)

    def uniform(width: int) -> torch.Tensor:
        return 2.0 * torch.rand(count, width, generator=draw) - 1.0

    after = {
        "observation": uniform(7),
        "reward": uniform(1),
        "done": uniform(1) < -0.5,
        "terminated": uniform(1) < -0.8,
    }
    content = {"observation": uniform(7), "action": uniform(1), "next": after}
    return TensorDict(content, [count])


def agent(**settings: object) -> DDPG:
    own = {"batch_size": 64, "buffer_size": 64, "critic_lr": 2e-3, "tau": 0.05, **settings}
    return DDPG(7, 1, seed=3, settings=DDPGSettings(**own))  # type: ignore[arg-type]


@pytest.mark.parametrize("hidden", [[200, 100, 50], [16]])
def test_the_fused_update_equals_torchrls_loss(hidden: list[int]) -> None:
    agents = [agent(hidden=hidden, fused=fused) for fused in (True, False)]
    for step in range(50):
        batch = transitions(64, step)
        fused, plain = (one.update(batch.clone()) for one in agents)
        for name in plain:
            torch.testing.assert_close(fused[name], plain[name], rtol=1e-4, atol=1e-6)
    fused, plain = (one.loss.state_dict() for one in agents)
    for name in plain:
        torch.testing.assert_close(fused[name], plain[name], rtol=1e-3, atol=2e-5)


def test_the_policy_acts_with_the_weights_that_the_fused_update_moves() -> None:
    learner = agent()
    batch = transitions(64, 0)
    before = learner.policy(batch.clone())["action"]
    learner.update(batch)
    assert not torch.equal(before, learner.policy(batch.clone())["action"])


def test_a_restored_agent_goes_on_bit_for_bit() -> None:
    first, second = agent(), agent()
    first.update(transitions(64, 0))
    second.load_state_dict(deepcopy(first.state_dict()))
    for step in (1, 2, 3):
        one, other = (a.update(transitions(64, step)) for a in (first, second))
        assert one == other
    state = second.loss.state_dict()
    assert all(torch.equal(value, state[key]) for key, value in first.loss.state_dict().items())
