"""Updates with explicit gradients: the results of TorchRL's losses in less time.

For small networks, most of an update by automatic differentiation is overhead. Here the backward
pass writes into the gradients, and intermediate results into tensors that are allocated once per
batch size. DDPG, TD3 and SAC share these parts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

Layers = list[tuple[Tensor, Tensor, Tensor]]  # weights, transposed weights, biases


def layers(tensors: Sequence[Tensor]) -> Layers:
    """Group the weights and biases of a network, given in order."""
    pairs = zip(tensors[::2], tensors[1::2], strict=True)
    return [(weight, weight.t(), bias) for weight, bias in pairs]


class Network:
    """A ReLU network with a backward pass that writes into the gradients of its weights.

    Args:
        tensors: weights and biases in order, with their gradients if the network learns.
        number: index of the network, if the tensors hold several, ``[networks, …]``.
    """

    def __init__(self, tensors: Sequence[Tensor], number: int | None = None) -> None:
        part = ... if number is None else number
        self.layers = layers([tensor.data[part] for tensor in tensors])
        self.slopes = layers([x.grad[part] for x in tensors if x.grad is not None])
        self.rooms: dict[int, tuple[list[Tensor], list[Tensor]]] = {}

    def room(self, rows: int) -> tuple[list[Tensor], list[Tensor]]:
        """Return tensors for the output of every layer and for the derivatives by it."""
        if rows not in self.rooms:
            weights = [weight for weight, _, _ in self.layers]
            outputs, slopes = ([w.new_empty(rows, len(w)) for w in weights] for _ in range(2))
            self.rooms[rows] = outputs, slopes
        return self.rooms[rows]

    def forward(self, x: Tensor, into: list[Tensor] | None = None) -> Tensor:
        """Apply the network, writing each layer's output to ``into``; return the last one."""
        into = into or self.room(len(x))[0]
        for (_, weight, bias), output in zip(self.layers[:-1], into, strict=False):
            x = torch.addmm(bias, x, weight, out=output).relu_()
        _, weight, bias = self.layers[-1]
        return torch.addmm(bias, x, weight, out=into[-1])

    def backward(
        self, x: Tensor, slope: Tensor, outputs: list[Tensor] | None = None, learn: bool = True
    ) -> Tensor:
        """Propagate the slope of a loss from the output to the first layer's.

        Args:
            x: input of the network, ``[batch, inputs]``.
            slope: derivative by the output, ``[batch, outputs]``.
            outputs: the outputs that :meth:`forward` wrote; None: the network's own tensors.
            learn: write the derivatives by weights and biases.

        Returns:
            The derivative by the first layer's output before its ReLU.
        """
        own, spare = self.room(len(x))
        inputs = [x, *(outputs or own)]
        for place in range(len(self.layers) - 1, -1, -1):
            x = inputs[place]
            if learn:
                torch.mm(slope.t(), x, out=self.slopes[place][0])
                torch.sum(slope, 0, out=self.slopes[place][2])
            if place:
                # ReLU passes the slope where its output is positive.
                below = torch.mm(slope, self.layers[place][0], out=spare[place - 1])
                slope = torch.ops.aten.threshold_backward.grad_input(below, x, 0, grad_input=below)
        return slope


class CriticBatch(NamedTuple):
    """Concatenated observations and actions, and the outputs of each layer of each critic."""

    input: Tensor
    outputs: list[list[Tensor]]

    def place(self, observation: Tensor, action: Tensor) -> CriticBatch:
        """Write observation and action."""
        torch.cat([observation, action], -1, out=self.input)
        return self

    @property
    def values(self) -> list[Tensor]:
        """The values of each critic, ``[batch, 1]``."""
        return [output[-1] for output in self.outputs]


class Workspace(NamedTuple):
    """Actions for the critics: those of the data, followed by those of the actor."""

    both: CriticBatch
    data: CriticBatch
    own: CriticBatch
    slope: Tensor  # slope of the negative mean value of the actor's actions


class ActorCritic:
    """An actor and its Q networks, with the parts of an update (A8–A9, H7–H8).

    Args:
        networks: weights and biases of ``"actor"``, a ReLU network before a tanh, and ``"value"``,
            the Q networks, which read observation and action.
        targets: likewise for the target networks; without an actor, the actor is its own target.
        critics: number of Q networks.
        gamma: discount.
        saturation: weight of the penalty on the actor's squared output before the tanh.
    """

    def __init__(
        self,
        networks: Mapping[str, Sequence[Tensor]],
        targets: Mapping[str, Sequence[Tensor]],
        critics: int,
        gamma: float,
        saturation: float,
    ) -> None:
        self.gamma, self.saturation = gamma, saturation
        depth, numbers = len(networks["value"]), range(critics) if critics > 1 else [None]
        self.actor = Network(networks["actor"][:depth])
        self.target_actor = Network(targets["actor"]) if "actor" in targets else self.actor
        self.critics = [Network(networks["value"], number) for number in numbers]
        self.target_critics = [Network(targets["value"], number) for number in numbers]
        self.spaces: dict[int, Workspace] = {}

    def space(self, rows: int) -> Workspace:
        """Return the tensors for a batch size."""
        if rows not in self.spaces:
            first = self.critics[0].layers[0][0]
            outputs = [critic.room(2 * rows)[0] for critic in self.critics]
            both = CriticBatch(first.new_empty(2 * rows, first.shape[1]), outputs)
            data, own = (
                CriticBatch(both.input[part], [[x[part] for x in output] for output in outputs])
                for part in (slice(rows), slice(rows, None))
            )
            slope = first.new_full((rows, 1), -1.0 / rows)
            self.spaces[rows] = Workspace(both, data, own, slope)
        return self.spaces[rows]

    def future(self, reached: Tensor, action: Tensor, into: CriticBatch) -> Tensor:
        """Return the least value of actions by the target networks, ``[batch, 1]``."""
        into.place(reached, action)
        pairs = zip(self.target_critics, into.outputs, strict=True)
        return reduce(torch.minimum, [critic.forward(into.input, out) for critic, out in pairs])

    def wanted(self, after: TensorDictBase, future: Tensor) -> Tensor:
        """Return the TD target, ``[batch, 1]``."""
        # Only a collision ends the sum of rewards; a truncated episode would continue.
        future = future.masked_fill(after.get("terminated"), 0.0)
        return future.mul_(self.gamma).add_(after.get("reward"))

    def evaluate(self, what: CriticBatch, count: int | None = None) -> list[Tensor]:
        """Return the values by the first ``count`` critics, by default by all."""
        pairs = zip(self.critics[:count], what.outputs, strict=False)
        return [critic.forward(what.input, out) for critic, out in pairs]

    def critic_step(self, data: CriticBatch, wanted: Tensor) -> Tensor:
        """Write the gradient of the critics' mean squared errors; return the loss."""
        errors = [value.sub_(wanted) for value in data.values]
        loss = reduce(torch.add, [error.square().mean() for error in errors])
        for critic, error, outputs in zip(self.critics, errors, data.outputs, strict=True):
            critic.backward(data.input, error.mul_(2.0 / len(error)), outputs)
        return loss

    def through_critics(self, own: CriticBatch, slopes: Sequence[Tensor], count: int) -> Tensor:
        """Return the derivative by the actions, ``count`` inputs, from that by the values."""
        found = []
        for critic, slope, outputs in zip(self.critics, slopes, own.outputs, strict=False):
            below = critic.backward(own.input, slope, outputs, learn=False)
            found.append(torch.mm(below, critic.layers[0][0][:, -count:]))
        return reduce(Tensor.add_, found)

    def actor_step(
        self, observation: Tensor, space: Workspace, raw: Tensor, action: Tensor
    ) -> None:
        """Write the gradient of the deterministic actor's loss: value by one critic, and penalty.

        Args:
            observation: input of the actor, ``[batch, …]``.
            space: its ``own`` actions have been evaluated by the first critic.
            raw: the actor's output before the tanh, ``[batch, actions]``.
            action: tanh of ``raw``; it is overwritten.
        """
        slope = self.through_critics(space.own, [space.slope], action.shape[-1])
        slope.mul_(action.square_().neg_().add_(1.0))
        slope.add_(raw, alpha=2.0 * self.saturation / len(raw))
        self.actor.backward(observation, slope)
