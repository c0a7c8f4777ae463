"""Twin delayed deep deterministic policy gradient, on TorchRL's loss (Fujimoto et al., 2018)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import TD3Loss

from lcc_rl.agents.agent import Scene
from lcc_rl.agents.off_policy import OffPolicy
from lcc_rl.settings import Count, NonNegative


class TD3(OffPolicy):
    """DDPG with two Q networks, smoothed target actions and a policy that is updated less often."""

    policy_noise: NonNegative = 0.1  # standard deviation of the noise on target actions
    noise_clip: NonNegative = 0.25  # its largest size
    policy_delay: Count = 2  # updates of the Q networks for each of policy and targets

    critics = 2

    def setup(self, scene: Scene) -> None:
        super().setup(scene)
        loss = TD3Loss(
            self.policy,
            self.values,
            bounds=(-1.0, 1.0),
            policy_noise=self.policy_noise,
            noise_clip=self.noise_clip,
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
        if self.count % self.policy_delay == 0:
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
