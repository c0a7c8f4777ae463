"""Benchmark of a whole training: collection, replay, updates."""

from __future__ import annotations

import logging
from argparse import Namespace
from copy import deepcopy
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torchrl.envs import TransformedEnv

from benchmarks.collect import OTHER, stable_baselines_model
from benchmarks.harness import Row, Run, alternate, installed, rows_of
from benchmarks.plain import alcc, study
from lcc_rl.agents import DDPG
from lcc_rl.agents.agent import Scene
from lcc_rl.agents.replay import Trainer, transitions


def train(options: Namespace) -> list[Row]:
    """Seconds per 1,000 (step + update) of DDPG, at one update per transition.

    "Trainer" is the package's own with 20 environments side by side, its bookkeeping included,
    checkpoints (one per 10 iterations) not; stable-baselines3's is ``DDPG.learn`` with one
    environment, as it is used. Both learn in batches of 1,024 from a buffer of 20,000; "medium"
    is torch's reduced precision of matrix products, see docs/benchmarks.md.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    batch, steps = (32, 40) if options.quick else (1024, 300)
    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as folder:
        runs: dict[str, Run] = {"Trainer": trainer(options, batch, steps, Path(folder))}
        if installed("stable_baselines3", "gymnasium"):
            runs[OTHER] = stable_baselines(options, batch, steps)
        runs |= {f"{name}, medium": partial(medium, run) for name, run in runs.items()}
        spent = alternate(runs, options.repeats)
    costs = {name: seconds * 1000 / steps for name, seconds in spent.items()}
    other = OTHER if OTHER in costs else None
    return rows_of("train", costs, "s", other, batch)


def medium(run: Run) -> None:
    """Run with reduced precision of matrix products."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        run()
    finally:
        torch.set_float32_matmul_precision(before)


def trainer(options: Namespace, batch: int, steps: int, folder: Path) -> Run:
    """One iteration of the package's training: so many transitions and as many updates."""
    cfg = deepcopy(study(options.quick)[0])
    cfg.training.environments, cfg.training.segment = 20, steps // 20
    cfg.training.episodes, cfg.training.compiled = 10**6, options.compile
    env = short(options, 20, steps // 20)
    agent = DDPG(batch_size=batch, updates_per_transition=1.0)
    agent = agent.start(Scene(7, device=options.device))
    training = Trainer(agent, env, cfg.training, 0, folder, "benchmark")
    played = alcc(options, 100).rollout(20, break_when_any_done=False)
    training.buffer.extend(transitions(played))
    collector = training._source()
    return lambda: training._numbers(collector)


def short(options: Namespace, batch: int, horizon: int) -> TransformedEnv:
    """Return the environment with episodes of so many steps, one segment of a training."""
    env = alcc(options, batch)
    env.base_env.horizon = horizon
    return env


def stable_baselines(options: Namespace, batch: int, steps: int) -> Run:
    """``DDPG.learn`` of stable-baselines3 for so many steps, after a start without updates."""
    how = {"train_freq": 1, "gradient_steps": 1, "batch_size": batch, "buffer_size": 20000}
    _, model = stable_baselines_model(options, 1, learning_starts=batch, verbose=0, **how)
    model.learn(batch + 1)
    return lambda: model.learn(steps, reset_num_timesteps=False)
