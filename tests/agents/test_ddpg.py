"""DDPG's update against the papers, its targets and its state."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict

from lcc_rl.agents import DDPG
from lcc_rl.agents.agent import Scene
from lcc_rl.agents.off_policy import leaves
from lcc_rl.agents.vectors import take_step, vector_adam


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
    return DDPG(**own).start(Scene(7, seed=3))  # type: ignore[arg-type]


def network(weights: list[torch.Tensor], *parts: torch.Tensor) -> torch.Tensor:
    x = torch.cat(parts, -1)
    for weight, bias in zip(weights[:-2:2], weights[1:-2:2], strict=True):
        x = (x @ weight.t() + bias).relu()
    return x @ weights[-2].t() + weights[-1]


@pytest.mark.usefixtures("double")
@pytest.mark.parametrize("fused", [True, False])
def test_updates_are_those_of_the_papers_by_hand(fused: bool) -> None:
    """A8–A9, H7–H10 in plain torch: two losses, a step of Adam each, soft targets."""
    learner = agent(fused=fused, saturation=0.0, hidden=[32, 16])
    own = learner
    names = ("actor", "value", "target_actor", "target_value")
    found = [leaves(getattr(learner.loss, f"{name}_network_params")) for name in names]
    hand = [[tensor.detach().clone() for tensor in part] for part in found]
    rates = (own.actor_lr, own.critic_lr)
    adam = [
        torch.optim.Adam([tensor.requires_grad_() for tensor in part], lr=rate)
        for part, rate in zip(hand[:2], rates, strict=True)
    ]

    actor, critic, target_actor, target_critic = hand
    for step in range(3):
        batch = transitions(64, step)
        losses = learner.update(batch.clone())
        seen, after = batch["observation"], batch["next"]
        future = network(target_actor, after["observation"]).tanh()
        future = network(target_critic, after["observation"], future)
        wanted = after["reward"] + own.gamma * future * ~after["terminated"]
        loss_value = (network(critic, seen, batch["action"]) - wanted).square().mean()
        loss_actor = -network(critic, seen, network(actor, seen).tanh()).mean()
        slopes = torch.autograd.grad(loss_actor, actor), torch.autograd.grad(loss_value, critic)
        for part, slope, optimizer in zip(hand[:2], slopes, adam, strict=True):
            for tensor, value in zip(part, slope, strict=True):
                tensor.grad = value
            optimizer.step()
        for online, target in zip(hand[:2], hand[2:], strict=True):
            for ahead, behind in zip(online, target, strict=True):
                behind.copy_(own.tau * ahead.detach() + (1.0 - own.tau) * behind)
        for name, loss in (("loss_actor", loss_actor), ("loss_value", loss_value)):
            torch.testing.assert_close(losses[name], loss.detach(), rtol=1e-7, atol=1e-7)
        for part, expected in zip(found, hand, strict=True):
            for tensor, value in zip(part, expected, strict=True):
                torch.testing.assert_close(tensor.detach(), value.detach(), rtol=0.0, atol=1e-7)


def test_a_step_without_overhead_is_that_of_torchs_optimizer() -> None:
    for rates in ((0.01, 0.01), (0.01, 0.1)):
        weights = [torch.linspace(-1.0, 1.0, 7) for _ in range(2)]
        slopes = [torch.zeros(7) for _ in range(2)]
        pairs = zip(weights, slopes, strict=True)
        optimizers = [vector_adam(one, slope, [3, 4], list(rates)) for one, slope in pairs]
        for step in range(4):
            for slope in slopes:
                slope.copy_(torch.sin(torch.arange(7.0) + step))
            take_step(optimizers[0])
            optimizers[1].step()
        assert torch.equal(*weights)
        states = [one.state_dict()["state"].values() for one in optimizers]
        assert all(one["step"] == other["step"] == 4 for one, other in zip(*states, strict=True))


def test_a_restored_agent_goes_on_bit_for_bit() -> None:
    first, second = agent(), agent()
    first.update(transitions(64, 0))
    second.load_state_dict(deepcopy(first.state_dict()))
    for step in (1, 2, 3):
        one, other = (a.update(transitions(64, step)) for a in (first, second))
        assert one == other
    state = second.loss.state_dict()
    assert all(torch.equal(value, state[key]) for key, value in first.loss.state_dict().items())


def test_target_networks_move_only_at_multiples_and_are_copies_where_tau_is_one() -> None:
    for fused in (True, False):
        learner = agent(tau=1.0, target_every={"actor": 2, "critic": 3}, fused=fused)
        loss = learner.loss
        before = {}
        for step in range(1, 7):
            for name in ("actor", "value"):
                before[name] = getattr(loss, f"target_{name}_network_params").clone()
            learner.update(transitions(64, step))
            for name, every in (("actor", 2), ("value", 3)):
                online = getattr(loss, f"{name}_network_params")
                target = getattr(loss, f"target_{name}_network_params")
                expected = online if step % every == 0 else before[name]
                assert (target.data == expected.data).all(), (fused, step, name)
                assert step % every == 0 or not (target.data == online.data).all()


@pytest.mark.parametrize("fused", [True, False])
def test_without_mask_a_value_is_expected_after_a_collision(fused: bool) -> None:
    batch = transitions(64, 0)
    alive = batch.clone()
    alive["next", "terminated"] = torch.zeros_like(alive["next", "terminated"])

    def value(mask: bool, given: TensorDict) -> torch.Tensor:
        return agent(mask_terminal=mask, fused=fused).update(given)["loss_value"]

    ends = batch["next", "terminated"].clone()
    assert ends.any()
    assert value(False, batch) == value(True, alive) != value(True, batch)
    assert torch.equal(batch["next", "terminated"], ends)  # the caller's batch is left alone
