"""Benchmark of many seeds at once: eight DDPG updates as one, beside one after the other."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from functools import partial

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from lcc_rl.agents import DDPG
from lcc_rl.agents.fused import FusedUpdate
from lcc_rl.benchmarks.harness import TOLERANCE, Row, Run, alternate, rows_of, times

ONE_BY_ONE = "one after the other"
TOGETHER = "together"
SEEDS = 8
Layers = list[tuple[Tensor, Tensor]]


def seeds(options: Namespace) -> list[Row]:
    """Updates per second of eight agents, their networks stacked or each on its own.

    The update alone, from a batch at hand: gradients of both networks, Adam, soft targets.
    """
    rows: list[Row] = []
    for batch, count in ((16, 2), (32, 2)) if options.quick else ((64, 40), (256, 15), (1024, 5)):
        data = transitions(batch, options.device)
        check(options.device, data)
        agents = updates(options.device)
        each = [partial(agent, data[place], (True, True)) for place, agent in enumerate(agents)]
        runs: dict[str, Run] = {
            TOGETHER: partial(times, count, partial(Stacked(agents), data)),
            ONE_BY_ONE: partial(times, count, partial(call_all, each)),
        }
        spent = alternate(runs, options.repeats)
        rates = {name: SEEDS * count / seconds for name, seconds in spent.items()}
        rows += rows_of("seeds", rates, "updates/s", ONE_BY_ONE, batch)
    return rows


def call_all(functions: Sequence[Run]) -> None:
    """Call one after the other."""
    for function in functions:
        function()


def transitions(batch: int, device: str) -> TensorDictBase:
    """Return made-up transitions for every seed, ``[seeds, batch]``."""
    generator = torch.Generator().manual_seed(0)

    def draw(width: int) -> Tensor:
        return torch.randn(SEEDS, batch, width, generator=generator).to(device)

    after = TensorDict({"observation": draw(7), "reward": draw(1), "terminated": draw(1) > 2})
    moments = {"observation": draw(7), "action": draw(1).tanh(), "next": after}
    return TensorDict(moments, batch_size=[SEEDS, batch])


def updates(device: str) -> list[FusedUpdate]:
    """Return the update of a new agent for every seed."""
    agents = (DDPG(7, 1, seed=seed, device=device).fused for seed in range(SEEDS))
    return [agent for agent in agents if agent is not None]


def check(device: str, data: TensorDictBase) -> None:
    """Check that both ways lead to the same weights."""
    alone, together = updates(device), Stacked(updates(device))
    together(data)
    for place, agent in enumerate(alone):
        agent(data[place], (True, True))
        for own, stacked in zip(agent.online, together.online, strict=True):
            error = (own.detach() - stacked.detach()[place]).abs().max().item()
            if error > TOLERANCE:
                raise AssertionError(f"stacked updates differ from single ones by {error:.1e}")


class Stacked:
    """The updates of several agents as one: every product is a batch of products."""

    def __init__(self, agents: Sequence[FusedUpdate]) -> None:
        first = agents[0]
        self.gamma, self.tau, self.saturation = first.gamma, first.tau, first.saturation
        self.online = [
            nn.Parameter(torch.stack([agent.online[i].detach() for agent in agents]))
            for i in range(2)
        ]
        self.following = [torch.stack([agent.following[i] for agent in agents]) for i in range(2)]
        gradients = [torch.zeros_like(vector) for vector in self.online]
        for vector, gradient in zip(self.online, gradients, strict=True):
            vector.grad = gradient
        nets = (first.actor, first.critic)
        shapes = [[(weight.shape, bias.shape) for weight, _, bias in net] for net in nets]
        self.actor, self.critic = map(views, self.online, shapes)
        self.target_actor, self.target_critic = map(views, self.following, shapes)
        self.slopes = list(map(views, gradients, shapes))
        rate = first.optimizer.param_groups[0]["lr"]  # by default, one for both networks
        self.optimizer = torch.optim.Adam(self.online, lr=rate, fused=True)

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase) -> None:
        """Take the step of every agent, each with its own transitions ``[seeds, batch]``."""
        seen, after = batch["observation"], batch["next"]
        ahead = after["observation"]
        action = forward(self.target_actor, ahead)[0].tanh_()
        future = forward(self.target_critic, torch.cat([ahead, action], -1))[0]
        wanted = after["reward"] + self.gamma * future.masked_fill_(after["terminated"], 0.0)
        value, inputs = forward(self.critic, torch.cat([seen, batch["action"]], -1))
        size = value.shape[1]
        backward(self.critic, inputs, (value - wanted) * (2.0 / size), self.slopes[1])
        raw, inputs = forward(self.actor, seen)
        action = raw.tanh()
        value, judged = forward(self.critic, torch.cat([seen, action], -1))
        slope = backward(self.critic, judged, torch.full_like(value, -1.0 / size), None)
        slope = slope[..., seen.shape[-1] :] * (1.0 - action * action)
        backward(self.actor, inputs, slope + raw * (2.0 * self.saturation / size), self.slopes[0])
        self.optimizer.step()
        for target, vector in zip(self.following, self.online, strict=True):
            target.lerp_(vector, self.tau)


def views(vectors: Tensor, shapes: Sequence[tuple[torch.Size, torch.Size]]) -> Layers:
    """Return the weights and biases in rows of parameters, ``[seeds, …]`` each."""
    place, pairs = 0, []
    for weight, bias in shapes:
        middle, end = place + weight.numel(), place + weight.numel() + bias.numel()
        rows = vectors.detach()
        pairs.append((rows[:, place:middle].unflatten(1, weight), rows[:, middle:end].unsqueeze(1)))
        place = end
    return pairs


def forward(network: Layers, x: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Apply ReLU networks to ``[seeds, batch, inputs]``; as of :mod:`lcc_rl.agents.fused`."""
    inputs = []
    for weight, bias in network[:-1]:
        inputs.append(x)
        x = torch.baddbmm(bias, x, weight.mT).relu_()
    inputs.append(x)
    weight, bias = network[-1]
    return torch.baddbmm(bias, x, weight.mT), inputs


def backward(network: Layers, inputs: list[Tensor], slope: Tensor, into: Layers | None) -> Tensor:
    """Propagate slopes to the networks' inputs; as of :mod:`lcc_rl.agents.fused`."""
    for place in range(len(network) - 1, -1, -1):
        if into is not None:
            # The parts of a row are no whole matrix, which "out=" would need.
            into[place][0].copy_(torch.bmm(slope.mT, inputs[place]))
            into[place][1].copy_(slope.sum(1, keepdim=True))
            if place == 0:
                break
        slope = torch.bmm(slope, network[place][0])
        if place:
            slope = torch.ops.aten.threshold_backward(slope, inputs[place], 0)
    return slope
