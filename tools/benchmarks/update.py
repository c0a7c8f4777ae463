"""Benchmark of DDPG's update."""

from __future__ import annotations

import logging
from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer

from benchmarks.collect import OTHER, stable_baselines_model
from benchmarks.harness import Row, Run, alternate, installed, rows_of, times
from benchmarks.plain import alcc
from lcc_rl.agents import DDPG
from lcc_rl.agents.ddpg import DDPGSettings
from lcc_rl.agents.replay import LEARNED_FROM, transitions

PRODUCTS = "matrix products"


def update(options: Namespace) -> list[Row]:
    """DDPG updates per second, beside their matrix products alone and stable-baselines3.

    Both updates include drawing the batch from the buffer, both losses and backward passes, Adam
    and the soft target updates, all in single precision. stable-baselines3's is its ``train()``,
    which also writes its two losses to its logger, once per call of many updates.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # the buffer announces its storage
    played = transitions(alcc(options, 1000).rollout(20, break_when_any_done=False))
    rows: list[Row] = []
    for batch, count in ((16, 2), (32, 2)) if options.quick else ((64, 60), (256, 40), (1024, 20)):
        agent = DDPG(7, 1, 0, DDPGSettings(batch_size=batch), options.device)
        storage = LazyTensorStorage(agent.settings.buffer_size, device=options.device)
        buffer = ReplayBuffer(storage=storage, batch_size=batch)
        buffer.extend(played)
        runs: dict[str, Run] = {
            "DDPG.update": partial(times, count, partial(learn, agent, buffer)),
            PRODUCTS: partial(times, count, matrix_products(batch, options.device)),
        }
        if installed("stable_baselines3", "gymnasium"):
            runs[OTHER] = partial(stable_baselines(options, batch, played).train, count, batch)
        rates = {name: count / spent for name, spent in alternate(runs, options.repeats).items()}
        rows += rows_of("update", rates, "updates/s", PRODUCTS, batch)
        if OTHER in rates:
            pair = {name: rates[name] for name in ("DDPG.update", OTHER)}
            rows += rows_of("update", pair, "updates/s", OTHER, batch)[:1]
    return rows


def learn(agent: DDPG, buffer: ReplayBuffer) -> None:
    """Take one update."""
    agent.update(buffer.sample())


def stable_baselines(options: Namespace, batch: int, played: TensorDictBase) -> Any:
    """Return SB3's DDPG with the same transitions in a buffer of the same size."""
    from stable_baselines3.common.logger import configure

    _, model = stable_baselines_model(options, 1, batch_size=batch, buffer_size=20000)
    model.set_logger(configure(None, []))
    columns = [played[key].cpu().numpy() for key in list(LEARNED_FROM.values())[:5]]
    for seen, action, after, reward, done in zip(*columns, strict=True):
        model.replay_buffer.add(seen, after, action, reward, done, [{}])
    return model


def matrix_products(batch: int, device: str = "cpu", hidden: Sequence[int] = (200, 100, 50)) -> Run:
    """The matrix products of one update: no activation, loss, optimizer or target step."""

    def layers(inputs: int) -> list[tuple[Tensor, Tensor, Tensor]]:
        sizes = list(zip((inputs, *hidden), (*hidden, 1), strict=True))
        rand = partial(torch.rand, device=device)
        return [(rand(batch, i), rand(o, i), rand(batch, o)) for i, o in sizes]

    actor, critic = layers(7), layers(8)

    def run() -> None:
        # Forward: both targets, the critic on the data, the actor, the critic on its action.
        for x, weight, _ in (*actor, *critic, *critic, *actor, *critic):
            torch.mm(x, weight.t())
        for x, _, gradient in (*actor, *critic):
            torch.mm(gradient.t(), x)
        # To the inputs: no first layer needs it but where the critic judges the actor's action.
        for _, weight, gradient in (*critic[1:], *critic, *actor[1:]):
            torch.mm(gradient, weight)

    return run
