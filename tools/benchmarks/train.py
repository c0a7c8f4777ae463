"""Benchmark of a whole training: collection, replay, updates."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.collect import OTHER
from benchmarks.harness import Row, Run, alternate, installed, rows_of
from benchmarks.plain import alcc, study, training
from lcc_rl.agents import DDPG
from lcc_rl.agents.agent import Scene
from lcc_rl.agents.collecting import transitions
from lcc_rl.agents.replay import ReplayLoop

WIDTH = 20  # environments side by side


def train(options: Namespace) -> list[Row]:
    """Return the seconds per 1,000 (step + update) of DDPG, at one update per transition.

    "Trainer" is the package's own with 20 environments side by side, its bookkeeping included,
    checkpoints (one per 10 iterations) not; stable-baselines3's is ``DDPG.learn`` with the plain
    loop as one environment. Both learn in batches of 1,024 from a buffer of 20,000. "At equal
    width" both have 20 environments, and learn a batch of 256 per 8 transitions.
    """
    batch, steps = (32, 40) if options.quick else (1024, 300)
    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as folder:
        runs: dict[str, Run] = {"Trainer": trainer(options, batch, steps, Path(folder))}
        if installed():
            runs[OTHER] = their_training(options, batch, steps)
        spent = alternate(runs, options.repeats)
        rows = costs(spent, steps, batch)
        batch, steps = (batch // 4, 10 * steps - 10 * steps % (8 * WIDTH))
        runs = {"Trainer": trainer(options, batch, steps, Path(folder) / "equal", 0.125)}
        if installed():
            runs[OTHER] = their_training(options, batch, steps, WIDTH, 2, 2 * WIDTH // 8)
        spent = {
            f"{name}, at equal width": x for name, x in alternate(runs, options.repeats).items()
        }
        return rows + costs(spent, steps, batch)


def costs(spent: Mapping[str, np.ndarray], steps: int, batch: int) -> list[Row]:
    """Return the rows of so many steps; the alternative is stable-baselines3's."""
    other = next((name for name in spent if name.startswith(OTHER)), "")
    against = {name: [other] for name in spent if name != other}
    each = {name: seconds * 1000 / steps for name, seconds in spent.items()}
    return rows_of(each, "s", against, batch)


def trainer(options: Namespace, batch: int, steps: int, folder: Path, updates: float = 1.0) -> Run:
    """Return one iteration of the package's training: so many transitions, updates for each."""
    sizes = {"environments": WIDTH, "segment": steps // WIDTH, "episodes": 10**6}
    cfg = study(options.quick)[0].with_(training={**sizes, "compiled": options.compile})
    env = alcc(options, WIDTH)
    env.base_env.horizon = steps // WIDTH  # episodes of one segment
    agent = DDPG(batch_size=batch, updates_per_transition=updates)
    agent = agent.start(Scene(7))
    trained = ReplayLoop(agent, env, cfg.training, 0, folder, "benchmark")
    played = alcc(options, 100).rollout(20, break_when_any_done=False)
    trained.buffer.extend(transitions(played))
    collector = trained._source()
    return lambda: trained._numbers(collector)


def their_training(
    options: Namespace, batch: int, steps: int, width: int = 1, every: int = 1, updates: int = 1
) -> Run:
    """Return ``DDPG.learn`` of stable-baselines3 for so many steps, after a start of no updates."""
    from benchmarks.theirs import PlainVector, their_agent

    how = {"train_freq": every, "gradient_steps": updates, "batch_size": batch}
    how["buffer_size"] = 20000
    vector = PlainVector(training(options, width), options.compile)
    model = their_agent(vector, "DDPG", learning_starts=batch, verbose=0, **how)
    model.learn(batch + every * width)
    return lambda: model.learn(steps, reset_num_timesteps=False)
