"""Deep deterministic policy gradient, on TorchRL's loss (ALCC Table III)."""

from __future__ import annotations

from dataclasses import field
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import DDPGLoss

from lcc_rl.agents.agent import Scene
from lcc_rl.agents.fused import FusedUpdate
from lcc_rl.agents.off_policy import OffPolicy, leaves
from lcc_rl.settings import Count


class DDPG(OffPolicy):
    """Actor, critic, their target networks and one optimizer of both (A7–A9, HCFS H7–H10)."""

    # Compute the update with its gradient written out, which gives the numbers of TorchRL's
    # DDPGLoss up to rounding at up to twice the speed; False uses the loss itself.
    fused: bool = True
    # Updates between two steps of each target network; with tau 1 a step is a copy.
    target_every: dict[Literal["actor", "critic"], Count] = field(
        default_factory=lambda: {"actor": 1, "critic": 1}
    )
    mask_terminal: bool = True  # no value is expected after a collision; False: one is

    def setup(self, scene: Scene) -> None:
        super().setup(scene)
        loss = DDPGLoss(
            self.policy, self.values[0], loss_function="l2", delay_actor=True, delay_value=True
        )
        self._complete(loss, "value_network_params", ("actor", "value"))
        self.update_both: FusedUpdate | None = None
        if self.fused:
            self.update_both = FusedUpdate(
                leaves(loss.actor_network_params),
                leaves(loss.value_network_params),
                leaves(loss.target_actor_network_params),
                leaves(loss.target_value_network_params),
                self,
            )
            self.optimizers = {"both": self.update_both.optimizer}

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        self.count += 1
        if not self.mask_terminal:
            batch = batch.clone(False)
            ended = batch["next", "terminated"]
            batch["next", "terminated"] = torch.zeros_like(ended)
        every = self.target_every
        due = (self.count % every["actor"] == 0, self.count % every["critic"] == 0)
        if self.update_both is not None:
            loss_actor, loss_value = self.update_both(batch, due)
            return {"loss_actor": loss_actor, "loss_value": loss_value}
        losses = self.loss(batch)
        # Only these two: the other entries of TorchRL's result are not losses, and one of them
        # still carries a gradient.
        (losses["loss_actor"] + losses["loss_value"] + self._penalty(batch)).backward()
        self._step("actor", "value")
        self._follow(*(name for name, now in zip(("actor", "value"), due, strict=True) if now))
        return {key: losses[key].detach() for key in ("loss_actor", "loss_value")}
