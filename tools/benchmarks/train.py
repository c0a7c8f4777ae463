"""Benchmark of a whole training: collection, replay, updates."""

from __future__ import annotations

from argparse import Namespace
from copy import deepcopy
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from benchmarks.collect import OTHER
from benchmarks.harness import Row, Run, alternate, installed, rows_of
from benchmarks.plain import alcc, study, training
from lcc_rl.agents import DDPG
from lcc_rl.agents.agent import Scene
from lcc_rl.agents.replay import Trainer, transitions


def train(options: Namespace) -> list[Row]:
    """Return the seconds per 1,000 (step + update) of DDPG, at one update per transition.

    "Trainer" is the package's own with 20 environments side by side, its bookkeeping included,
    checkpoints (one per 10 iterations) not; stable-baselines3's is ``DDPG.learn`` with the plain
    loop as one environment. Both learn in batches of 1,024 from a buffer of 20,000; "medium"
    is torch's reduced precision of matrix products, see docs/benchmarks.md.
    """
    batch, steps = (32, 40) if options.quick else (1024, 300)
    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as folder:
        runs: dict[str, Run] = {"Trainer": trainer(options, batch, steps, Path(folder))}
        if installed():
            runs[OTHER] = their_training(options, batch, steps)
        runs |= {f"{name}, medium": medium(run) for name, run in runs.items()}
        spent = alternate(runs, options.repeats)
    costs = {name: seconds * 1000 / steps for name, seconds in spent.items()}
    against = {name: [OTHER] for name in runs if name != OTHER}
    return rows_of(costs, "s", against, batch)


def medium(run: Run) -> Run:
    """Return a run with reduced precision of matrix products."""

    def reduced() -> None:
        before = torch.get_float32_matmul_precision()
        torch.set_float32_matmul_precision("medium")
        try:
            run()
        finally:
            torch.set_float32_matmul_precision(before)

    return reduced


def trainer(options: Namespace, batch: int, steps: int, folder: Path) -> Run:
    """Return one iteration of the package's training: so many transitions and updates."""
    cfg = deepcopy(study(options.quick)[0])
    cfg.training.environments, cfg.training.segment = 20, steps // 20
    cfg.training.episodes, cfg.training.compiled = 10**6, options.compile
    env = alcc(options, 20)
    env.base_env.horizon = steps // 20  # episodes of one segment
    agent = DDPG(batch_size=batch, updates_per_transition=1.0)
    agent = agent.start(Scene(7, device=options.device))
    trained = Trainer(agent, env, cfg.training, 0, folder, "benchmark")
    played = alcc(options, 100).rollout(20, break_when_any_done=False)
    trained.buffer.extend(transitions(played))
    collector = trained._source()
    return lambda: trained._numbers(collector)


def their_training(options: Namespace, batch: int, steps: int) -> Run:
    """Return ``DDPG.learn`` of stable-baselines3 for so many steps, after a start of no updates."""
    from benchmarks.theirs import PlainVector, their_agent

    how = {"train_freq": 1, "gradient_steps": 1, "batch_size": batch, "buffer_size": 20000}
    vector = PlainVector(training(options, 1), options.compile)
    model = their_agent(options, vector, "DDPG", learning_starts=batch, verbose=0, **how)
    model.learn(batch + 1)
    return lambda: model.learn(steps, reset_num_timesteps=False)
