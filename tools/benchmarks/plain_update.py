"""DDPG's update written by hand on plain tensors, as fast as torch's operations allow.

Everything that is computed goes into tensors made beforehand. It shares no code with the package;
:func:`check` holds it against TorchRL's loss.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from benchmarks.harness import agree
from lcc_rl.agents import DDPG

Network = list[tuple[Tensor, Tensor]]
COLUMNS = ("observation", "action", "reached", "reward", "terminated")


class PlainUpdate:
    """Draws a batch and takes one step of actor, critic and both targets.

    Args:
        agent: whose weights, settings and sizes to copy.
        columns: the transitions to draw from, ``[transitions, …]`` each.
    """

    def __init__(self, agent: DDPG, columns: Mapping[str, Tensor]) -> None:
        settings, loss = agent, agent.loss
        self.settings, self.rows = settings, settings.batch_size
        self.columns = [columns[name] for name in COLUMNS]
        self.drawn = [column[: self.rows].clone() for column in self.columns]
        device = self.columns[0].device
        self.index = torch.empty(self.rows, dtype=torch.long, device=device)
        self.generator = torch.Generator(device).manual_seed(0)
        state = {key: value.detach() for key, value in loss.state_dict().items()}
        names = ("actor", "value", "target_actor", "target_value")
        parts = [[v for k, v in state.items() if k.startswith(f"{n}_network")] for n in names]
        self.weights = torch.cat([v.reshape(-1) for part in parts[:2] for v in part])
        self.targets = torch.cat([v.reshape(-1) for part in parts[2:] for v in part])
        self.slopes, self.mean, self.square = (torch.zeros_like(self.weights) for _ in range(3))
        self.step = torch.zeros((), device=device)
        seen, acts = self.columns[0].shape[1], self.columns[1].shape[1]
        sizes = [(seen, *settings.hidden, acts), (seen + acts, *settings.hidden, 1)]
        self.actor, self.critic = networks(self.weights, sizes)
        self.target_actor, self.target_critic = networks(self.targets, sizes)
        self.slopes_of = networks(self.slopes, sizes)

        def made(size: tuple[int, ...]) -> list[Tensor]:
            return [torch.empty(self.rows, count, device=device) for count in size]

        self.acts, self.judges, self.spare = (made(size[1:]) for size in (*sizes, sizes[1]))
        self.input, self.wanted, self.slope, self.action = made((seen + acts, 1, 1, acts))

    @torch.no_grad()
    def __call__(self) -> None:
        """Take the step."""
        size = len(self.columns[0])
        torch.randint(size, (self.rows,), generator=self.generator, out=self.index)
        for column, drawn in zip(self.columns, self.drawn, strict=True):
            torch.index_select(column, 0, self.index, out=drawn)
        own = self.settings
        seen, action, reached, reward, terminated = self.drawn
        future = forward(self.target_actor, reached, self.acts).tanh_()
        torch.cat([reached, future], 1, out=self.input)
        future = forward(self.target_critic, self.input, self.judges)
        future.masked_fill_(terminated, 0.0).mul_(own.gamma)
        torch.add(future, reward, out=self.wanted)
        torch.cat([seen, action], 1, out=self.input)
        error = forward(self.critic, self.input, self.judges).sub_(self.wanted)
        self.loss_value = error.square().mean()
        torch.mul(error, 2.0 / self.rows, out=self.slope)
        self._back(self.critic, [self.input, *self.judges], self.slope, self.slopes_of[1])
        raw = forward(self.actor, seen, self.acts)
        torch.tanh(raw, out=self.action)
        torch.cat([seen, self.action], 1, out=self.input)
        self.loss_actor = -forward(self.critic, self.input, self.judges).mean()
        below = self._back(self.critic, [self.input, *self.judges], self.slope.fill_(-1.0), None)
        slope = torch.mm(below, self.critic[0][0][:, seen.shape[1] :])
        slope.mul_(self.action.square_().neg_().add_(1.0)).add_(raw, alpha=2.0 * own.saturation)
        slope.div_(self.rows)
        self._back(self.actor, [seen, *self.acts], slope, self.slopes_of[0])
        self._adam()
        self.targets.lerp_(self.weights, own.tau)

    def _back(
        self, network: Network, inputs: list[Tensor], slope: Tensor, into: Network | None
    ) -> Tensor:
        for place in range(len(network) - 1, -1, -1):
            if into is not None:
                torch.mm(slope.t(), inputs[place], out=into[place][0])
                torch.sum(slope, 0, out=into[place][1])
            if place:
                slope = torch.mm(slope, network[place][0], out=self.spare[place - 1])
                torch.ops.aten.threshold_backward.grad_input(
                    slope, inputs[place], 0, grad_input=slope
                )
        return slope

    def _adam(self) -> None:
        how: dict[str, Any] = {"beta1": 0.9, "beta2": 0.999, "weight_decay": 0.0, "eps": 1e-8}
        how |= {"lr": self.settings.actor_lr, "amsgrad": False, "maximize": False}
        moments: tuple[Any, ...] = ([self.mean], [self.square], [], [self.step.add_(1)])
        torch._fused_adam_([self.weights], [self.slopes], *moments, **how)


def networks(vector: Tensor, sizes: list[tuple[int, ...]]) -> list[Network]:
    """Return the weights and biases of networks that lie in a vector, one after the other."""
    made, place = [], 0
    for size in sizes:
        network = []
        for inputs, outputs in pairwise(size):
            middle, end = place + inputs * outputs, place + (inputs + 1) * outputs
            network.append((vector[place:middle].view(outputs, inputs), vector[middle:end]))
            place = end
        made.append(network)
    return made


def forward(network: Network, x: Tensor, into: list[Tensor]) -> Tensor:
    """Apply a ReLU network, writing what each layer returns to ``into``."""
    for (weight, bias), output in zip(network, into, strict=True):
        torch.addmm(bias, x, weight.t(), out=output)
        x = output if output is into[-1] else output.relu_()
    return x


def check(agent: DDPG, plain: PlainUpdate, steps: int = 5) -> None:
    """Hold a plain update against an agent that computes the gradient by TorchRL's loss."""
    from tensordict import TensorDict

    for step in range(steps):
        plain()
        seen, action, reached, reward, terminated = plain.drawn
        after = {"observation": reached, "reward": reward, "terminated": terminated}
        after["done"] = terminated
        moments = {"observation": seen, "action": action, "next": after}
        found = agent.update(TensorDict(moments, [plain.rows]))
        for name, own in (("loss_actor", plain.loss_actor), ("loss_value", plain.loss_value)):
            size = found[name].abs().clamp(min=1.0)
            agree(f"update {step}: {name} of the plain update", own / size, found[name] / size)
