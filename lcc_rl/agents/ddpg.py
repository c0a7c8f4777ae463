"""Deep deterministic policy gradient with TorchRL's loss (ALCC Table III)."""

from __future__ import annotations

from dataclasses import field
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import DDPGLoss

from lcc_rl.agents.agent import Scene
from lcc_rl.agents.fused import ActorCritic
from lcc_rl.agents.off_policy import OffPolicy
from lcc_rl.agents.replay import KNOWN
from lcc_rl.settings import Count


class DDPG(OffPolicy):
    """Actor, critic, their target networks and one optimizer of both (A7–A9, HCFS H7–H10)."""

    # Updates between two steps of each target network; with tau = 1 a step is a copy.
    target_every: dict[Literal["actor", "critic"], Count] = field(
        default_factory=lambda: {"actor": 1, "critic": 1}
    )
    mask_terminal: bool = True  # value 0 after a collision; False: the critic's value

    def setup(self, scene: Scene) -> None:
        super().setup(scene)
        self.lasting = min(self.target_every.values()) > 1
        loss = DDPGLoss(
            self.actor, self.values[0], loss_function="l2", delay_actor=True, delay_value=True
        )
        self._complete(loss, ("actor", "value"))

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        self.count += 1
        if not self.mask_terminal:
            batch = batch.clone(False)
            ended = batch["next", "terminated"]
            batch["next", "terminated"] = torch.zeros_like(ended)
        losses = self._losses(batch)
        self._step("all")
        every = {"actor": self.target_every["actor"], "value": self.target_every["critic"]}
        self._follow(*(name for name, count in every.items() if self.count % count == 0))
        return losses

    def _by_loss(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Write the gradient by TorchRL's loss; return the losses."""
        losses = self.loss(batch)
        # Only these two are losses; another entry of TorchRL's result has a gradient, too.
        actor, value = losses["loss_actor"], losses["loss_value"]
        self._differentiate(actor + value + self._penalty(batch))
        return actor.detach(), value.detach()

    @torch.no_grad()
    def _by_hand(self, batch: TensorDictBase, networks: ActorCritic) -> tuple[Tensor, Tensor]:
        """Compute the gradient explicitly (A8–A9, H7–H8); the actor uses the old critic."""
        seen = batch.get("observation")
        wanted = networks.wanted(batch, self._future(batch, networks))
        raw = networks.actor.forward(seen)
        action = raw.tanh()
        values = networks.evaluate(seen, batch.get("action"))
        loss_value = networks.critic_step(values, wanted)
        loss_actor = -networks.evaluate(seen, action, 1)[0].mean()
        networks.actor_step(raw, action)
        return loss_actor, loss_value

    def _future(self, batch: TensorDictBase, networks: ActorCritic) -> Tensor:
        """Return the values of the next states by the target networks, ``[batch, 1]``.

        Values of earlier draws are used if no target network has moved since.
        """
        reached, known = batch.get(("next", "observation")), batch.get(KNOWN, None)
        if known is not None:
            moves = sum((self.count - 1) // every for every in self.target_every.values())
            places = (known[:, 1] != moves).nonzero().flatten()
            reached = reached[places]
        future = networks.future(reached, networks.target_actor.forward(reached).tanh_())
        if known is None:
            return future
        known[places] = torch.cat([future, torch.full_like(future, moves)], 1)
        return known[:, :1]
