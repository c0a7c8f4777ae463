"""Twin delayed deep deterministic policy gradient, TorchRL's loss (Fujimoto et al., 2018)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import TD3Loss

from lcc_rl.agents.agent import Scene
from lcc_rl.agents.fused import ActorCritic
from lcc_rl.agents.off_policy import OffPolicy
from lcc_rl.settings import Count, NonNegative


class TD3(OffPolicy):
    """DDPG with two Q networks, smoothed target actions and delayed updates of the policy."""

    policy_noise: NonNegative = 0.1  # standard deviation of the noise on target actions
    noise_clip: NonNegative = 0.25  # largest absolute value of this noise
    policy_delay: Count = 2  # updates of the Q networks per update of policy and targets

    critics = 2
    joint = False

    def setup(self, scene: Scene) -> None:
        super().setup(scene)
        loss = TD3Loss(
            self.actor,
            self.values,
            bounds=(-1.0, 1.0),
            policy_noise=self.policy_noise,
            noise_clip=self.noise_clip,
            loss_function="l2",
            delay_actor=True,
            delay_qvalue=True,
        )
        self._complete(loss, ("actor", "value"))
        self.last_actor = torch.zeros(())

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        networks = self.written
        value = self._value_by_loss(batch) if networks is None else self._value(batch, networks)
        self._step("value")
        self.count += 1
        if self.count % self.policy_delay == 0:
            self.last_actor = (
                self._actor_by_loss(batch) if networks is None else self._actor(batch, networks)
            )
            self._step("actor")
            self._follow("actor", "value")
        return {"loss_actor": self.last_actor, "loss_value": value}

    def _value_by_loss(self, batch: TensorDictBase) -> Tensor:
        with self._own_randomness():
            value, _ = self.loss.value_loss(batch)
        self._differentiate(value)
        return value.detach()

    def _actor_by_loss(self, batch: TensorDictBase) -> Tensor:
        actor, _ = self.loss.actor_loss(batch)
        self._differentiate(actor + self._penalty(batch))
        return actor.detach()

    @torch.no_grad()
    def _value(self, batch: TensorDictBase, networks: ActorCritic) -> Tensor:
        """Write the gradient of the Q networks' loss; return the loss."""
        after = batch.get("next")
        reached = after.get("observation")
        action = networks.target_actor.forward(reached).tanh_()
        (noise,) = self._noise(action, 1)
        noise.mul_(self.policy_noise).clamp_(-self.noise_clip, self.noise_clip)
        action.add_(noise).clamp_(-1.0, 1.0)
        wanted = networks.wanted(batch, networks.future(reached, action))
        values = networks.evaluate(batch.get("observation"), batch.get("action"))
        return networks.critic_step(values, wanted)

    @torch.no_grad()
    def _actor(self, batch: TensorDictBase, networks: ActorCritic) -> Tensor:
        """Write the gradient of the policy's loss, by the first Q network; return the loss."""
        seen = batch.get("observation")
        raw = networks.actor.forward(seen)
        action = raw.tanh()
        (value,) = networks.evaluate(seen, action, 1)
        networks.actor_step(raw, action)
        return -value.mean()

    def state_dict(self) -> dict[str, object]:
        return {**super().state_dict(), "last_actor": self.last_actor}

    def load_state_dict(self, state: dict[str, object]) -> None:
        super().load_state_dict(state)
        last = state["last_actor"]
        assert isinstance(last, Tensor)
        self.last_actor = last
