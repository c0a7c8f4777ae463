"""Twin delayed deep deterministic policy gradient, on TorchRL's loss (Fujimoto et al., 2018)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import TD3Loss

from lcc_rl.agents.off_policy import OffPolicy
from lcc_rl.config import require


class TD3(OffPolicy):
    """DDPG with two Q networks, smoothed target actions and a policy that is updated less often.

    Args:
        policy_noise: standard deviation of the noise on target actions.
        noise_clip: its largest size.
        policy_delay: updates of the Q networks for each of policy and targets.
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
        policy_noise: float = 0.1,
        noise_clip: float = 0.25,
        policy_delay: int = 2,
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
            exploration,
            device,
        )
        require(policy_delay >= 1, f"agent.policy_delay must be at least 1, got {policy_delay}")
        require(
            policy_noise >= 0 and noise_clip >= 0,
            "agent.policy_noise and agent.noise_clip must not be negative",
        )
        self.policy_delay = policy_delay
        loss = TD3Loss(
            self.policy,
            self.values,
            bounds=(-1.0, 1.0),
            policy_noise=policy_noise,
            noise_clip=noise_clip,
            loss_function="l2",
            delay_actor=True,
            delay_qvalue=True,
        )
        self._complete(loss, tau, (actor_lr, critic_lr))
        self.last_actor = torch.zeros(())

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        with self._own_randomness():
            value, _ = self.loss.value_loss(batch)
        value.backward()
        self._step("value")
        self.count += 1
        if self.count % self.policy_delay == 0:
            actor, _ = self.loss.actor_loss(batch)
            (actor + self._penalty(batch)).backward()
            self._step("actor")
            self.targets.step()
            self.last_actor = actor.detach()
        return {"loss_actor": self.last_actor, "loss_value": value.detach()}

    def state_dict(self) -> dict[str, object]:
        return {**super().state_dict(), "last_actor": self.last_actor}

    def load_state_dict(self, state: dict[str, object]) -> None:
        super().load_state_dict(state)
        last = state["last_actor"]
        assert isinstance(last, Tensor)
        self.last_actor = last
