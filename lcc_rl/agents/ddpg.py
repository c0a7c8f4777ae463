"""Deep deterministic policy gradient, on TorchRL's loss (ALCC Table III)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import DDPGLoss

from lcc_rl.agents.fused import FusedUpdate
from lcc_rl.agents.off_policy import OffPolicy, OffPolicySettings, leaves


@dataclass(frozen=True)
class DDPGSettings(OffPolicySettings):
    """Settings of DDPG.

    Args:
        fused: compute the update with its gradient written out, which gives the numbers of
            TorchRL's ``DDPGLoss`` up to rounding at up to twice the speed; False uses the loss
            itself.
    """

    fused: bool = True


class DDPG(OffPolicy):
    """Actor, critic, their target networks and one optimizer of both.

    Args:
        observation_size, action_size, seed, settings, device: see
            :class:`lcc_rl.agents.off_policy.OffPolicy`.
    """

    Settings: ClassVar[type[OffPolicySettings]] = DDPGSettings

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        seed: int,
        settings: DDPGSettings | None = None,
        device: str = "cpu",
    ) -> None:
        super().__init__(observation_size, action_size, seed, settings, device)
        loss = DDPGLoss(
            self.policy, self.values[0], loss_function="l2", delay_actor=True, delay_value=True
        )
        self._complete(loss, "value_network_params")
        self.fused: FusedUpdate | None = None
        if self.settings.fused:
            self.fused = FusedUpdate(
                leaves(loss.actor_network_params),
                leaves(loss.value_network_params),
                leaves(loss.target_actor_network_params),
                leaves(loss.target_value_network_params),
                self.settings,
            )
            self.optimizers = {"both": self.fused.optimizer}

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        if self.fused is not None:
            loss_actor, loss_value = self.fused(batch)
            return {"loss_actor": loss_actor, "loss_value": loss_value}
        losses = self.loss(batch)
        # Only these two: the other entries of TorchRL's result are not losses, and one of them
        # still carries a gradient.
        (losses["loss_actor"] + losses["loss_value"] + self._penalty(batch)).backward()
        self._step("actor", "value")
        self.targets.step()
        return {key: losses[key].detach() for key in ("loss_actor", "loss_value")}
