"""The loop of agents that learn from a collector's segments."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Mapping
from itertools import islice

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from tensordict.utils import expand_as_right
from torch import nn
from torchrl.collectors import BaseCollector, Collector

from lcc_rl.agents.actor import ONE, shared_policy
from lcc_rl.agents.agent import derived_seed
from lcc_rl.agents.checks import check_learner
from lcc_rl.agents.loop import REPORTED, AgentT, TrainingLoop, mean_of
from lcc_rl.agents.objective import Objective
from lcc_rl.envs import StringCollector
from lcc_rl.envs.step import pieces_of
from lcc_rl.errors import require
from lcc_rl.pieces.base import ACTION, OBSERVATION, REWARD, STEP, Key, next_key
from lcc_rl.pieces.rewards import RewardTerm

# Entries of transitions: their keys in the environment and in the losses.
LEARNED_FROM = {
    OBSERVATION: ("observation",),
    ACTION: ("action",),
    ("next", *OBSERVATION): ("next", "observation"),
    ("next", *REWARD): ("next", "reward"),
    ("next", "done"): ("next", "done"),
    ("next", "terminated"): ("next", "terminated"),
}

BEGINS = "begins"  # whether a transition begins with a decision, if actions are held
LIMITED: Key = ("next", "limited")  # terms with limits at price 1, if they are stored
STEPS_AHEAD = "steps_to_next_obs"  # decisions of a return before a value, TorchRL's key

# Steps of a training from which compiling the environment, 5 to 10 s, pays off.
COMPILED_TRAINING_STEPS = 40_000


class CollectingLoop(TrainingLoop[AgentT]):
    """Plays batches of episodes by the agent's policy and its exploration, ``agent.noise``.

    The noise is a module that changes ``("automated", "action")``, or None. A subclass defines
    :meth:`learn`; arguments as for :class:`TrainingLoop`.
    """

    def _prepare(self) -> None:
        noise = getattr(self.agent, "noise", self)
        require(
            noise is None or isinstance(noise, TensorDictModuleBase),
            f"agent: setup of {type(self.agent).__name__} must make noise, the exploration, such "
            "as GaussianExploration(0.3), or None",
        )
        self.every, self.rule, self.returns = self.agent.every, self.agent.rule, self.agent.returns
        self.skipped, rest = divmod(self.agent.burn_in, self.settings.segment)
        require(not rest, "training.segment must divide the steps of agent.humans_first")
        self.horizon -= self.agent.burn_in
        self.objective: Objective | None = self.agent.objective
        self.wanted: list[Key] = []
        if self.objective is not None and self.objective.differs:
            self.objective.replace([x for x in pieces_of(self.env) if isinstance(x, RewardTerm)])
            self.wanted = [next_key(key) for key in self.objective.wanted(self.env)]

    @abstractmethod
    def learn(self, batch: TensorDictBase, before: int) -> dict[str, float]:
        """Learn from a segment; return the means of the losses, ``loss_value`` among them.

        Args:
            batch: transitions, ``[environments, steps]``, with the keys of :data:`LEARNED_FROM`.
            before: number of transitions of earlier segments, over all vehicles.
        """

    def explore(self, share: float) -> float:
        """Set the exploration after this share of the training; return its standard deviation."""
        return 1.0

    def source(self) -> BaseCollector:
        noise = self.agent.noise or TensorDictModule(nn.Identity(), [ACTION], [ACTION])
        self.noise = noise.to(self.env.device or "cpu")
        return self._collector(self.settings.segment, self._compiled())

    def _collector(self, steps: int, compiled: bool) -> BaseCollector:
        policy = TensorDictSequential(shared_policy(self.agent.policy), self.noise)
        frames = steps * self.env.batch_size.numel()
        if self.settings.collector == "torchrl":
            how = {"total_frames": -1, "auto_register_policy_transforms": False}
            return Collector(self.env, policy, frames_per_batch=frames, **how)
        keys = (*LEARNED_FROM, *REPORTED, *[STEP] * (self.every > 1), *self.wanted)
        return StringCollector(
            self.env, policy, frames_per_batch=frames, keys=keys, compiled=compiled
        )

    def _compiled(self) -> bool:
        """Whether to compile the environment; by default if the whole training pays for it.

        The whole training counts, so that a resumed one computes the same.
        """
        if self.settings.compiled is not None:
            return self.settings.compiled
        return self.iterations * self.horizon >= COMPILED_TRAINING_STEPS

    def iterate(self, collector: BaseCollector) -> dict[str, float]:
        """Play one batch of episodes and learn after every segment."""
        share, steps = self.iteration / self.iterations, self.settings.segment
        sigma, rate = self.explore(share), self.agent.anneal(share)
        self.env.set_seed(derived_seed(self.seed, self.iteration, "episodes"))
        collector.reset()
        segments = islice(collector, self.skipped, None)  # checked as they are played
        played, losses, missed, spent = [], [], [], [0.0, 0.0]
        last = 0.0
        for part in range(self.horizon // steps):
            begun = time.perf_counter()
            self.explore(share)
            batch = next(segments)
            played.append(batch.select(*REPORTED))
            missed.append(self._scored(batch))
            batch = decisions(batch.exclude(*self.wanted), self.every)
            if self.rule is not None:  # the policy's part of the action
                own = (batch.get(ACTION) - self.rule(batch.get(OBSERVATION))) / self.agent.bound
                batch.set(ACTION, own.clamp(-ONE, ONE))
            rewards = batch.get(("next", *REWARD))
            if self.returns is not None:
                last = self.returns.add(rewards, batch.get(("next", "done")), last)
            collected, size = time.perf_counter(), rewards.numel()
            before = self.iteration * (self.horizon // steps) + part
            losses.append(self.learn(batch, before * size))
            require(
                isinstance(losses[-1], Mapping) and self.watched in losses[-1],
                f"{type(self).__name__}.learn must return numbers by name, {self.watched!r} among "
                f"them, got {losses[-1]!r}",
            )
            check_learner(self.agent.policy, losses[-1], self.advice)
            spent[0] += collected - begun
            spent[1] += time.perf_counter() - collected
        begin = {"exploration_sigma": sigma, "learning_rate": rate}
        limits = {} if self.objective is None else self.objective.update(mean_of(missed))
        return self.record(played, losses, spent, size * len(played), begin, limits)

    def _scored(self, batch: TensorDictBase) -> dict[str, float]:
        """Set the objective as the reward; return the share of the time beyond each limit."""
        if self.objective is None or not self.wanted:
            return {}
        batch.set(("next", *REWARD), self.objective.score(batch).unsqueeze(-1))
        return self.objective.missed(batch, torch.ones_like(batch.get(("next", "done"))))


def decisions(batch: TensorDictBase, every: int) -> TensorDictBase:
    """Return the transitions from one decision to the next, with the sums of the rewards.

    Args:
        batch: transitions of single steps, ``[environments, steps]``.
        every: steps for which an action is executed; divides the steps.
    """
    if every == 1:
        return batch
    parts = batch.unflatten(1, (batch.shape[1] // every, every))
    begun, reached = parts[:, :, 0], parts[:, :, -1].get("next").clone()
    ended = parts.get(("next", "done")).cumsum(2) > 0
    before = torch.cat([torch.zeros_like(ended[:, :, :1]), ended[:, :, :-1]], 2)  # by step
    for key in (REWARD, LIMITED[1:]):
        if (value := parts.get(("next", *key), None)) is not None:
            reached.set(key, (value * ~before.unsqueeze(-1)).sum(2))
    for flag in ("done", "terminated"):
        reached.set(flag, (parts.get(("next", flag)) & ~before).any(2))
    # After a collision decisions no longer begin with the parts.
    begun.set(BEGINS, begun.get(STEP) % every == 0)
    return begun.set("next", reached)


def n_step_returns(batch: TensorDictBase, count: int, gamma: float) -> TensorDictBase:
    """Return transitions over several decisions, with the discounted sums of their rewards.

    They end with their episode or with the batch, if that is earlier.

    Args:
        batch: transitions of single decisions, ``[environments, decisions]``.
        count: decisions of a return before a value.
        gamma: discount of a decision.
    """
    if count == 1:
        return batch
    after, length = batch.get("next"), batch.shape[1]
    done, now = after.get("done").squeeze(-1), torch.arange(length, device=batch.device)
    single = {key: x for key in (REWARD, LIMITED[1:]) if (x := after.get(key, None)) is not None}
    sums = {key: value.clone() for key, value in single.items()}
    last, running = now.expand(done.shape), ~done
    for ahead in range(1, count):
        place = (now + ahead).clamp(max=length - 1)
        running = running & (now + ahead < length)
        for key, total in sums.items():
            total += gamma**ahead * expand_as_right(running, total) * single[key][:, place]
        last = torch.where(running, place, last)
        running = running & ~done[:, place]
    reached = after.gather(1, last).update(sums)
    return batch.set("next", reached).set(STEPS_AHEAD, (last - now + 1).unsqueeze(-1))


def of_decisions(rows: TensorDictBase) -> TensorDictBase:
    """Return the transitions, ``[rows]``, that begin with a decision."""
    begins = rows.get(BEGINS, None)
    return rows if begins is None else rows[begins.squeeze(-1)].exclude(BEGINS)


def transitions(batch: TensorDictBase) -> TensorDictBase:
    """Return the transitions of a batch ``[environments, steps]``, one per row.

    Every automated vehicle has its own transitions, ``[environments × steps × A]``; all of them end
    with the episode.
    """
    shape = batch.get(("next", *REWARD)).shape[:-1]
    rows = TensorDict(batch_size=[shape.numel()], device=batch.device)
    more = {LIMITED: LIMITED, (BEGINS,): (BEGINS,), (STEPS_AHEAD,): (STEPS_AHEAD,)}
    for source, target in {**LEARNED_FROM, **more}.items():
        entry = batch.get(source, None)
        if entry is None:
            continue
        if entry.ndim == len(shape):
            entry = entry.unsqueeze(-2).expand(*shape, 1)
        rows.set(target, entry.reshape(-1, entry.shape[-1]))
    return rows
