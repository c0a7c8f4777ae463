"""Soft actor-critic with a learned temperature and TorchRL's loss (Haarnoja et al., 2018)."""

from __future__ import annotations

import math
from dataclasses import field
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.nn.functional import softplus
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss

from lcc_rl.agents.actor import ONE, action_noise, seeded_mlp
from lcc_rl.agents.agent import Scene
from lcc_rl.agents.fused import ActorCritic, Network
from lcc_rl.agents.off_policy import Exploration, OffPolicy
from lcc_rl.functional.random import stream_id
from lcc_rl.pieces.base import ACTION, OBSERVATION, SEED, STEP
from lcc_rl.settings import LearningRate, Number, Positive


class Head(nn.Module):
    """Mean and standard deviation of the action before the tanh.

    Args:
        mean: network before the tanh of the deterministic policy.
        spread: network of the logarithm of the standard deviation, clamped to [−5, 1].
    """

    def __init__(self, mean: nn.Module, spread: nn.Module) -> None:
        super().__init__()
        self.mean, self.spread = mean, spread

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return both, each ``[*batch, actions]``."""
        logarithm = -2.0 + 3.0 * torch.tanh(self.spread(observation))
        return self.mean(observation), logarithm.exp()


class SampledAction(TensorDictModuleBase):
    """Replaces the deterministic action by a draw from the policy's distribution.

    The draw is a function of the episode's seed and step, so it needs no random state.

    Args:
        head: the distribution; ``sigma`` multiplies its standard deviation.
        rule: its action is added.
        bound: largest action that is added to the rule's.
    """

    sigma: Tensor

    def __init__(self, head: nn.Module, rule: nn.Module | None = None, bound: float = 1.0) -> None:
        self.in_keys = [OBSERVATION, SEED, STEP]
        self.out_keys = [ACTION]
        super().__init__()
        self.head, self.rule, self.bound = head, rule, bound
        self.stream = stream_id("exploration")
        self.register_buffer("sigma", torch.tensor(1.0))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        seen = tensordict.get(OBSERVATION)
        mean, spread = self.head(seen)
        noise = action_noise(mean, tensordict, self.stream)
        action = (mean + self.sigma * spread * noise).tanh()
        action = action if self.rule is None else self.bound * action + self.rule(seen)
        return tensordict.set(ACTION, action.clamp(-ONE, ONE))


def tanh_gaussian(head: nn.Module) -> ProbabilisticActor:
    """Return TorchRL's actor of a Gaussian before the tanh; the head returns mean and deviation."""
    return ProbabilisticActor(
        TensorDictModule(head, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


class Sample(NamedTuple):
    """Actions drawn by :meth:`SAC._sample`; every entry ``[batch, 1]``."""

    mean: Tensor  # of the action before the tanh
    bend: Tensor  # tanh of the network of the standard deviation
    push: Tensor  # the noise times the standard deviation
    action: Tensor
    log_prob: Tensor


class SAC(OffPolicy):
    """Learns a distribution of actions and its temperature; its mean is the stored policy.

    Exploration is a factor on the policy's standard deviation.
    """

    exploration: Exploration = field(
        default_factory=lambda: Exploration(initial=1.0, final=1.0, decay_share=1.0)
    )
    alpha_init: Positive = 0.1  # temperature at the start
    alpha_lr: LearningRate = 1e-3  # learning rate of the temperature
    target_entropy: Number | None = None  # target of the entropy; None: −1 per action

    critics = 2

    def setup(self, scene: Scene) -> None:
        super().setup(scene)
        size, seed, device = scene.observation_size, scene.seed, scene.device
        spread = seeded_mlp(size, 1, self.hidden[-1:], seed + 2, self.activation).to(device)
        head = Head(self.actor.module[0], spread)
        self.noise = SampledAction(head, self.rule, self.bound)
        loss = SACLoss(
            tanh_gaussian(head),
            self.values,
            alpha_init=self.alpha_init,
            target_entropy=-1.0 if self.target_entropy is None else self.target_entropy,
            loss_function="l2",
            delay_qvalue=True,
        ).to(device)
        self._complete(loss, ("value",), (loss.log_alpha, self.alpha_lr))
        self.log_alpha = loss.log_alpha
        self.spread = Network([*spread.parameters()])

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        losses = self._losses(batch)
        self._step("all")
        self._follow("value")
        self.count += 1
        return losses

    def _by_loss(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Write the gradient by TorchRL's loss; return the losses."""
        with self._own_randomness():
            losses = self.loss(batch)
        actor, value = losses["loss_actor"], losses["loss_qvalue"]
        self._differentiate(actor + value + losses["loss_alpha"] + self._penalty(batch))
        return actor.detach(), value.detach()

    @torch.no_grad()
    def _by_hand(self, batch: TensorDictBase, networks: ActorCritic) -> tuple[Tensor, Tensor]:
        """Compute the gradient explicitly; policy and temperature use the old Q networks."""
        seen, after = batch.get("observation"), batch.get("next")
        reached, alpha = after.get("observation"), self.log_alpha.exp()
        whole = torch.full_like(after.get("reward"), -1.0 / len(seen))
        noise = self._noise(whole, 2)
        then = self._sample(reached, noise[0], networks)
        future = networks.future(reached, then.action)
        wanted = networks.wanted(batch, future.sub_(then.log_prob.mul_(alpha)))
        now = self._sample(seen, noise[1], networks)
        values = networks.evaluate(seen, batch.get("action"))
        loss_value = networks.critic_step(values, wanted)
        first, second = networks.evaluate(seen, now.action)
        loss_actor = (now.log_prob * alpha).sub_(torch.minimum(first, second)).mean()
        # The value of an action is the smaller one of both critics.
        chosen = whole * (first <= second)
        slope = networks.through_critics([chosen, whole - chosen], 1)
        self._learn_policy(now, slope, alpha, networks)
        entropy = now.log_prob.mean().add_(self.loss.target_entropy)
        self.log_alpha.grad.copy_(entropy.neg_())
        return loss_actor, loss_value

    def _sample(self, seen: Tensor, noise: Tensor, networks: ActorCritic) -> Sample:
        """Draw actions as ``TanhNormal`` does."""
        mean, bend = networks.actor.forward(seen), self.spread.forward(seen).tanh_()
        logarithm = bend.mul(3.0).sub_(2.0)
        push = logarithm.exp().mul_(noise)
        before = mean + push
        # log N(noise; 0, 1) − log of the standard deviation − log of the derivative of the tanh
        log_prob = noise.square().mul_(-0.5).sub_(logarithm).sub_(0.5 * math.log(2.0 * math.pi))
        log_slope = softplus(before.mul(-2.0)).add_(before).sub_(math.log(2.0)).mul_(-2.0)
        action = before.tanh_().clamp_(-ONE, ONE)
        return Sample(mean, bend, push, action, log_prob.sub_(log_slope))

    def _learn_policy(
        self, now: Sample, slope: Tensor, alpha: Tensor, networks: ActorCritic
    ) -> None:
        """Write the gradient of the policy from the derivative by its actions."""
        rows = len(slope)
        slope.mul_(now.action.square().neg_().add_(1.0))
        slope.addcmul_(now.action, alpha, value=2.0 / rows)
        spread = (slope * now.push).sub_(alpha, alpha=1.0 / rows)
        spread.mul_(now.bend.square().neg_().add_(1.0).mul_(3.0))
        self.spread.backward(spread)
        slope.add_(now.mean, alpha=2.0 * self.saturation / rows)
        networks.actor.backward(slope)
