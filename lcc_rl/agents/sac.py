"""Soft actor-critic with a learned temperature, on TorchRL's loss (Haarnoja et al., 2018)."""

from __future__ import annotations

from dataclasses import field

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss

from lcc_rl.agents.actor import ACTION, OBSERVATION, action_noise, seeded_mlp
from lcc_rl.agents.agent import Scene
from lcc_rl.agents.off_policy import Exploration, OffPolicy
from lcc_rl.functional.random import stream_id
from lcc_rl.pieces.base import SEED, STEP
from lcc_rl.settings import Number, Positive, given_as

ONE = 1.0 - 1e-6  # the largest action whose inverse tanh exists in single precision


class Head(nn.Module):
    """Mean and standard deviation of the action before the tanh.

    Args:
        mean: network whose tanh is the deterministic policy.
        spread: network of the logarithm of the standard deviation, held within [−5, 1].
    """

    def __init__(self, mean: nn.Module, spread: nn.Module) -> None:
        super().__init__()
        self.mean, self.spread = mean, spread

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return both, each ``[*batch, actions]``."""
        logarithm = -2.0 + 3.0 * torch.tanh(self.spread(observation))
        return self.mean(observation), logarithm.exp()


class SampledAction(TensorDictModuleBase):
    """Replaces the deterministic action by a draw of the policy's distribution.

    The draw is a function of the episode's seed and step, so it needs no random state.

    Args:
        head: the distribution; ``sigma`` multiplies its standard deviation.
    """

    sigma: Tensor

    def __init__(self, head: Head) -> None:
        self.in_keys = [OBSERVATION, SEED, STEP]
        self.out_keys = [ACTION]
        super().__init__()
        self.head, self.stream = head, stream_id("exploration")
        self.register_buffer("sigma", torch.tensor(1.0))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        mean, spread = self.head(tensordict.get(OBSERVATION))
        noise = action_noise(mean, tensordict, self.stream)
        return tensordict.set(ACTION, (mean + self.sigma * spread * noise).tanh().clamp(-ONE, ONE))


class SAC(OffPolicy):
    """Learns a distribution of actions and its temperature; its mean is the policy that is kept.

    Its exploration is a factor of the policy's own standard deviation.
    """

    exploration: given_as(Exploration) = field(  # type: ignore[valid-type]
        default_factory=lambda: Exploration(initial=1.0, final=1.0, decay_share=1.0)
    )
    alpha_init: Positive = 0.1  # temperature at the start
    alpha_lr: Positive = 1e-3  # its learning rate
    target_entropy: Number | None = None  # entropy to keep per action; None: -1, of one action

    critics = 2

    def setup(self, scene: Scene) -> None:
        super().setup(scene)
        size, seed, device = scene.observation_size, scene.seed, scene.device
        spread = seeded_mlp(size, 1, self.hidden[-1:], seed + 2).to(device)
        head = Head(self.policy.module[0], spread)
        self.noise = SampledAction(head)
        actor = ProbabilisticActor(
            TensorDictModule(head, in_keys=["observation"], out_keys=["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=TanhNormal,
            return_log_prob=True,
        )
        loss = SACLoss(
            actor,
            self.values,
            alpha_init=self.alpha_init,
            target_entropy=-1.0 if self.target_entropy is None else self.target_entropy,
            loss_function="l2",
            delay_qvalue=True,
        ).to(device)
        self._complete(loss, "qvalue_network_params", ("value",))
        self.loss.log_alpha.grad = torch.zeros_like(self.loss.log_alpha)
        alpha = [self.loss.log_alpha]
        self.optimizers["alpha"] = torch.optim.Adam(alpha, lr=self.alpha_lr, fused=True)

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        with self._own_randomness():
            losses = self.loss(batch)
        total = losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]
        (total + self._penalty(batch)).backward()
        self._step(*self.optimizers)
        self._follow("value")
        self.count += 1
        named = {"loss_actor": "loss_actor", "loss_value": "loss_qvalue"}
        return {name: losses[key].detach() for name, key in named.items()}
