"""The loop of off-policy agents, which learn from a replay buffer."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import BaseCollector
from torchrl.data import LazyTensorStorage, ReplayBuffer

from lcc_rl.agents.agent import derived_seed
from lcc_rl.agents.collecting import CollectingLoop, of_decisions, transitions
from lcc_rl.io.tensors import check_like


class ReplayLoop(CollectingLoop[Any]):
    """Trains an off-policy agent.

    Arguments as for :class:`lcc_rl.agents.loop.TrainingLoop`.
    """

    advice = "Lower agent.critic_lr or agent.actor_lr"

    def _prepare(self) -> None:
        super()._prepare()
        self.sampler = torch.Generator()
        self.buffer = ReplayBuffer(
            storage=LazyTensorStorage(self.agent.buffer_size, device=self.env.device or "cpu"),
            batch_size=self.agent.batch_size,
            generator=self.sampler,
        )

    def explore(self, share: float) -> float:
        sigma = self.agent.exploration.sigma(share, self.updates)
        self.noise.sigma.fill_(sigma)
        return float(sigma)

    def _iterate(self, collector: BaseCollector) -> dict[str, float]:
        self.sampler.manual_seed(derived_seed(self.seed, self.iteration, "replay"))
        row = super()._iterate(collector)
        self._keep_best()
        return row

    def _keep_best(self) -> None:
        """Keep the policy if its window of episodes has the highest reward so far."""
        window = (self.agent.best_window or 0) // self.settings.environments
        recent = self.rows[-window:]
        if not window or len(recent) < window or not recent[0]["updates"]:
            return
        score = sum(row["episode_reward"] for row in recent) / window
        if self.best is None or score > self.best["score"]:
            state = self.agent.policy.state_dict()
            weights = {name: value.clone() for name, value in state.items()}
            self.best = {"score": score, "iteration": self.iteration, "weights": weights}

    def learn(self, batch: TensorDictBase, before: int) -> dict[str, float]:
        """Make the updates that are due after a segment."""
        new, settings = transitions(batch), self.agent
        self.buffer.extend(of_decisions(new))
        ratio = settings.updates_per_transition
        ready = len(self.buffer) >= max(settings.batch_size, settings.learning_starts)
        count = int((before + len(new)) * ratio) - int(before * ratio) if ready else 0
        sums = {"loss_actor": torch.zeros(()), "loss_value": torch.zeros(())}
        for drawn in islice(draws(self.buffer, self.sampler), count):
            if settings.scale_rewards:
                drawn.set_(("next", "reward"), settings.scaled(drawn.get(("next", "reward"))))
            losses = settings.update(drawn)
            sums = {name: total + losses[name] for name, total in sums.items()}
        self.updates += count
        return {name: float(total) / max(count, 1) for name, total in sums.items()}

    def _memory(self) -> dict[str, Any]:
        return {"buffer": self.buffer.state_dict(), "best": self.best}

    def _remember(self, memory: dict[str, Any]) -> None:
        self.best = memory["best"]
        if self.best is not None:
            check_like(self.best["weights"], self.agent.policy.state_dict(), "best")
        self.buffer.load_state_dict(memory["buffer"])
        self.buffer.set_rng(self.sampler)  # loading replaces the buffer's generator


def draws(buffer: ReplayBuffer, generator: torch.Generator) -> Iterator[TensorDictBase]:
    """Draw batches of a replay buffer as its ``sample()`` does, all into the same tensors.

    A batch is valid until the next one is drawn; the buffer must not grow meanwhile.

    Args:
        buffer: a buffer that draws uniformly with replacement.
        generator: the buffer's generator; the draws equal those of ``sample()``.

    Yields:
        Transitions, ``[batch_size]``.
    """
    rows, size = buffer.storage[:], buffer.batch_size
    batch = rows[:size].clone()
    columns = [(rows.get(key), batch.get(key)) for key in rows.keys(True, True)]
    index = torch.empty(size, dtype=torch.long, device=generator.device)
    while True:
        torch.randint(len(rows), (size,), generator=generator, out=index)
        places = index.to(rows.device or "cpu")
        for source, target in columns:
            torch.index_select(source, 0, places, out=target)
        yield batch
