"""Deep deterministic policy gradient, on TorchRL's loss (ALCC Table III)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import DDPGLoss

from lcc_rl.agents.fused import FusedUpdate
from lcc_rl.agents.off_policy import OffPolicy, OffPolicySettings, leaves
from lcc_rl.errors import ConfigError, require_whole


@dataclass(frozen=True)
class DDPGSettings(OffPolicySettings):
    """Settings of DDPG.

    Args:
        fused: compute the update with its gradient written out, which gives the numbers of
            TorchRL's ``DDPGLoss`` up to rounding at up to twice the speed; False uses the loss
            itself.
        target_every: updates between two steps of each target network towards its own; with
            ``tau`` 1 a step is a copy.
        mask_terminal: no value is expected after a collision; False expects one there, too.

    Raises:
        ConfigError: if a setting is out of range or contradicts another.
    """

    fused: bool = True
    target_every: Mapping[str, int] = field(default_factory=lambda: {"actor": 1, "critic": 1})
    mask_terminal: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if set(self.target_every) != {"actor", "critic"}:
            raise ConfigError(
                "agent.target_every must have the entries actor and critic, got "
                f"{', '.join(self.target_every) or 'none'}"
            )
        require_whole("agent.target_every", 1, **self.target_every)


class DDPG(OffPolicy):
    """Actor, critic, their target networks and one optimizer of both (A7–A9, HCFS H7–H10).

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
        self._complete(loss, "value_network_params", ("actor", "value"))
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
        self.count += 1
        if not self.settings.mask_terminal:
            batch = batch.clone(False)
            ended = batch["next", "terminated"]
            batch["next", "terminated"] = torch.zeros_like(ended)
        every = self.settings.target_every
        due = (self.count % every["actor"] == 0, self.count % every["critic"] == 0)
        if self.fused is not None:
            loss_actor, loss_value = self.fused(batch, due)
            return {"loss_actor": loss_actor, "loss_value": loss_value}
        losses = self.loss(batch)
        # Only these two: the other entries of TorchRL's result are not losses, and one of them
        # still carries a gradient.
        (losses["loss_actor"] + losses["loss_value"] + self._penalty(batch)).backward()
        self._step("actor", "value")
        self._follow(*(name for name, now in zip(("actor", "value"), due, strict=True) if now))
        return {key: losses[key].detach() for key in ("loss_actor", "loss_value")}
