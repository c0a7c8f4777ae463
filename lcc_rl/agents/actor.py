"""The policy network and its exploration noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import MLP

from lcc_rl.functional.random import normal, stream_id
from lcc_rl.pieces.base import ACTION, OBSERVATION, SEED, STEP

ONE = 1.0 - 1e-6  # largest action with a finite inverse tanh in single precision
ACTIVATIONS = {"relu": nn.ReLU, "tanh": nn.Tanh, "elu": nn.ELU, "silu": nn.SiLU}
Activation = Literal["relu", "tanh", "elu", "silu"]


def seeded_mlp(
    inputs: int, outputs: int, hidden: Sequence[int], seed: int, activation: Activation
) -> MLP:
    """Build a network with initial weights that depend on ``seed`` only.

    Args:
        inputs: number of inputs.
        outputs: number of outputs.
        hidden: sizes of the hidden layers; none for a linear map.
        seed: seed of the weights.
        activation: activation between the layers.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return MLP(
            in_features=inputs,
            out_features=outputs,
            num_cells=list(hidden),
            activation_class=ACTIVATIONS[activation],
        )


def make_actor(
    observation_size: int,
    action_size: int,
    hidden: Sequence[int],
    seed: int,
    activation: Activation = "relu",
) -> TensorDictModule:
    """Build the policy network; a final tanh keeps actions in [−1, 1].

    It reads ``"observation"`` ``[*batch, observation_size]`` and writes ``"action"``
    ``[*batch, action_size]``.
    """
    layers = seeded_mlp(observation_size, action_size, hidden, seed, activation)
    network = nn.Sequential(layers, nn.Tanh())
    return TensorDictModule(network, in_keys=["observation"], out_keys=["action"])


def shared_policy(policy: TensorDictModule) -> TensorDictModule:
    """Return a policy that applies one network to every automated vehicle of a string.

    It reads ``("automated", "observation")`` ``[*batch, A, n]`` and writes ``("automated",
    "action")`` ``[*batch, A, 1]``; it shares the weights of the given policy.

    Args:
        policy: a network that reads ``"observation"`` and writes ``"action"``.
    """
    return TensorDictModule(policy.module, in_keys=[OBSERVATION], out_keys=[ACTION])


class GaussianExploration(TensorDictModuleBase):
    """Adds N(0, sigma²) to actions and clamps them to [−1, 1].

    The noise is a function of the episode's seed and step, so exploration needs no random state.

    Args:
        sigma: standard deviation; change it with ``exploration.sigma.fill_(…)``.
        key: the action, ``[*batch, …, n]``.
    """

    sigma: Tensor

    def __init__(self, sigma: float, key: NestedKey = ACTION) -> None:
        self.in_keys = [key, SEED, STEP]
        self.out_keys = [key]
        super().__init__()
        self.key, self.stream = key, stream_id("exploration")
        self.register_buffer("sigma", torch.tensor(float(sigma)))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the noisy action."""
        action = tensordict.get(self.key)
        noise = action_noise(action, tensordict, self.stream)
        return tensordict.set(self.key, (action + self.sigma * noise).clamp(-1.0, 1.0))


def action_noise(like: Tensor, tensordict: TensorDictBase, stream: int) -> Tensor:
    """Draw N(0, 1) for every entry of an action by the seed and the step of its episode.

    Args:
        like: the action, ``[*batch, …, n]``.
        tensordict: holds seed and step, ``[*batch, 1]``.
        stream: the stream of the first entry; further entries use the next ones.
    """
    seed, step = (tensordict.get(key) for key in (SEED, STEP))
    event = like.shape[seed.ndim - 1 :]
    seed, step = (x.view(*x.shape[:-1], *(1 for _ in event)) for x in (seed, step))
    entries = torch.arange(math.prod(event), device=like.device).view(event)
    return normal(seed, step, stream + entries)
