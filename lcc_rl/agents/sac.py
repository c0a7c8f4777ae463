"""Soft actor-critic with a learned temperature, on TorchRL's loss (Haarnoja et al., 2018)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss

from lcc_rl.agents.off_policy import OffPolicy
from lcc_rl.errors import require_positive
from lcc_rl.functional.random import normal, stream_id
from lcc_rl.pieces.base import SEED, STEP
from lcc_rl.policies.actor import seeded_mlp

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
        self.in_keys = ["observation", SEED, STEP]
        self.out_keys = ["action"]
        super().__init__()
        self.head, self.stream = head, stream_id("exploration")
        self.register_buffer("sigma", torch.tensor(1.0))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        observation, seed, step = (tensordict.get(key) for key in self.in_keys)
        mean, spread = self.head(observation)
        columns = torch.arange(mean.shape[-1], device=mean.device)
        noise = normal(seed, step, self.stream + columns)
        return tensordict.set(
            "action", (mean + self.sigma * spread * noise).tanh().clamp(-ONE, ONE)
        )


class SAC(OffPolicy):
    """Learns a distribution of actions and its temperature; its mean is the policy that is kept.

    Args:
        alpha_init: temperature at the start.
        alpha_lr: learning rate of the temperature.
        target_entropy: entropy to keep per action; None: minus the number of actions.
        exploration: factor of the policy's own standard deviation while it explores.
        others: see :class:`lcc_rl.agents.DDPG`.

    Raises:
        ConfigError: if a setting is out of range or contradicts another.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        seed: int,
        gamma: float = 0.9,
        hidden: Sequence[int] = (200, 100, 50),
        actor_lr: float = 1e-3,
        critic_lr: float = 1e-3,
        batch_size: int = 1024,
        buffer_size: int = 20000,
        tau: float = 0.005,
        saturation: float = 0.001,
        final_share: float = 1.0,
        updates_per_transition: float = 0.125,
        exploration: dict[str, float] | None = None,
        alpha_init: float = 0.1,
        alpha_lr: float = 1e-3,
        target_entropy: float | None = None,
        device: str = "cpu",
    ) -> None:
        super().__init__(
            observation_size,
            action_size,
            seed,
            gamma,
            hidden,
            batch_size,
            buffer_size,
            tau,
            updates_per_transition,
            saturation,
            final_share,
            exploration or {"initial": 1.0, "final": 1.0},
            device,
        )
        require_positive("agent", alpha_init=alpha_init, alpha_lr=alpha_lr)
        spread = seeded_mlp(observation_size, action_size, hidden[-1:], seed + 2).to(device)
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
            alpha_init=alpha_init,
            target_entropy=-float(action_size) if target_entropy is None else target_entropy,
            loss_function="l2",
            delay_qvalue=True,
        ).to(device)
        self._complete(loss, tau, (actor_lr, critic_lr))
        self.optimizers["alpha"] = torch.optim.Adam([self.loss.log_alpha], lr=alpha_lr)

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        with self._own_randomness():
            losses = self.loss(batch)
        total = losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]
        (total + self._penalty(batch)).backward()
        self._step(*self.optimizers)
        self.targets.step()
        self.count += 1
        named = {"loss_actor": "loss_actor", "loss_value": "loss_qvalue"}
        return {name: losses[key].detach() for name, key in named.items()}
