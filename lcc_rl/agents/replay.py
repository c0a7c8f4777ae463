"""The loop of off-policy agents: play a batch of episodes, learning from a replay buffer."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.collectors import BaseCollector, Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer

from lcc_rl.agents.actor import ACTION, OBSERVATION, shared_policy
from lcc_rl.agents.agent import derived_seed
from lcc_rl.agents.checks import check_batch, check_learner
from lcc_rl.agents.loop import REPORTED, TrainingLoop, episode_statistics
from lcc_rl.agents.off_policy import OffPolicy
from lcc_rl.envs import StringCollector
from lcc_rl.io.tensors import check_like
from lcc_rl.pieces.rewards import REWARD

# What is learned from, as the environment names it and as the losses do.
LEARNED_FROM = {
    OBSERVATION: ("observation",),
    ACTION: ("action",),
    ("next", *OBSERVATION): ("next", "observation"),
    ("next", *REWARD): ("next", "reward"),
    ("next", "done"): ("next", "done"),
    ("next", "terminated"): ("next", "terminated"),
}

# Steps of an environment from which on compiling it, which takes 5 to 10 s, pays for itself.
WORTH_COMPILING = 40_000


class Trainer(TrainingLoop[OffPolicy]):
    """Trains an off-policy agent and keeps its record; arguments as of :class:`TrainingLoop`."""

    advice = "Lower agent.critic_lr or agent.actor_lr"

    def _prepare(self) -> None:
        agent, env = self.agent, self.env
        self.exploration = agent.noise.to(env.device or "cpu")
        self.sampler = torch.Generator()
        self.buffer = ReplayBuffer(
            storage=LazyTensorStorage(agent.buffer_size, device=env.device or "cpu"),
            batch_size=agent.batch_size,
            generator=self.sampler,
        )

    def _source(self) -> BaseCollector:
        return self._collector(self.settings.segment, self._compiled())

    def _collector(self, steps: int, compiled: bool) -> BaseCollector:
        policy = TensorDictSequential(shared_policy(self.agent.policy), self.exploration)
        frames = steps * self.env.batch_size.numel()
        if self.settings.collector == "torchrl":
            how = {"total_frames": -1, "auto_register_policy_transforms": False}
            return Collector(self.env, policy, frames_per_batch=frames, **how)
        keys = (*LEARNED_FROM, *REPORTED)
        return StringCollector(
            self.env, policy, frames_per_batch=frames, keys=keys, compiled=compiled
        )

    def _compiled(self) -> bool:
        """Whether to compile the environment: if left open, where the whole training pays for it.

        The whole, not what remains, so that a resumed training computes what it would have.
        """
        if self.settings.compiled is not None:
            return self.settings.compiled
        return self.iterations * self.horizon >= WORTH_COMPILING

    def _iterate(self, collector: BaseCollector) -> dict[str, float]:
        """Play one batch of episodes, learning after every segment of them."""
        share = self.iteration / self.iterations
        sigma = self.agent.exploration.sigma(share, self.updates)
        rate = self.agent.anneal(share)
        self.env.set_seed(derived_seed(self.seed, self.iteration, "episodes"))
        self.sampler.manual_seed(derived_seed(self.seed, self.iteration, "replay"))
        collector.reset()
        segments = iter(collector)
        played, losses, spent = [], [], [0.0, 0.0]
        for part in range(self.horizon // self.settings.segment):
            begun = time.perf_counter()
            self.exploration.sigma.fill_(self.agent.exploration.sigma(share, self.updates))
            batch = self._collect(segments, part * self.settings.segment)
            new = transitions(batch)
            self.buffer.extend(new)
            played.append(batch.select(*REPORTED))
            collected = time.perf_counter()
            before = self.iteration * (self.horizon // self.settings.segment) + part
            losses.append(self._learn(before * len(new), len(new)))
            check_learner(self.agent.policy, losses[-1], self.advice)
            spent[0] += collected - begun
            spent[1] += time.perf_counter() - collected
        episodes = torch.cat(played, dim=1)
        learned = len(new) * len(played)
        self.iteration += 1
        row = {
            "iteration": float(self.iteration),
            "episodes": float(self.iteration * self.env.batch_size[0]),
            "transitions": float(self.iteration * learned),
            "updates": float(self.updates),
            "exploration_sigma": sigma,
            "learning_rate": rate,
            **episode_statistics(episodes),
            **{name: sum(loss[name] for loss in losses) / len(losses) for name in losses[0]},
        }
        self._record(row, *spent)
        self._keep_best()
        return row

    def _keep_best(self) -> None:
        """Keep the policy if no window of episodes since learning began had a higher reward."""
        window = (self.agent.best_window or 0) // self.settings.environments
        recent = self.rows[-window:]
        if not window or len(recent) < window or not recent[0]["updates"]:
            return
        score = sum(row["episode_reward"] for row in recent) / window
        if self.best is None or score > self.best["score"]:
            state = self.agent.policy.state_dict()
            weights = {name: value.clone() for name, value in state.items()}
            self.best = {"score": score, "iteration": self.iteration, "weights": weights}

    def _collect(self, segments: Iterator[TensorDictBase], begun: int) -> TensorDictBase:
        """Return the next segment, after so many steps, all of it numbers.

        Raises:
            Diverged: naming the first entry that is not a number, its step and its episode.
        """
        batch = next(segments)
        check_batch(batch, begun)
        return batch

    def _learn(self, before: int, new: int) -> dict[str, float]:
        """Take the updates that are due after ``new`` transitions on top of those ``before``."""
        settings = self.agent
        ratio = settings.updates_per_transition
        ready = len(self.buffer) >= max(settings.batch_size, settings.learning_starts)
        count = int((before + new) * ratio) - int(before * ratio) if ready else 0
        sums = {"loss_actor": torch.zeros(()), "loss_value": torch.zeros(())}
        draw = draws(self.buffer, self.sampler)
        for _ in range(count):
            losses = self.agent.update(next(draw))
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
        self.buffer.set_rng(self.sampler)  # loading gives the buffer a generator of its own


def draws(buffer: ReplayBuffer, generator: torch.Generator) -> Iterator[TensorDictBase]:
    """Draw batches of a replay buffer as its ``sample()`` does, all into the same tensors.

    A batch holds until the next one is drawn; the buffer is not to grow meanwhile.

    Args:
        buffer: draws with replacement, each transition as likely as any other.
        generator: the buffer's own; the numbers are those that ``sample()`` would draw.

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


def transitions(batch: TensorDictBase) -> TensorDictBase:
    """Return what is learned from a batch ``[environments, steps]``, one transition a row.

    Every automated vehicle's is a transition of its own, ``[environments × steps × A]``; all of
    them end when the episode does.
    """
    shape = batch.get(("next", *REWARD)).shape[:-1]
    rows = TensorDict(batch_size=[shape.numel()], device=batch.device)
    for source, target in LEARNED_FROM.items():
        entry = batch.get(source)
        if entry.ndim == len(shape):
            entry = entry.unsqueeze(-2).expand(*shape, 1)
        rows.set(target, entry.reshape(-1, entry.shape[-1]))
    return rows
