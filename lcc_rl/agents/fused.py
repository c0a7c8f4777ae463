"""DDPG's update with its gradient written out: the numbers of TorchRL's loss, in less time.

For networks this small, half of an update by automatic differentiation is bookkeeping. Here each
pair of networks lives in one vector, so that Adam and the soft target update are one operation
each, and the backward pass writes straight into the vector's gradient.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from lcc_rl.agents.off_policy import OffPolicySettings

Layers = list[tuple[Tensor, Tensor]]


def join(tensors: Sequence[Tensor]) -> nn.Parameter:
    """Move tensors into one vector, of which they become views, and return it."""
    vector = torch.cat([tensor.detach().reshape(-1) for tensor in tensors])
    place = 0
    for tensor in tensors:
        tensor.data = vector[place : place + tensor.numel()].view(tensor.shape)
        place += tensor.numel()
    joined = nn.Parameter(vector)
    joined.grad = torch.zeros_like(vector)
    return joined


def layers(tensors: Sequence[Tensor]) -> Layers:
    """Pair the weights and biases of a network, given in order."""
    return list(zip(tensors[::2], tensors[1::2], strict=True))


def gradients(joined: nn.Parameter, tensors: Sequence[Tensor]) -> Layers:
    """Return the views of a vector's gradient that belong to a network's weights and biases."""
    assert joined.grad is not None
    parts = joined.grad.split([tensor.numel() for tensor in tensors])
    return layers([part.view(tensor.shape) for part, tensor in zip(parts, tensors, strict=True)])


def forward(network: Layers, x: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Apply a ReLU network; return its output and the input of every layer."""
    inputs = []
    for weight, bias in network[:-1]:
        inputs.append(x)
        x = torch.addmm(bias, x, weight.t()).relu_()
    inputs.append(x)
    weight, bias = network[-1]
    return torch.addmm(bias, x, weight.t()), inputs


def backward(network: Layers, inputs: list[Tensor], slope: Tensor, into: Layers | None) -> Tensor:
    """Propagate the slope of a loss from a ReLU network's output to its input.

    Args:
        network: weights and biases.
        inputs: the input of every layer, from :func:`forward`.
        slope: derivative by the output, ``[batch, outputs]``.
        into: where the derivatives by weights and biases are written; None: not wanted.

    Returns:
        The derivative by the network's input, ``[batch, inputs]``; by the input of its second
        layer where only the weights' derivatives are wanted.
    """
    for place in range(len(network) - 1, -1, -1):
        if into is not None:
            torch.mm(slope.t(), inputs[place], out=into[place][0])
            torch.sum(slope, 0, out=into[place][1])
            if place == 0:
                break
        slope = torch.mm(slope, network[place][0])
        if place:
            # ReLU passes the slope where its output, the next layer's input, is positive.
            slope = torch.ops.aten.threshold_backward(slope, inputs[place], 0)
    return slope


class FusedUpdate:
    """One gradient step of DDPG on actor and critic, and one soft step of the targets due.

    Takes the parameters over: they become views of one vector per network.

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
        settings: OffPolicySettings,
    ) -> None:
        self.gamma, self.tau = settings.gamma, settings.tau
        self.saturation = settings.saturation
        self.online = [join(actor), join(critic)]
        self.following = [join(target_actor).data, join(target_critic).data]
        self.actor, self.critic = layers(actor), layers(critic)
        self.target_actor, self.target_critic = layers(target_actor), layers(target_critic)
        self.actor_slopes = gradients(self.online[0], actor)
        self.critic_slopes = gradients(self.online[1], critic)
        groups = zip(self.online, (settings.actor_lr, settings.critic_lr), strict=True)
        self.optimizer = torch.optim.Adam(
            [{"params": [vector], "lr": rate} for vector, rate in groups], fused=True
        )

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase, due: tuple[bool, bool]) -> tuple[Tensor, Tensor]:
        """Take the step.

        Args:
            batch: transitions ``[batch, …]``, as of :meth:`lcc_rl.agents.DDPG.update`.
            due: whether the target networks of actor and critic take a step.

        Returns:
            The losses of actor and critic.
        """
        observation = batch["observation"]
        loss_value = self._critic(batch, observation)
        loss_actor = self._actor(observation)
        self.optimizer.step()
        for target, vector, now in zip(self.following, self.online, due, strict=True):
            if now:
                target.lerp_(vector, self.tau)
        return loss_actor, loss_value

    def _critic(self, batch: TensorDictBase, observation: Tensor) -> Tensor:
        after = batch["next"]
        ahead = after["observation"]
        action = forward(self.target_actor, ahead)[0].tanh_()
        future = forward(self.target_critic, torch.cat([ahead, action], -1))[0]
        # A time limit is no end of the world: only a collision stops the sum of rewards.
        wanted = after["reward"] + self.gamma * future.masked_fill_(after["terminated"], 0.0)
        value, inputs = forward(self.critic, torch.cat([observation, batch["action"]], -1))
        error = value.sub_(wanted)
        backward(self.critic, inputs, error * (2.0 / len(error)), self.critic_slopes)
        return error.square_().mean()

    def _actor(self, observation: Tensor) -> Tensor:
        raw, inputs = forward(self.actor, observation)
        action = raw.tanh()
        value, judged = forward(self.critic, torch.cat([observation, action], -1))
        slope = torch.full_like(value, -1.0 / len(value))
        slope = backward(self.critic, judged, slope, None)[:, observation.shape[-1] :]
        slope = slope * (1.0 - action * action) + raw * (2.0 * self.saturation / len(raw))
        backward(self.actor, inputs, slope, self.actor_slopes)
        return -value.mean()
