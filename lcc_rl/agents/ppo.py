"""Proximal policy optimization with TorchRL's loss and advantage (Schulman et al., 2017)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import torch
from pydantic import Field
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.modules import ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from lcc_rl.agents.actor import seeded_mlp
from lcc_rl.agents.agent import Fraction, Scene, Schedule, anneal, derived_seed
from lcc_rl.agents.collecting import CollectingLoop, of_decisions, transitions
from lcc_rl.agents.sac import SampledAction, tanh_gaussian
from lcc_rl.agents.sampling import Sampling
from lcc_rl.pieces.base import REWARD
from lcc_rl.settings import Count, LearningRate, NonNegative, Positive, Share

LOG_PROB = "action_log_prob"  # the key in TorchRL's loss


class Gaussian(nn.Module):
    """Mean and constant standard deviation of the action before the tanh."""

    def __init__(self, mean: nn.Module, sigma: float) -> None:
        super().__init__()
        self.mean, self.log_sigma = mean, nn.Parameter(torch.tensor([sigma]).log())

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return both, each ``[*batch, 1]``."""
        mean = self.mean(observation)
        return mean, self.log_sigma.exp().expand_as(mean)


class OnPolicyLoop(CollectingLoop[Any]):
    """Learns from each segment once; arguments as for :class:`lcc_rl.agents.loop.TrainingLoop`."""

    advice = "Lower agent.learning_rate or agent.clip"

    def learn(self, batch: TensorDictBase, before: int) -> dict[str, float]:
        vehicles = batch.get(("next", *REWARD)).shape[2]
        # One row per vehicle, time last: advantages are computed along trajectories.
        rows = transitions(batch).reshape(*batch.shape, vehicles).permute(0, 2, 1)
        rows.set(("next", "reward"), self.agent.scaled(rows.get(("next", "reward"))))
        losses = self.agent.update(rows.reshape(-1, batch.shape[1]).contiguous())
        self.updates += 1
        return {name: float(value) for name, value in losses.items()}


class PPO(Sampling):
    """A Gaussian policy and a value network with clipped ratios; the stored policy is the mean."""

    gamma: Share = 0.99  # discount
    td_lambda: Annotated[float, Field(ge=0.0, le=1.0)] = 0.95  # weight of longer returns, per step
    hidden: Sequence[Count] = (64, 64)  # layers of policy and value
    learning_rate: LearningRate = 1e-3  # of both networks at the start
    final_lr_fraction: Fraction = 0.1  # final learning rate as a fraction of the initial one
    schedule: Schedule = "cosine"  # shape of the learning rates
    clip: Fraction = 0.2  # ratios of probabilities are clipped to 1 ± clip
    epochs: Count = 10  # passes over the transitions of a segment
    batch_size: Count = 1024  # transitions of a gradient step
    entropy: NonNegative = 0.0  # coefficient of the entropy bonus
    sigma: Positive = 0.5  # standard deviation before the tanh at the start
    clip_norm: Positive = 0.5  # largest norm of a gradient

    loop = OnPolicyLoop

    def setup(self, scene: Scene) -> None:
        size, device, kind = scene.observation_size, scene.device, self.activation
        learned = self.make_actor(scene)
        self.head = head = Gaussian(learned.module[0], self.sigma).to(device)
        self.noise = SampledAction(head, self.rule, self.bound)
        self.actor = tanh_gaussian(head)
        value = ValueOperator(seeded_mlp(size, 1, self.hidden, scene.seed + 1, kind)).to(device)
        self.advantage = GAE(gamma=self.gamma, lmbda=self.td_lambda, value_network=value)
        self.loss = ClipPPOLoss(
            self.actor,
            value,
            clip_epsilon=self.clip,
            entropy_bonus=self.entropy > 0.0,
            entropy_coeff=self.entropy,
            critic_coeff=1.0,
            loss_critic_type="l2",
            normalize_advantage=True,
        )
        self.weights = [*self.loss.parameters()]
        self.optimizer = torch.optim.Adam(self.weights, lr=self.learning_rate)

    def anneal(self, share: float) -> float:
        return anneal([self.optimizer], share, self.final_lr_fraction, self.schedule)

    def update(self, data: TensorDictBase) -> dict[str, Tensor]:
        """Learn from trajectories.

        Args:
            data: transitions, ``[trajectories, steps]``, with the keys of
                :data:`lcc_rl.agents.collecting.LEARNED_FROM`.

        Returns:
            The means of ``loss_actor`` and ``loss_value``, and the standard deviation ``sigma``.
        """
        with torch.random.fork_rng(devices=[]):  # for the shuffle and TorchRL's entropy
            torch.manual_seed(derived_seed(self.seed, self.count, "update"))
            self.count += 1
            with torch.no_grad():
                data = self.advantage(data)
                data[LOG_PROB] = self.actor.get_dist(data).log_prob(data["action"])
            rows = of_decisions(data.reshape(-1))
            shuffled = (torch.randperm(len(rows)) for _ in range(self.epochs))
            parts = (part for order in shuffled for part in order.split(self.batch_size))
            found = [self._step(rows[part]) for part in parts]
        actor, value = (torch.stack(each).mean() for each in zip(*found, strict=True))
        sigma = self.head.log_sigma.detach().exp().mean()
        return {"loss_actor": actor, "loss_value": value, "sigma": sigma}

    def _step(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        losses = self.loss(batch)
        actor, value = losses["loss_objective"], losses["loss_critic"]
        self.optimizer.zero_grad()
        (actor + value + losses.get("loss_entropy", 0.0)).backward()
        nn.utils.clip_grad_norm_(self.weights, self.clip_norm)
        self.optimizer.step()
        return actor.detach(), value.detach()

    def _parts(self) -> dict[str, Any]:
        return {**super()._parts(), **self._more()}
