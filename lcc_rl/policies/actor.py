"""The learned policy: a deterministic network, and the noise that explores around it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import MLP

from lcc_rl.functional.random import normal, stream_id
from lcc_rl.pieces.base import SEED, STEP


def seeded_mlp(inputs: int, outputs: int, hidden: Sequence[int], seed: int) -> MLP:
    """Build a ReLU network whose initial weights depend on ``seed`` alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return MLP(
            in_features=inputs,
            out_features=outputs,
            num_cells=list(hidden),
            activation_class=nn.ReLU,
        )


def make_actor(
    observation_size: int, action_size: int, hidden: Sequence[int], seed: int
) -> TensorDictModule:
    """Build the policy network: ReLU layers and a tanh, so that actions lie in [−1, 1].

    Reads ``"observation"`` ``[*batch, observation_size]``, writes ``"action"``
    ``[*batch, action_size]``.
    """
    network = nn.Sequential(seeded_mlp(observation_size, action_size, hidden, seed), nn.Tanh())
    return TensorDictModule(network, in_keys=["observation"], out_keys=["action"])


class GaussianExploration(TensorDictModuleBase):
    """Adds N(0, sigma²) to ``"action"`` and holds it within [−1, 1].

    The noise is a function of the episode's seed and step, so exploration needs no random state.

    Args:
        sigma: standard deviation; change it with ``exploration.sigma.fill_(…)``.
    """

    sigma: Tensor

    def __init__(self, sigma: float) -> None:
        self.in_keys = ["action", SEED, STEP]
        self.out_keys = ["action"]
        super().__init__()
        self.stream = stream_id("exploration")
        self.register_buffer("sigma", torch.tensor(float(sigma)))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the noisy action."""
        action, seed, step = (tensordict.get(key) for key in self.in_keys)
        # One action per episode, [*batch, n], or one per follower of a platoon, [*batch, N, n].
        event = action.shape[tensordict.ndim :]
        seed, step = (x.view(*x.shape[:-1], *(1 for _ in event)) for x in (seed, step))
        entries = torch.arange(math.prod(event), device=action.device).view(event)
        noise = normal(seed, step, self.stream + entries)
        return tensordict.set("action", (action + self.sigma * noise).clamp(-1.0, 1.0))
