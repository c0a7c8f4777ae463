"""Benchmark of DDPG's update."""

from __future__ import annotations

import logging
from argparse import Namespace
from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer

from benchmarks.collect import OTHER, stable_baselines_model
from benchmarks.harness import Row, Run, alternate, installed, rows_of, times
from benchmarks.plain import alcc
from benchmarks.plain_update import PlainUpdate, check
from lcc_rl.agents import DDPG
from lcc_rl.agents.agent import Scene
from lcc_rl.agents.replay import LEARNED_FROM, draws, transitions

PLAIN = "plain update"


def update(options: Namespace) -> list[Row]:
    """DDPG updates per second, beside one written by hand and stable-baselines3's.

    All updates include drawing the batch from the buffer, both losses and backward passes, Adam
    and the soft target updates, all in single precision. stable-baselines3's is its ``train()``,
    which also writes its two losses to its logger, once per call of many updates.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # the buffer announces its storage
    played = transitions(alcc(options, 1000).rollout(20, break_when_any_done=False))
    rows: list[Row] = []
    for batch, count in ((16, 2), (32, 2)) if options.quick else ((64, 60), (256, 40), (1024, 20)):
        agent = DDPG(batch_size=batch).start(Scene(7, device=options.device))
        storage = LazyTensorStorage(agent.buffer_size, device=options.device)
        buffer = ReplayBuffer(storage=storage, batch_size=batch)
        buffer.extend(played)
        draw = draws(buffer, torch.Generator().manual_seed(0))
        runs: dict[str, Run] = {
            "DDPG.update": partial(times, count, partial(learn, agent, draw)),
            PLAIN: partial(times, count, plain_update(agent, played)),
        }
        if installed("stable_baselines3", "gymnasium"):
            runs[OTHER] = partial(stable_baselines(options, batch, played).train, count, batch)
        rates = {name: count / spent for name, spent in alternate(runs, options.repeats).items()}
        rows += rows_of("update", rates, "updates/s", PLAIN, batch)
        if OTHER in rates:
            pair = {name: rates[name] for name in ("DDPG.update", OTHER)}
            rows += rows_of("update", pair, "updates/s", OTHER, batch)[:1]
    return rows


def learn(agent: DDPG, draw: Iterator[TensorDictBase]) -> None:
    """Take one update."""
    agent.update(next(draw))


def plain_update(agent: DDPG, played: TensorDictBase) -> PlainUpdate:
    """Return the update by hand, checked, with the transitions of the agent's buffer."""
    reached = {"reached": "observation", "reward": "reward", "terminated": "terminated"}
    columns = {name: played["next", key] for name, key in reached.items()}
    columns |= {name: played[name] for name in ("observation", "action")}
    plain = DDPG(batch_size=agent.batch_size, fused=False)
    loss = plain.start(Scene(7, seed=1, device=agent.device))
    check(loss, PlainUpdate(loss, columns))
    return PlainUpdate(agent, columns)


def stable_baselines(options: Namespace, batch: int, played: TensorDictBase) -> Any:
    """Return SB3's DDPG with the same transitions in a buffer of the same size."""
    from stable_baselines3.common.logger import configure

    _, model = stable_baselines_model(options, 1, batch_size=batch, buffer_size=20000)
    model.set_logger(configure(None, []))
    columns = [played[key].cpu().numpy() for key in list(LEARNED_FROM.values())[:5]]
    for seen, action, after, reward, done in zip(*columns, strict=True):
        model.replay_buffer.add(seen, after, action, reward, done, [{}])
    return model
