"""Policy gradient through the simulator itself: back-propagation through time.

The environment is differentiable, so the gradient of the return by the policy's weights need not
be estimated from samples. Rewards with thresholds have none; smooth surrogates take their place in
the objective (:mod:`lcc_rl.pieces.surrogates`), while the record keeps the literal terms. The
gradient may be cut into segments, each ended by a learned value (short-horizon actor-critic, Xu
et al., "Accelerated policy learning with parallel differentiable simulation", ICLR 2022).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import field
from typing import Annotated, Any

import torch
from pydantic import Field
from tensordict import TensorDictBase
from torch import Tensor, nn

from lcc_rl.agents.actor import seeded_mlp
from lcc_rl.agents.agent import Fraction, Scene, Schedule, anneal, derived_seed
from lcc_rl.agents.loop import REPORTED, TrainingLoop, mean_of
from lcc_rl.agents.objective import Aiming, Objective
from lcc_rl.envs.rollout import OBSERVATION, DifferentiableRollout
from lcc_rl.envs.step import check_batch, pieces_of
from lcc_rl.errors import require
from lcc_rl.pieces.base import REWARD, next_key
from lcc_rl.pieces.leader import PROFILE, NGSIMLeader
from lcc_rl.pieces.rewards import RewardTerm
from lcc_rl.settings import Count, LearningRate, NonNegative, Positive, Share

log = logging.getLogger("lcc_rl")

# Steps of a training from which compiling the simulator and its gradient, 25 to 40 s, pays off.
COMPILED_GRADIENT_STEPS = 10_000


class GradientLoop(TrainingLoop[Any]):
    """Trains by the simulator's gradient; arguments as for :class:`TrainingLoop`.

    Gradients flow through one segment, which may be the whole episode.
    """

    advice = "Lower agent.learning_rate, agent.value_lr or agent.clip_norm"
    watched = "loss_actor"

    def _prepare(self) -> None:
        self.terms = [piece for piece in pieces_of(self.env) if isinstance(piece, RewardTerm)]
        self.objective: Objective = self.agent.objective
        self.objective.replace(self.terms)
        leaders = [piece for piece in pieces_of(self.env) if isinstance(piece, NGSIMLeader)]
        self.objective.each.take(sum(len(piece.names) for piece in leaders))
        self.horizon -= self.agent.burn_in + self.agent.uncounted
        if not self.agent.bootstrap and self.settings.segment < self.horizon:
            log.warning(
                "agent.bootstrap=false with training.segment=%d: nothing after a segment counts; "
                "use training.segment=%d for the gradient of whole episodes",
                self.settings.segment,
                self.horizon,
            )

    def source(self) -> DifferentiableRollout:
        # The iterations are those of the whole training, so that resuming changes nothing.
        long = self.iterations * self.horizon >= COMPILED_GRADIENT_STEPS
        chosen = (self.agent.compiled, self.settings.compiled, long)
        return DifferentiableRollout(
            self.env,
            self.agent.policy.module,
            wanted=self.objective.wanted(self.env),
            observed=[REWARD, *(term.targets[0] for term in self.terms)],
            compiled=next(x for x in chosen if x is not None),
        )

    def iterate(self, source: DifferentiableRollout) -> dict[str, float]:
        """Play one batch of episodes with a gradient step after every segment."""
        rate = self.agent.anneal(self.iteration / self.iterations)
        self.env.set_seed(derived_seed(self.seed, self.iteration, "episodes"))
        state = source.skip(source.start(), self.agent.burn_in)
        self.objective.each.begin(state.get(PROFILE))
        running = torch.ones(self.env.batch_size[0], 1, 1, device=self.env.device)
        if self.agent.uncounted:
            with torch.no_grad():
                state, record = source.play(state, self.agent.uncounted)
                crashed = source.assemble(record)["next", "terminated"]
            running = (~crashed.any(1, keepdim=True)).to(running)
        played, losses, spent = [], [], [0.0, 0.0]
        missed: list[dict[str, float]] = []
        each: list[dict[str, Tensor]] = []
        for _ in range(self.horizon // self.settings.segment):
            begun = time.perf_counter()
            state, record = source.play(state, self.settings.segment)
            data = source.assemble(record)
            check_batch(data)
            collected = time.perf_counter()
            running, result = self._learn(data, running[:, -1:])
            losses.append(result)
            missed.append(self.objective.missed(data, running))
            each.append(self.objective.missed_each(data, running))
            played.append(data.detach().select(*REPORTED))
            state = {key: value.detach() for key, value in state.items()}
            spent[0] += collected - begun
            spent[1] += time.perf_counter() - collected
        self.updates += len(losses)
        limits = self.objective.update(mean_of(missed))
        behind = {name: torch.stack([row[name] for row in each]).mean(0) for name in each[0]}
        limits |= self.objective.each.update(behind)
        count = sum(part.numel() for part in played)
        return self.record(played, losses, spent, count, {"learning_rate": rate}, limits)

    def _learn(self, data: TensorDictBase, running: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Take a gradient step on a segment; return which episodes continue, and the results."""
        crashed = data["next", "terminated"].cumsum(1) > 0
        after = running * ~crashed
        before = torch.cat([running, after[:, :-1]], 1)
        ahead = data.get(next_key(OBSERVATION))
        moments = torch.cat([data.get(OBSERVATION), ahead[:, -1:]], 1)
        return after, self.agent.update(self.objective.score(data) * before, after, moments)


class Analytic(Aiming):
    """A policy, its optimizer, the objective's smooth terms and, if asked for, a value.

    Once started, ``policy`` is the module.
    """

    hidden: Sequence[Count] = (200, 100, 50)  # layers of a network
    # As limits, but behind each record of leaders by itself, each with a price of its own.
    limits_each: dict[str, Share | None] = field(default_factory=dict)
    learning_rate: LearningRate = 3e-3  # of the policy at the start
    final_lr_fraction: Fraction = 0.05  # of it that is left at the end
    schedule: Schedule = "cosine"  # how the learning rate falls
    # Gradients longer than this are shortened to it; through 300 steps of traffic they can become
    # arbitrarily long.
    clip_norm: Positive = 1.0
    gamma: Fraction = 0.998  # discount
    # Learn a value and add it at the end of every segment; without it the segment is all that
    # counts, and should be the whole episode.
    bootstrap: bool = True
    value_lr: LearningRate = 1e-3  # learning rate of the value network
    td_lambda: Annotated[float, Field(ge=0.0, le=1.0)] = 0.95  # weight of longer returns, per step
    # Steps between two states at which the value is learned: a tenth of a second apart they tell
    # hardly more than one of them. 1 takes all.
    value_every: Count = 5
    tau: Fraction = 0.05  # share by which the value's target network follows at every update
    # First seconds of every episode, which have no gradient and do not count, as in an evaluation:
    # a car may save there by opening its gap [s].
    warm_up: NonNegative = 0.0
    # Compile the step of the simulator; None: if the training is long enough to pay for it.
    compiled: bool | None = None

    loop = GradientLoop

    def validate(self) -> None:
        require(not self.bootstrap or self.gamma < 1.0, "agent.bootstrap needs agent.gamma below 1")

    def setup(self, scene: Scene) -> None:
        self.aim(scene)
        size, seed = scene.observation_size, scene.seed + 1
        self.uncounted = scene.world.steps(self.warm_up, "agent.warm_up")
        self.value, self.target = (
            seeded_mlp(size, 1, self.hidden, seed, self.activation).to(scene.device)
            for _ in range(2)
        )
        self.optimizer = torch.optim.Adam(
            [entry for entry in self.policy.parameters() if entry.requires_grad],
            lr=self.learning_rate,
            betas=(0.9, 0.99),
        )
        self.value_optimizer = torch.optim.Adam(self.value.parameters(), lr=self.value_lr)

    def anneal(self, share: float) -> float:
        """Set and return the learning rate after this share of the training."""
        return anneal([self.optimizer], share, self.final_lr_fraction, self.schedule)

    def update(self, rewards: Tensor, running: Tensor, observation: Tensor) -> dict[str, Tensor]:
        """Take one gradient step on the policy, and one on the value where it is learned.

        Args:
            rewards: the objective at each step of a segment, ``[batch, steps, A]``, zero where an
                episode is over; with their graph back to the policy's weights.
            running: whether each episode goes on after each step, ``[batch, steps, 1]``.
            observation: at each of the segment's moments, ``[batch, steps + 1, A, n]``, likewise.

        Returns:
            The loss and the length of its gradient before clipping, and the value's loss.
        """
        steps = rewards.shape[1]
        discounts = self.gamma ** torch.arange(steps, device=rewards.device)
        returns = (rewards * discounts.unsqueeze(-1)).sum(1)
        if self.bootstrap:
            last = self.target(observation[:, -1]).squeeze(-1) * running[:, -1]
            returns = returns + self.gamma**steps * last
        loss = -returns.mean()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.policy.parameters(), self.clip_norm)
        # A step along a gradient that is not a number would destroy the weights for good.
        if bool(torch.isfinite(norm)):
            self.optimizer.step()
        result = {"loss_actor": loss.detach(), "gradient_norm": norm.detach()}
        if self.bootstrap:
            result["loss_value"] = self._fit(rewards.detach(), running, observation.detach())
        return result

    def _fit(self, rewards: Tensor, running: Tensor, observation: Tensor) -> Tensor:
        """Take one step of the value towards the λ-returns of a segment and move its target."""
        steps = rewards.shape[1]
        begins = range(0, steps, self.value_every)
        ends = [*begins[1:], steps]
        gamma = self.gamma ** torch.arange(self.value_every, device=rewards.device).unsqueeze(-1)
        with torch.no_grad():
            after = running[:, [end - 1 for end in ends]]
            ahead = self.target(observation[:, ends]).squeeze(-1) * after
            wanted, future = rewards.new_empty(ahead.shape), ahead[:, -1]
            for place in range(len(ends) - 1, -1, -1):
                begin, end = begins[place], ends[place]
                length = end - begin
                mixed = torch.lerp(ahead[:, place], future, self.td_lambda**length)
                reward = (rewards[:, begin:end] * gamma[:length]).sum(1)
                future = reward + self.gamma**length * mixed * after[:, place]
                wanted[:, place] = future
        # What follows a collision is no state of any episode.
        begun = torch.cat([torch.ones_like(running[:, :1]), after[:, :-1]], 1)
        seen = observation[:, : steps : self.value_every]
        error = (self.value(seen).squeeze(-1) - wanted) * begun
        loss = error.square().mean()
        self.value_optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.value_optimizer.step()
        with torch.no_grad():
            pairs = zip(self.target.parameters(), self.value.parameters(), strict=True)
            for target, online in pairs:
                target.lerp_(online, self.tau)
        return loss.detach()

    def _parts(self) -> dict[str, Any]:
        own = {"policy": self.policy, "optimizer": self.optimizer, "limits": self.objective.limits}
        if self.objective.each.largest:
            own["limits_each"] = self.objective.each
        if self.bootstrap:
            learned = (self.value, self.target, self.value_optimizer)
            own |= dict(zip(("value", "target", "value_optimizer"), learned, strict=True))
        return own
