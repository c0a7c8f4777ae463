"""Updates with explicit gradients: the results of TorchRL's losses in less time.

For small networks, most of an update by automatic differentiation is overhead. Here the backward
pass writes into the gradients, and intermediate results into tensors that are allocated once per
batch size. DDPG, TD3 and SAC share these parts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import reduce

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.agents.collecting import STEPS_AHEAD

Layers = list[tuple[Tensor, Tensor, Tensor]]  # weights, transposed weights, biases

LEAST_ROWS = 1000  # of a batch, from which its products are worth other operations
MOST_ACTIVE = 0.8  # share of a layer's units up to which the idle ones are left out


def layers(tensors: Sequence[Tensor]) -> Layers:
    """Group the weights and biases of a network, given in order."""
    pairs = zip(tensors[::2], tensors[1::2], strict=True)
    return [(weight, weight.t(), bias) for weight, bias in pairs]


def _active(output: Tensor) -> Tensor | None:
    """Return the units that are not zero in all rows of a ReLU layer; None: most of them."""
    found = output.sum(0).nonzero().flatten()  # NaN counts as active
    return found if 0 < len(found) <= MOST_ACTIVE * output.shape[1] else None


def _widened(values: Tensor, dim: int, places: Tensor | None, like: Tensor) -> Tensor:
    """Return values at these places of a dimension, and zeros at the others."""
    if places is None:
        return values
    shape = [*values.shape]
    shape[dim] = like.shape[dim]
    return values.new_zeros(shape).index_copy_(dim, places, values)


class Network:
    """A ReLU network with a backward pass that writes into the gradients of its weights.

    A unit that is zero in all rows of a batch adds zeros to every sum of the next layer and to its
    gradient. These units are left out, which changes results by rounding only.

    Args:
        tensors: weights and biases in order, with their gradients if the network learns.
        number: index of the network, if the tensors hold several, ``[networks, …]``.
    """

    def __init__(self, tensors: Sequence[Tensor], number: int | None = None) -> None:
        part = ... if number is None else number
        self.layers = layers([tensor.data[part] for tensor in tensors])
        self.slopes = layers([x.grad[part] for x in tensors if x.grad is not None])
        # On a GPU, to look for idle units takes longer than products with them.
        self.least = LEAST_ROWS if tensors[0].device.type == "cpu" else math.inf
        self.rows, self.rooms = -1, list[Tensor]()  # for the outputs of the layers
        # Of the last forward pass: every layer's input, weights and active units before it.
        self.passed: list[tuple[Tensor, Tensor, Tensor | None]] = []

    def forward(self, x: Tensor) -> Tensor:
        """Apply the network; return its output, which is valid until the next call."""
        rows, units = len(x), None
        if rows > self.rows:
            self.rooms = [bias.new_empty(rows, len(bias)) for _, _, bias in self.layers]
            self.rows = rows
        rooms = self.rooms if rows == self.rows else [room[:rows] for room in self.rooms]
        self.passed, last = [], len(self.layers) - 1
        for (weight, transposed, bias), room in zip(self.layers, rooms, strict=True):
            if units is not None:
                x, weight = x.index_select(1, units), weight.index_select(1, units)
                transposed = weight.t()
            self.passed.append((x, weight, units))
            x = torch.addmm(bias, x, transposed, out=room)
            if len(self.passed) <= last:
                x.relu_()
                units = _active(x) if rows >= self.least else None
        return x

    def backward(self, slope: Tensor, learn: bool = True) -> Tensor:
        """Propagate the slope of a loss from the output of the last forward pass.

        Args:
            slope: derivative by the output, ``[batch, outputs]``.
            learn: write the derivatives by weights and biases.

        Returns:
            The derivative by the output of the first layer's active units before their ReLU.
        """
        units, few = None, len(slope) < self.least
        for place in range(len(self.layers) - 1, -1, -1):
            x, weight, columns = self.passed[place]
            if learn and few and columns is units is None:
                torch.mm(slope.t(), x, out=self.slopes[place][0])
                torch.sum(slope, 0, out=self.slopes[place][2])
            elif learn:
                self._learn(place, slope, x, units)
            if place:
                weight = weight if units is None else weight.index_select(0, units)
                # ReLU passes the slope where its output is positive.
                below = torch.mm(slope, weight)
                slope = torch.ops.aten.threshold_backward.grad_input(below, x, 0, grad_input=below)
            units = columns
        return slope

    def _learn(self, place: int, slope: Tensor, x: Tensor, units: Tensor | None) -> None:
        """Write the derivatives by weights and biases, of a layer's active units behind it."""
        (weight, _, bias), columns = self.slopes[place], self.passed[place][2]
        # For fewer inputs than outputs the transposed product takes a fifth of the time.
        turned = x.shape[1] < slope.shape[1]
        found = torch.mm(x.t(), slope).t() if turned else torch.mm(slope.t(), x)
        weight.copy_(_widened(_widened(found, 1, columns, weight), 0, units, weight))
        bias.copy_(_widened(slope.sum(0), 0, units, bias))

    def by_inputs(self, slope: Tensor, count: int) -> Tensor:
        """Return the derivative by the last inputs from that by the output."""
        below = self.backward(slope, learn=False)
        weight, units = self.layers[0][0][:, -count:], [*self.passed, (None, None, None)][1][2]
        return torch.mm(below, weight if units is None else weight.index_select(0, units))


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

    def future(self, reached: Tensor, action: Tensor) -> Tensor:
        """Return the least value of actions by the target networks, ``[batch, 1]``."""
        both = torch.cat([reached, action], -1)
        return reduce(torch.minimum, [critic.forward(both) for critic in self.target_critics])

    def wanted(self, batch: TensorDictBase, future: Tensor) -> Tensor:
        """Return the TD target, ``[batch, 1]``."""
        after, ahead = batch.get("next"), batch.get(STEPS_AHEAD, None)
        # Only a collision ends the sum of rewards; a truncated episode would continue.
        future = future.masked_fill(after.get("terminated"), 0.0)
        discount = self.gamma if ahead is None else self.gamma**ahead
        return future.mul_(discount).add_(after.get("reward"))

    def evaluate(self, seen: Tensor, action: Tensor, count: int | None = None) -> list[Tensor]:
        """Return the values of actions by the first ``count`` critics; None: by all."""
        rows = torch.cat([seen, action], -1)
        return [critic.forward(rows) for critic in self.critics[:count]]

    def critic_step(self, values: Sequence[Tensor], wanted: Tensor) -> Tensor:
        """Write the gradient of the critics' mean squared errors; return the loss.

        Args:
            values: values of the data, of the critics' last pass; they are overwritten.
            wanted: the TD target, ``[batch, 1]``.
        """
        errors = [value.sub_(wanted) for value in values]
        loss = reduce(torch.add, [error.square().mean() for error in errors])
        for critic, error in zip(self.critics, errors, strict=True):
            critic.backward(error.mul_(2.0 / len(error)))
        return loss

    def through_critics(self, slopes: Sequence[Tensor], count: int) -> Tensor:
        """Return the derivative by the actor's ``count`` actions from those by their values."""
        pairs = zip(self.critics, slopes, strict=False)
        return reduce(Tensor.add_, [critic.by_inputs(slope, count) for critic, slope in pairs])

    def actor_step(self, raw: Tensor, action: Tensor) -> None:
        """Write the gradient of the deterministic actor's loss: value by one critic, and penalty.

        Args:
            raw: the actor's output before the tanh, ``[batch, actions]``.
            action: tanh of ``raw``, evaluated by the first critic; it is overwritten.
        """
        value = torch.full_like(raw[:, :1], -1.0 / len(raw))
        slope = self.through_critics([value], action.shape[-1])
        slope.mul_(action.square_().neg_().add_(1.0))
        slope.add_(raw, alpha=2.0 * self.saturation / len(raw))
        self.actor.backward(slope)
