"""Benchmark of the updates of DDPG, TD3 and SAC."""

from __future__ import annotations

from argparse import Namespace
from functools import partial
from itertools import product
from typing import Any

import torch
from tensordict import TensorDictBase

from benchmarks.collect import OTHER
from benchmarks.harness import Row, Run, installed, rates
from benchmarks.plain import alcc, training
from lcc_rl.agents import DDPG, SAC, TD3
from lcc_rl.agents.agent import Scene
from lcc_rl.agents.collecting import LEARNED_FROM, transitions
from lcc_rl.agents.off_policy import OffPolicy
from lcc_rl.agents.replay import Replay

AGENTS: tuple[type[OffPolicy], ...] = (DDPG, TD3, SAC)
SIZES = ((64, 60), (256, 40), (1024, 20))  # batch, updates of a repeat
QUICK = ((16, 2), (32, 2))


def update(options: Namespace) -> list[Row]:
    """Return updates per second, beside those of stable-baselines3.

    All updates include drawing the batch from the buffer, all losses and backward passes, Adam
    and the soft target updates, all in single precision. stable-baselines3's is its ``train()``,
    which also writes its losses to its logger, once per call of many updates.
    """
    played = transitions(alcc(options, 1000).rollout(20, break_when_any_done=False))
    rows: list[Row] = []
    for kind, (batch, count) in product(AGENTS, QUICK if options.quick else SIZES):
        agent = kind(batch_size=batch).start(Scene(7))
        own, other = f"{kind.__name__}.update", f"{OTHER} {kind.__name__}"
        runs: dict[str, Run] = {own: own_updates(agent, played, count)}
        if installed():
            model = their_update(options, agent, played)
            runs[other] = partial(model.train, count, batch)
        rows += rates(options, runs, "updates/s", count, {own: [other]}, batch, grad=True)
    return rows


def own_updates(agent: OffPolicy, played: TensorDictBase, count: int) -> Run:
    """Return so many of the agent's updates with batches from a buffer of its size."""
    generator = torch.Generator().manual_seed(0)
    buffer = Replay(agent.buffer_size, agent.batch_size, generator, agent.device)
    buffer.extend(played)
    return lambda: [agent.update(buffer.draw()) for _ in range(count)]


def their_update(options: Namespace, agent: OffPolicy, played: TensorDictBase) -> Any:
    """Return SB3's agent of that name with the same transitions in a buffer of the same size."""
    from stable_baselines3.common.logger import configure

    from benchmarks.theirs import PlainVector, their_agent

    vector = PlainVector(training(options, 1), compiled=False)
    how = {"batch_size": agent.batch_size, "buffer_size": agent.buffer_size}
    model = their_agent(vector, type(agent).__name__, **how)
    model.set_logger(configure(None, []))
    columns = [played[key].cpu().numpy() for key in list(LEARNED_FROM.values())[:5]]
    for seen, action, after, reward, done in zip(*columns, strict=True):
        model.replay_buffer.add(seen, after, action, reward, done, [{}])
    return model
