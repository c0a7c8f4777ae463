"""Twin delayed deep deterministic policy gradient, on TorchRL's loss (Fujimoto et al., 2018)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import TD3Loss

from lcc_rl.agents.off_policy import OffPolicy, OffPolicySettings
from lcc_rl.errors import require_in, require_whole


@dataclass(frozen=True)
class TD3Settings(OffPolicySettings):
    """Settings of TD3.

    Args:
        policy_noise: standard deviation of the noise on target actions.
        noise_clip: its largest size.
        policy_delay: updates of the Q networks for each of policy and targets.

    Raises:
        ConfigError: if a setting is out of range or contradicts another.
    """

    policy_noise: float = 0.1
    noise_clip: float = 0.25
    policy_delay: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        require_whole("agent", 1, policy_delay=self.policy_delay)
        noise = {"policy_noise": self.policy_noise, "noise_clip": self.noise_clip}
        require_in("agent", "[0, inf)", **noise)


class TD3(OffPolicy):
    """DDPG with two Q networks, smoothed target actions and a policy that is updated less often.

    Args:
        observation_size, action_size, seed, settings, device: see
            :class:`lcc_rl.agents.off_policy.OffPolicy`.
    """

    Settings: ClassVar[type[OffPolicySettings]] = TD3Settings
    critics = 2

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        seed: int,
        settings: TD3Settings | None = None,
        device: str = "cpu",
    ) -> None:
        super().__init__(observation_size, action_size, seed, settings, device)
        loss = TD3Loss(
            self.policy,
            self.values,
            bounds=(-1.0, 1.0),
            policy_noise=self.settings.policy_noise,
            noise_clip=self.settings.noise_clip,
            loss_function="l2",
            delay_actor=True,
            delay_qvalue=True,
        )
        self._complete(loss, "qvalue_network_params", ("actor", "value"))
        self.last_actor = torch.zeros(())

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        with self._own_randomness():
            value, _ = self.loss.value_loss(batch)
        value.backward()
        self._step("value")
        self.count += 1
        if self.count % self.settings.policy_delay == 0:
            actor, _ = self.loss.actor_loss(batch)
            (actor + self._penalty(batch)).backward()
            self._step("actor")
            self._follow("actor", "value")
            self.last_actor = actor.detach()
        return {"loss_actor": self.last_actor, "loss_value": value.detach()}

    def state_dict(self) -> dict[str, object]:
        return {**super().state_dict(), "last_actor": self.last_actor}

    def load_state_dict(self, state: dict[str, object]) -> None:
        super().load_state_dict(state)
        last = state["last_actor"]
        assert isinstance(last, Tensor)
        self.last_actor = last
