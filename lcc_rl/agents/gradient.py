"""The loop of the analytic agent: play a batch of episodes with its gradient, and learn from it."""

from __future__ import annotations

import logging
import time
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.agents.analytic import Analytic
from lcc_rl.agents.checks import check_batch
from lcc_rl.agents.loop import REPORTED, derived_seed, episode_statistics
from lcc_rl.agents.simulated import SimulatedLoop
from lcc_rl.agents.sizes import COPIES, Footprint, nbytes
from lcc_rl.envs.rollout import OBSERVATION, DifferentiableRollout
from lcc_rl.envs.step import pieces_of
from lcc_rl.pieces.base import State, next_key

log = logging.getLogger("lcc_rl")

# Iterations from which on compiling the simulator pays for itself.
WORTH_COMPILING = 100


class GradientTrainer(SimulatedLoop[Analytic]):
    """Trains by the simulator's gradient; arguments as of :class:`TrainingLoop`.

    A segment of the settings is the stretch through which gradients flow; the whole episode where
    it is as long as the horizon.
    """

    advice = "Lower agent.learning_rate, agent.value_lr or agent.clip_norm"
    watched = "loss_actor"

    def _prepare(self) -> None:
        super()._prepare()
        if not self.agent.settings.bootstrap and self.settings.segment < self.horizon:
            log.warning(
                "agent.bootstrap=false with training.segment=%d: nothing after a segment counts; "
                "say training.segment=%d for the gradient of whole episodes",
                self.settings.segment,
                self.horizon,
            )

    def _source(self) -> DifferentiableRollout:
        compiled = self.agent.settings.compiled
        if compiled is None:
            compiled = self.settings.compiled
        if compiled is None:
            compiled = self.iterations >= WORTH_COMPILING  # of the whole: resuming changes nothing
        return self._rollout(compiled)

    def footprint(self) -> Footprint:
        source, own = self._rollout(), self.agent.settings
        # The first steps lack the gradient that reaches the later ones through the motion.
        (less, _, _), (more, data, state) = (self._played(source, steps) for steps in (2, 3))
        count = self.env.batch_size.numel()
        vehicles = data.get(OBSERVATION).shape[-2]
        layers = 4 * sum(own.hidden) * COPIES * vehicles / own.value_every if own.bootstrap else 0
        return Footprint(
            # Twice the graph: what it holds, and the gradients on the way back.
            step=(2 * (more - less) + COPIES * data.bytes() / 3) / count + layers,
            reported=data.select(*REPORTED).bytes() / 3 / count,
            moment=nbytes(state.values()) / count,
            fixed={},
        )

    def _played(
        self, source: DifferentiableRollout, steps: int
    ) -> tuple[int, TensorDictBase, State]:
        """Play some steps; return the bytes that their graph holds, and what was played."""
        held: dict[int, int] = {}  # by the place in memory

        def keep(tensor: Tensor) -> Tensor:
            held[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            state, record = source.play(source.start(), self.agent.policy.module, steps)
            data = source.assemble(record)
            # Kept until all are counted: what is freed would give its place to another.
            total = self.objective.score(data, checked=False)
        assert total.requires_grad
        return sum(held.values()), data.detach(), state

    def _iterate(self, source: DifferentiableRollout) -> dict[str, float]:
        """Play one batch of episodes, with a gradient step after every segment of them."""
        rate = self.agent.anneal(self.iteration / self.iterations)
        self.env.set_seed(derived_seed(self.seed, self.iteration, "episodes"))
        state = source.start()
        running = torch.ones(self.env.batch_size[0], 1, 1, device=self.env.device)
        played, losses, spent = [], [], [0.0, 0.0]
        missed: list[dict[str, float]] = []
        for _ in range(self.horizon // self.settings.segment):
            begun = time.perf_counter()
            state, record = source.play(state, self.agent.policy.module, self.settings.segment)
            data = source.assemble(record)
            check_batch(data, pieces_of(self.env))
            collected = time.perf_counter()
            running, result = self._learn(data, running[:, -1:])
            losses.append(result)
            missed.append(self.objective.missed(data, running))
            played.append(data.detach().select(*REPORTED))
            state = {key: value.detach() for key, value in state.items()}
            spent[0] += collected - begun
            spent[1] += time.perf_counter() - collected
        self.iteration += 1
        self.updates += len(losses)
        shares = _mean(missed)
        limits = self._limits_row(shares)
        self.objective.limits.update(shares)
        episodes = torch.cat(played, dim=1)
        row = {
            "iteration": float(self.iteration),
            "episodes": float(self.iteration * self.env.batch_size[0]),
            "transitions": float(self.iteration * episodes.numel()),
            "updates": float(self.updates),
            "learning_rate": rate,
            **episode_statistics(episodes),
            **_mean(losses),
            **limits,
        }
        self._record(row, *spent)
        return row

    def _learn(self, data: TensorDictBase, running: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Take a gradient step on a segment; return which episodes go on after each step."""
        crashed = data["next", "terminated"].cumsum(1) > 0
        after = running * ~crashed
        before = torch.cat([running, after[:, :-1]], 1)
        ahead = data.get(next_key(OBSERVATION))
        moments = torch.cat([data.get(OBSERVATION), ahead[:, -1:]], 1)
        return after, self.agent.update(self.objective.score(data) * before, after, moments)


def _mean(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Return the mean of each entry."""
    return {name: sum(float(row[name]) for row in rows) / len(rows) for name in rows[0]}
