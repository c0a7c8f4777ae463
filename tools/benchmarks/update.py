"""Benchmark of DDPG's update."""

from __future__ import annotations

from argparse import Namespace
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer

from benchmarks.collect import OTHER
from benchmarks.harness import Row, Run, installed, rates
from benchmarks.plain import alcc, training
from benchmarks.plain_update import PlainUpdate, check
from lcc_rl.agents import DDPG
from lcc_rl.agents.agent import Scene
from lcc_rl.agents.replay import LEARNED_FROM, draws, transitions

OWN, PLAIN = "DDPG.update", "plain update"


def update(options: Namespace) -> list[Row]:
    """Return DDPG updates per second, beside one written by hand and stable-baselines3's.

    All updates include drawing the batch from the buffer, both losses and backward passes, Adam
    and the soft target updates, all in single precision. stable-baselines3's is its ``train()``,
    which also writes its two losses to its logger, once per call of many updates.
    """
    played = transitions(alcc(options, 1000).rollout(20, break_when_any_done=False))
    rows: list[Row] = []
    for batch, count in ((16, 2), (32, 2)) if options.quick else ((64, 60), (256, 40), (1024, 20)):
        agent = DDPG(batch_size=batch).start(Scene(7, device=options.device))
        runs: dict[str, Run] = {
            OWN: times(count, own_update(agent, played)),
            PLAIN: times(count, plain_update(agent, played)),
        }
        if installed():
            model = their_update(options, batch, played)
            runs[OTHER] = partial(model.train, count, batch)
        against = {OWN: [PLAIN, OTHER], OTHER: [PLAIN]}
        counts = dict.fromkeys(runs, count)
        rows += rates(options, runs, "updates/s", counts, against, batch, grad=True)
    return rows


def times(count: int, function: Run) -> Run:
    """Return so many calls of a function."""

    def run() -> None:
        for _ in range(count):
            function()

    return run


def own_update(agent: DDPG, played: TensorDictBase) -> Run:
    """Return the agent's update with batches from a buffer of its size."""
    storage = LazyTensorStorage(agent.buffer_size, device=agent.device)
    buffer = ReplayBuffer(storage=storage, batch_size=agent.batch_size)
    buffer.extend(played)
    draw = draws(buffer, torch.Generator().manual_seed(0))
    return lambda: agent.update(next(draw))


def plain_update(agent: DDPG, played: TensorDictBase) -> PlainUpdate:
    """Return the update by hand, checked, with the transitions of the agent's buffer."""
    reached = {"reached": "observation", "reward": "reward", "terminated": "terminated"}
    columns = {name: played["next", key] for name, key in reached.items()}
    columns |= {name: played[name] for name in ("observation", "action")}
    plain = DDPG(batch_size=agent.batch_size, fused=False)
    loss = plain.start(Scene(7, seed=1, device=agent.device))
    check(loss, PlainUpdate(loss, columns))
    return PlainUpdate(agent, columns)


def their_update(options: Namespace, batch: int, played: TensorDictBase) -> Any:
    """Return SB3's DDPG with the same transitions in a buffer of the same size."""
    from stable_baselines3.common.logger import configure

    from benchmarks.theirs import PlainVector, their_agent

    vector = PlainVector(training(options, 1), compiled=False)
    model = their_agent(options, vector, batch_size=batch, buffer_size=20000)
    model.set_logger(configure(None, []))
    columns = [played[key].cpu().numpy() for key in list(LEARNED_FROM.values())[:5]]
    for seen, action, after, reward, done in zip(*columns, strict=True):
        model.replay_buffer.add(seen, after, action, reward, done, [{}])
    return model
