"""Policy gradient through the simulator itself: back-propagation through time.

The environment is differentiable, so the gradient of the return by the policy's weights need not
be estimated from samples. Rewards with thresholds have none; smooth stand-ins take their place in
the objective (:mod:`lcc_rl.pieces.surrogates`), while the record keeps the literal terms. The
gradient may be cut into segments, each ended by a learned value (short-horizon actor-critic, Xu
et al., "Accelerated policy learning with parallel differentiable simulation", ICLR 2022).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import TransformedEnv

from lcc_rl.agents.loop import (
    REPORTED,
    TrainingLoop,
    anneal,
    check_final_share,
    derived_seed,
    episode_statistics,
)
from lcc_rl.config import TrainingConfig, build, require
from lcc_rl.envs.unroll import Unrolled
from lcc_rl.errors import require_positive
from lcc_rl.pieces.base import as_tuple
from lcc_rl.pieces.rewards import TERMS, RewardTerm
from lcc_rl.policies.actor import make_actor, seeded_mlp

log = logging.getLogger("lcc_rl")

# Iterations from which on compiling the simulator pays for itself.
WORTH_COMPILING = 100


class Analytic:
    """A policy, its optimizer, the objective's stand-ins and, where asked for, a value.

    Args:
        observation_size: entries of the observation.
        action_size: entries of the action.
        seed: seed of the initial weights.
        time_step: duration of a step [s], for terms of the objective that need it.
        hidden: sizes of the ReLU layers of policy and value network.
        learning_rate: of the policy at the start; it falls along half a cosine.
        final_share: share of it that is left at the end.
        clip_norm: gradients longer than this are shortened to it; through 300 steps of traffic
            they can become arbitrarily long.
        gamma: discount.
        surrogates: nodes of reward terms that take the place of those of the same name in the
            objective; their weights multiply the terms' own. Those of terms that the reward
            lacks are ignored.
        regularizers: nodes of reward terms that belong to the objective only.
        bootstrap: learn a value and add it at the end of every segment; without it the segment is
            all that counts, and should be the whole episode.
        value_lr: learning rate of the value network.
        td_lambda: weight of longer returns in the value's targets.
        tau: share by which the value's target network follows at every update.
        compiled: compile the step of the simulator; None: where the training is long enough to
            pay for it. Without a compiler the plain step is used.
        device: where the networks live.

    Raises:
        ConfigError: if a setting is out of range.
    """

    learns: ClassVar[bool] = True

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        seed: int,
        time_step: float,
        hidden: Sequence[int] = (200, 100, 50),
        learning_rate: float = 3e-3,
        final_share: float = 0.05,
        clip_norm: float = 1.0,
        gamma: float = 0.998,
        surrogates: dict[str, Any] | None = None,
        regularizers: dict[str, Any] | None = None,
        bootstrap: bool = True,
        value_lr: float = 1e-3,
        td_lambda: float = 0.95,
        tau: float = 0.05,
        compiled: bool | None = None,
        device: str = "cpu",
    ) -> None:
        require(0.0 < gamma <= 1.0, f"agent.gamma must lie in (0, 1], got {gamma}")
        require(not bootstrap or gamma < 1.0, "agent.bootstrap needs agent.gamma below 1")
        require(0.0 <= td_lambda <= 1.0, f"agent.td_lambda must lie in [0, 1], got {td_lambda}")
        require(0.0 < tau <= 1.0, f"agent.tau must lie in (0, 1], got {tau}")
        require_positive(
            "agent", learning_rate=learning_rate, clip_norm=clip_norm, value_lr=value_lr
        )
        check_final_share(final_share)
        self.final_share, self.clip_norm = final_share, clip_norm
        self.gamma, self.td_lambda, self.tau = gamma, td_lambda, tau
        self.bootstrap, self.compiled = bootstrap, compiled
        self.surrogates = _terms("surrogates", surrogates, time_step, device)
        self.regularizers = _terms("regularizers", regularizers, time_step, device)
        self.policy: TensorDictModuleBase = make_actor(
            observation_size, action_size, hidden, seed
        ).to(device)
        self.value = seeded_mlp(observation_size, 1, hidden, seed + 1).to(device)
        self.target = seeded_mlp(observation_size, 1, hidden, seed + 1).to(device)
        self.optimizer = torch.optim.Adam(
            self.policy.parameters(), lr=learning_rate, betas=(0.9, 0.99)
        )
        self.value_optimizer = torch.optim.Adam(self.value.parameters(), lr=value_lr)

    def objective(self, terms: Sequence[RewardTerm]) -> list[tuple[RewardTerm, float]]:
        """Return what is maximised in place of the reward's terms, and each one's factor."""
        own = self.surrogates
        chosen = [
            (own[term.name], term.weight) if term.name in own else (term, 1.0) for term in terms
        ]
        return chosen + [(term, 1.0) for term in self.regularizers.values()]

    def anneal(self, share: float) -> float:
        """Set and return the learning rate after this share of the training."""
        return anneal([self.optimizer], share, self.final_share)

    def update(self, rewards: Tensor, running: Tensor, observation: Tensor) -> dict[str, Tensor]:
        """Take one gradient step on the policy, and one on the value where it is learned.

        Args:
            rewards: the objective at each step of a segment, ``[batch, steps]``, zero where an
                episode is over; with their graph back to the policy's weights.
            running: whether each episode goes on after each step, ``[batch, steps]``.
            observation: at each of the segment's moments, ``[batch, steps + 1, observations]``,
                likewise.

        Returns:
            The loss and the length of its gradient before clipping, and the value's loss.
        """
        steps = rewards.shape[1]
        discounts = self.gamma ** torch.arange(steps, device=rewards.device)
        returns = (rewards * discounts).sum(1)
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
        with torch.no_grad():
            ahead = self.target(observation[:, 1:]).squeeze(-1) * running
            wanted, future = torch.empty_like(rewards), ahead[:, -1]
            for step in range(rewards.shape[1] - 1, -1, -1):
                mixed = (1.0 - self.td_lambda) * ahead[:, step] + self.td_lambda * future
                future = rewards[:, step] + self.gamma * mixed * running[:, step]
                wanted[:, step] = future
        # What follows a collision is no state of any episode.
        begun = torch.cat([torch.ones_like(running[:, :1]), running[:, :-1]], 1)
        error = (self.value(observation[:, :-1]).squeeze(-1) - wanted) * begun
        loss = error.square().mean()
        self.value_optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.value_optimizer.step()
        with torch.no_grad():
            pairs = zip(self.target.parameters(), self.value.parameters(), strict=True)
            for target, online in pairs:
                target.lerp_(online, self.tau)
        return loss.detach()

    def state_dict(self) -> dict[str, Any]:
        """Return everything that :meth:`load_state_dict` needs to go on bit for bit."""
        return {name: part.state_dict() for name, part in self._parts().items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for name, part in self._parts().items():
            part.load_state_dict(state[name])

    def _parts(self) -> dict[str, Any]:
        own = {"policy": self.policy, "optimizer": self.optimizer}
        if self.bootstrap:
            learned = (self.value, self.target, self.value_optimizer)
            own |= dict(zip(("value", "target", "value_optimizer"), learned, strict=True))
        return own


def _terms(
    where: str, nodes: dict[str, Any] | None, time_step: float, device: str
) -> dict[str, RewardTerm]:
    return {
        name: build(node, f"agent.{where}.{name}", name=name, time_step=time_step).to(device)
        for name, node in (nodes or {}).items()
    }


class GradientTrainer(TrainingLoop):
    """Trains by the simulator's gradient; arguments as of :class:`TrainingLoop`.

    A segment of the settings is the stretch through which gradients flow; the whole episode where
    it is as long as the horizon.
    """

    advice = "Lower agent.learning_rate, agent.value_lr or agent.clip_norm"
    watched = "loss_actor"

    def __init__(
        self,
        agent: Analytic,
        env: TransformedEnv,
        settings: TrainingConfig,
        seed: int,
        folder: Path,
        identity: str,
    ) -> None:
        super().__init__(agent, env, settings, seed, folder, identity)
        self.terms = [piece for piece in env.transform if isinstance(piece, RewardTerm)]
        self.objective = agent.objective(self.terms)
        if not agent.bootstrap and settings.segment < self.horizon:
            log.warning(
                "agent.bootstrap=false with training.segment=%d: nothing after a segment counts; "
                "say training.segment=%d for the gradient of whole episodes",
                settings.segment,
                self.horizon,
            )

    def _source(self) -> Unrolled:
        compiled = self.agent.compiled
        if compiled is None:
            compiled = self.settings.compiled
        if compiled is None:
            compiled = self.iterations >= WORTH_COMPILING  # of the whole: resuming changes nothing
        return Unrolled(
            self.env,
            wanted=[key for term, _ in self.objective for key in term.in_keys],
            observed=[("reward",), *((TERMS, term.name) for term in self.terms)],
            compiled=compiled,
        )

    def _iterate(self, source: Unrolled) -> dict[str, float]:
        """Play one batch of episodes, with a gradient step after every segment of them."""
        rate = self.agent.anneal(self.iteration / self.iterations)
        self.env.set_seed(derived_seed(self.seed, self.iteration, "episodes"))
        state = source.start()
        running = torch.ones(self.env.batch_size[0], 1, device=self.env.device)
        played, losses, spent = [], [], [0.0, 0.0]
        for _ in range(self.horizon // self.settings.segment):
            begun = time.perf_counter()
            state, record = source.play(state, self.agent.policy.module, self.settings.segment)
            data = source.assemble(record)
            collected = time.perf_counter()
            running, result = self._learn(data, running[:, -1:])
            losses.append(result)
            played.append(data.detach().select(*REPORTED))
            state = {key: value.detach() for key, value in state.items()}
            spent[0] += collected - begun
            spent[1] += time.perf_counter() - collected
        self.iteration += 1
        self.updates += len(losses)
        episodes = torch.cat(played, dim=1)
        row = {
            "iteration": float(self.iteration),
            "episodes": float(self.iteration * self.env.batch_size[0]),
            "transitions": float(self.iteration * episodes.numel()),
            "updates": float(self.updates),
            "learning_rate": rate,
            **episode_statistics(episodes),
            **{name: sum(float(x[name]) for x in losses) / len(losses) for name in losses[0]},
        }
        self._record(row, *spent)
        return row

    def _learn(self, data: TensorDictBase, running: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Take a gradient step on a segment; return which episodes go on after each step."""
        crashed = data["next", "terminated"].squeeze(-1).cumsum(1) > 0
        after = running * ~crashed
        before = torch.cat([running, after[:, :-1]], 1)
        total = torch.stack([factor * self._score(term, data) for term, factor in self.objective])
        moments = torch.cat([data["observation"], data["next", "observation"][:, -1:]], 1)
        return after, self.agent.update(total.sum(0) * before, after, moments)

    def _score(self, term: RewardTerm, data: TensorDictBase) -> Tensor:
        """Return a term of the objective at every step of a segment, ``[batch, steps]``."""
        entries = [data.get(("next", *as_tuple(key))) for key in term.in_keys]
        return term.compute(*entries).squeeze(-1)
