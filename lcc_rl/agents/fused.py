"""DDPG's update with its gradient written out: the numbers of TorchRL's loss, in less time.

For networks this small, half of an update by automatic differentiation is bookkeeping. Here each
pair of networks lives in one vector, so that Adam and the soft target update are one operation
each, the backward pass writes straight into the vector's gradient, and what is computed on the way
is written into tensors that are made once for a size of the batch.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.agents.off_policy import OffPolicy
from lcc_rl.agents.vectors import join, take_step, vector_adam, views

Layers = list[tuple[Tensor, Tensor, Tensor]]  # weights, the same transposed, biases


def layers(tensors: Sequence[Tensor]) -> Layers:
    """Group the weights and biases of a network, given in order."""
    pairs = zip(tensors[::2], tensors[1::2], strict=True)
    return [(weight.data, weight.data.t(), bias.data) for weight, bias in pairs]


def forward(network: Layers, x: Tensor, into: list[Tensor]) -> Tensor:
    """Apply a ReLU network, writing each layer's output to ``into``; return the last one."""
    for (_, weight, bias), output in zip(network[:-1], into, strict=False):
        x = torch.addmm(bias, x, weight, out=output).relu_()
    _, weight, bias = network[-1]
    return torch.addmm(bias, x, weight, out=into[-1])


def backward(
    network: Layers, inputs: list[Tensor], slope: Tensor, into: Layers | None, spare: list[Tensor]
) -> Tensor:
    """Propagate the slope of a loss from a ReLU network's output to its first layer's.

    Args:
        network: weights and biases.
        inputs: the input of every layer, ``[batch, …]``.
        slope: derivative by the output, ``[batch, outputs]``.
        into: where the derivatives by weights and biases are written; None: not wanted.
        spare: where the derivatives by the outputs of all layers but the last are written.

    Returns:
        The derivative by the first layer's output before its ReLU.
    """
    for place in range(len(network) - 1, -1, -1):
        x = inputs[place]
        if into is not None:
            torch.mm(slope.t(), x, out=into[place][0])
            torch.sum(slope, 0, out=into[place][2])
        if place:
            # ReLU passes the slope where its output, the next layer's input, is positive.
            below = torch.mm(slope, network[place][0], out=spare[place - 1])
            slope = torch.ops.aten.threshold_backward.grad_input(below, x, 0, grad_input=below)
    return slope


class Workspace:
    """Tensors that an update writes into, for one size of the batch.

    Args:
        rows: transitions of an update.
        actor: the actor's layers.
        critic: the critic's layers.
    """

    def __init__(self, rows: int, actor: Layers, critic: Layers) -> None:
        make = critic[0][0].new_empty

        def columns(network: Layers, count: int) -> list[Tensor]:
            return [make(count, len(weight)) for weight, _, _ in network]

        self.actor, self.spare = columns(actor, rows), columns(critic, rows)
        self.reached = make(rows, critic[0][0].shape[1])
        # The critic judges the actions of the data and, below them, those of the actor.
        self.judged, self.critic = make(2 * rows, self.reached.shape[1]), columns(critic, 2 * rows)
        halves = [entry.split(rows) for entry in (self.judged, *self.critic)]
        self.data, self.own = ([half[part] for half in halves] for part in (0, 1))
        self.slope = make(rows, 1).fill_(-1.0 / rows)


class FusedUpdate:
    """One gradient step of DDPG on actor and critic, and one soft step of the targets due.

    ALCC A8–A9 and HCFS H7–H10; the actor follows the critic as it is before its own step.

    Takes the parameters over: they become views of one vector, as do the targets'.

    Args:
        actor: weights and biases in order; a ReLU network before a tanh.
        critic: the same of the Q network, which reads observation and action side by side.
        target_actor: the actor's target network.
        target_critic: the critic's target network.
        settings: learning rates, discount, share by which the targets follow, and the weight of
            the penalty on the actor's square output before the tanh.
    """

    def __init__(
        self,
        actor: Sequence[Tensor],
        critic: Sequence[Tensor],
        target_actor: Sequence[Tensor],
        target_critic: Sequence[Tensor],
        settings: OffPolicy,
    ) -> None:
        self.gamma, self.tau = settings.gamma, settings.tau
        self.saturation = settings.saturation
        online, following = join([*actor, *critic]), join([*target_actor, *target_critic])
        slopes = torch.zeros_like(online)
        sizes = [sum(map(Tensor.numel, network)) for network in (actor, critic)]
        self.online, self.following = online.split(sizes), following.split(sizes)
        self.whole = following, online
        self.actor, self.critic = layers(actor), layers(critic)
        self.target_actor, self.target_critic = layers(target_actor), layers(target_critic)
        both = layers(views(slopes, [*actor, *critic]))
        self.actor_slopes, self.critic_slopes = both[: len(self.actor)], both[len(self.actor) :]
        rates = [settings.actor_lr, settings.critic_lr]
        self.optimizer = vector_adam(online, slopes, sizes, rates)
        self.workspaces: dict[int, Workspace] = {}

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase, due: tuple[bool, bool]) -> tuple[Tensor, Tensor]:
        """Take the step.

        Args:
            batch: transitions ``[batch, …]``, as of :meth:`lcc_rl.agents.DDPG.update`.
            due: whether the target networks of actor and critic take a step.

        Returns:
            The losses of actor and critic.
        """
        rows = len(batch)
        if rows not in self.workspaces:
            self.workspaces[rows] = Workspace(rows, self.actor, self.critic)
        space = self.workspaces[rows]
        observation = batch.get("observation")
        wanted = self._wanted(batch.get("next"), space)
        raw = forward(self.actor, observation, space.actor)
        action = raw.tanh()
        torch.cat([observation, batch.get("action")], -1, out=space.data[0])
        torch.cat([observation, action], -1, out=space.own[0])
        forward(self.critic, space.judged, space.critic)
        error, value = space.data[-1].sub_(wanted), space.own[-1]
        losses = -value.mean(), error.square().mean()
        backward(self.critic, space.data, error.mul_(2.0 / rows), self.critic_slopes, space.spare)
        slope = self._through_critic(space, raw, action)
        backward(self.actor, [observation, *space.actor], slope, self.actor_slopes, space.spare)
        take_step(self.optimizer)
        parts = [*zip(self.following, self.online, due, strict=True), (*self.whole, True)]
        for target, vector, now in parts[2:] if all(due) else parts[:2]:
            if now:
                target.lerp_(vector, self.tau)
        return losses

    def _wanted(self, after: TensorDictBase, space: Workspace) -> Tensor:
        """Return what the critic is to answer, ``[batch, 1]``."""
        seen = after.get("observation")
        action = forward(self.target_actor, seen, space.actor).tanh_()
        torch.cat([seen, action], -1, out=space.reached)
        future = forward(self.target_critic, space.reached, space.spare)
        # A time limit is no end of the world: only a collision stops the sum of rewards.
        future.masked_fill_(after.get("terminated"), 0.0)
        return future.mul_(self.gamma).add_(after.get("reward"))

    def _through_critic(self, space: Workspace, raw: Tensor, action: Tensor) -> Tensor:
        """Return the derivative of the actor's loss by its output before the tanh."""
        below = backward(self.critic, space.own, space.slope, None, space.spare)
        # Only the action, among the critic's inputs, depends on the actor.
        slope = torch.mm(below, self.critic[0][0][:, -action.shape[-1] :])
        slope.mul_(action.square_().neg_().add_(1.0))
        return slope.add_(raw, alpha=2.0 * self.saturation / len(raw))
