"""The loop of the analytic agent, which plays episodes with their gradient."""

from __future__ import annotations

import logging
import time
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.agents.agent import derived_seed
from lcc_rl.agents.checks import check_batch
from lcc_rl.agents.loop import REPORTED, TrainingLoop, mean_of
from lcc_rl.agents.objective import Objective
from lcc_rl.envs.rollout import OBSERVATION, DifferentiableRollout
from lcc_rl.envs.step import pieces_of
from lcc_rl.pieces.base import REWARD, next_key
from lcc_rl.pieces.leader import PROFILE, NGSIMLeader
from lcc_rl.pieces.rewards import RewardTerm

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

    def _source(self) -> DifferentiableRollout:
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

    def _iterate(self, source: DifferentiableRollout) -> dict[str, float]:
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
        return self._record(played, losses, spent, count, {"learning_rate": rate}, limits)

    def _learn(self, data: TensorDictBase, running: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Take a gradient step on a segment; return which episodes continue, and the results."""
        crashed = data["next", "terminated"].cumsum(1) > 0
        after = running * ~crashed
        before = torch.cat([running, after[:, :-1]], 1)
        ahead = data.get(next_key(OBSERVATION))
        moments = torch.cat([data.get(OBSERVATION), ahead[:, -1:]], 1)
        return after, self.agent.update(self.objective.score(data) * before, after, moments)
