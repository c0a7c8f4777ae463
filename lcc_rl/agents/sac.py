"""Soft actor-critic with a learned temperature, on TorchRL's loss (Haarnoja et al., 2018)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss

from lcc_rl.agents.off_policy import OffPolicy, OffPolicySettings
from lcc_rl.errors import require_in, require_positive
from lcc_rl.functional.random import stream_id
from lcc_rl.pieces.base import SEED, STEP
from lcc_rl.policies.actor import ACTION, OBSERVATION, action_noise, seeded_mlp

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


@dataclass(frozen=True)
class SACSettings(OffPolicySettings):
    """Settings of SAC; its exploration is a factor of the policy's own standard deviation.

    Args:
        alpha_init: temperature at the start.
        alpha_lr: learning rate of the temperature.
        target_entropy: entropy to keep per action; None: minus the number of actions.

    Raises:
        ConfigError: if a setting is out of range or contradicts another.
    """

    exploration: Mapping[str, float | None] = field(
        default_factory=lambda: {
            "initial": 1.0,
            "final": 1.0,
            "decay_share": 1.0,
            "decay_per_update": None,
        }
    )
    alpha_init: float = 0.1
    alpha_lr: float = 1e-3
    target_entropy: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("agent", alpha_init=self.alpha_init, alpha_lr=self.alpha_lr)
        if self.target_entropy is not None:
            require_in("agent", "(-inf, inf)", target_entropy=self.target_entropy)


class SAC(OffPolicy):
    """Learns a distribution of actions and its temperature; its mean is the policy that is kept.

    Args:
        observation_size, action_size, seed, settings, device: see
            :class:`lcc_rl.agents.off_policy.OffPolicy`.
    """

    Settings: ClassVar[type[OffPolicySettings]] = SACSettings
    critics = 2

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        seed: int,
        settings: SACSettings | None = None,
        device: str = "cpu",
    ) -> None:
        super().__init__(observation_size, action_size, seed, settings, device)
        own = self.settings
        spread = seeded_mlp(observation_size, action_size, own.hidden[-1:], seed + 2).to(device)
        head = Head(self.policy.module[0], spread)
        self.noise = SampledAction(head)
        actor = ProbabilisticActor(
            TensorDictModule(head, in_keys=["observation"], out_keys=["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=TanhNormal,
            return_log_prob=True,
        )
        entropy = -float(action_size) if own.target_entropy is None else own.target_entropy
        loss = SACLoss(
            actor,
            self.values,
            alpha_init=own.alpha_init,
            target_entropy=entropy,
            loss_function="l2",
            delay_qvalue=True,
        ).to(device)
        self._complete(loss, "qvalue_network_params", ("value",))
        self.loss.log_alpha.grad = torch.zeros_like(self.loss.log_alpha)
        alpha = [self.loss.log_alpha]
        self.optimizers["alpha"] = torch.optim.Adam(alpha, lr=own.alpha_lr, fused=True)

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
