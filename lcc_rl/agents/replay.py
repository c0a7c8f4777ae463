"""The loop of off-policy agents, which learn from a replay buffer."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import BaseCollector

from lcc_rl.agents.agent import derived_seed
from lcc_rl.agents.collecting import (
    LIMITED,
    CollectingLoop,
    n_step_returns,
    of_decisions,
    transitions,
)
from lcc_rl.io.tensors import check_like
from lcc_rl.pieces.base import Key, as_key

REWARDED: Key = ("next", "reward")
KNOWN: Key = ("known",)  # value of the next state, and the number of moves of the target networks


class ReplayLoop(CollectingLoop[Any]):
    """Trains an off-policy agent; the prices of limits are those of the draw, not of the storing.

    Arguments as for :class:`lcc_rl.agents.loop.TrainingLoop`.
    """

    advice = "Lower agent.critic_lr or agent.actor_lr"

    def _prepare(self) -> None:
        super()._prepare()
        self.sampler = torch.Generator()
        sizes = self.agent.buffer_size, self.agent.batch_size
        self.buffer = Replay(*sizes, self.sampler, self.env.device or "cpu")

    def explore(self, share: float) -> float:
        sigma = self.agent.exploration.sigma(share, self.updates)
        self.noise.sigma.fill_(sigma)
        return float(sigma)

    def iterate(self, collector: BaseCollector) -> dict[str, float]:
        self.sampler.manual_seed(derived_seed(self.seed, self.iteration, "replay"))
        row = super().iterate(collector)
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
        settings = self.agent
        new = transitions(n_step_returns(batch, settings.n_step, settings.gamma))
        kept = of_decisions(new)
        if settings.lasting:
            kept.set(KNOWN, torch.full((len(kept), 2), -1.0, device=kept.device))
        kept.set(REWARDED, kept.get(REWARDED) - self._limited(kept))
        self.buffer.extend(kept)
        ratio = settings.updates_per_transition
        ready = len(self.buffer) >= max(settings.batch_size, settings.learning_starts)
        count = int((before + len(new)) * ratio) - int(before * ratio) if ready else 0
        sums = {"loss_actor": torch.zeros(()), "loss_value": torch.zeros(())}
        for _ in range(count):
            drawn = self.buffer.draw()
            drawn.set_(REWARDED, settings.scaled(drawn.get(REWARDED) + self._limited(drawn)))
            losses = settings.update(drawn)
            self.buffer.note()
            sums = {name: total + losses[name] for name, total in sums.items()}
        self.updates += count
        return {name: float(total) / max(count, 1) for name, total in sums.items()}

    def _scored(self, batch: TensorDictBase) -> dict[str, float]:
        shares = super()._scored(batch)
        if shares:
            batch.set(LIMITED, self.agent.objective.at_price_one(batch))
        return shares

    def _limited(self, rows: TensorDictBase) -> Tensor | float:
        """Return the part of the rewards with limits at present prices, ``[rows, 1]``."""
        limited = rows.get(LIMITED, None)
        if limited is None:
            return 0.0
        return (limited * self.agent.objective.prices(limited)).sum(-1, keepdim=True)

    def _memory(self) -> dict[str, Any]:
        return {"buffer": self.buffer.state_dict(), "best": self.best}

    def _remember(self, memory: dict[str, Any]) -> None:
        self.best = memory["best"]
        if self.best is not None:
            check_like(self.best["weights"], self.agent.policy.state_dict(), "best")
        self.buffer.load_state_dict(memory["buffer"])


class Replay:
    """The latest transitions, from which batches are drawn uniformly with replacement.

    The draws equal those of TorchRL's ``ReplayBuffer`` with the same generator. All are written
    into the same tensors.

    Args:
        size: number of transitions that it holds.
        batch: transitions of a draw.
        generator: generator of the draws.
        device: device of the transitions.
    """

    def __init__(self, size: int, batch: int, generator: torch.Generator, device: Any) -> None:
        self.size, self.generator, self.device = size, generator, device
        self.count = 0  # transitions that were added, also those replaced since
        self.index = torch.empty(batch, dtype=torch.long, device=generator.device)
        self.places = self.index
        self.drawn = TensorDict(batch_size=[batch])
        self.columns: dict[Key, tuple[Tensor, Tensor]] = {}  # all rows, and those of a batch

    def __len__(self) -> int:
        return min(self.count, self.size)

    def extend(self, new: TensorDictBase) -> None:
        """Add transitions, ``[rows]``; the oldest ones are replaced."""
        added = {as_key(key): value[-self.size :] for key, value in new.items(True, True)}
        if not self.columns:
            self._make({key: x.new_zeros(self.size, *x.shape[1:]) for key, x in added.items()})
        self.count += len(new)
        places = torch.arange(max(self.count - self.size, self.count - len(new)), self.count)
        places = (places % self.size).to(self.device)
        for key, value in added.items():
            self.columns[key][0].index_copy_(0, places, value)

    def _make(self, columns: dict[Key, Tensor]) -> None:
        for key, rows in columns.items():
            column = rows.to(self.device)
            drawn = column.new_empty(len(self.index), *column.shape[1:])
            self.columns[key] = column, drawn
            self.drawn.set(key, drawn)

    def draw(self) -> TensorDictBase:
        """Return transitions, ``[batch]``, which is valid until the next draw."""
        torch.randint(len(self), self.index.shape, generator=self.generator, out=self.index)
        self.places = self.index.to(self.device)
        for column, drawn in self.columns.values():
            torch.index_select(column, 0, self.places, out=drawn)
        return self.drawn

    def note(self) -> None:
        """Keep what the last batch contains under :data:`KNOWN`, if there is such an entry."""
        if KNOWN in self.columns:
            column, drawn = self.columns[KNOWN]
            column.index_copy_(0, self.places, drawn)

    def state_dict(self) -> dict[str, Any]:
        """Return the rows by their keys, joined by dots, and the number of transitions."""
        rows = {".".join(key): column for key, (column, _) in self.columns.items()}
        return {"count": self.count, "rows": rows}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        rows = state["rows"]
        if not all(len(column) == self.size for column in rows.values()):
            raise ValueError(f"the buffer does not hold {self.size} transitions")
        self.count, self.columns = state["count"], {}
        self._make({tuple(key.split(".")): column for key, column in rows.items()})
