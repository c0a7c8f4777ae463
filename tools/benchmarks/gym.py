"""Benchmark of Gymnasium's environments."""

from __future__ import annotations

from argparse import Namespace
from typing import Any

import numpy as np

from benchmarks.harness import Row, Run, installed, rates

DATA = ("platoons=3", "recordings=2", "vehicles=3", "duration_s=[35,45]")
SMALL = ["experiment=paper_windows", *(f"data.{setting}" for setting in DATA)]
MANY, SYNC = 16, "SyncVectorEnv"


def gym(options: Namespace) -> list[Row]:
    """Return steps per second of Gymnasium's environments with zero actions, resets included.

    The vector environment is compared with Gymnasium's ``SyncVectorEnv`` of as many single ones.
    """
    if not installed():
        return []
    import gymnasium

    import lcc_rl.interfaces.gym  # noqa: F401 - registers the environments

    steps, how = (50, {"overrides": SMALL}) if options.quick else (3000, {})
    name, many = "lcc_rl/alcc-v0", 4 if options.quick else MANY
    runs = {"gymnasium.make": stepping(gymnasium.make(name, **how), steps)}
    rows = rates(options, runs, "steps/s", steps, batch=1)
    steps //= 10
    vector = gymnasium.make_vec(name, num_envs=many, **how)
    ones = [lambda: gymnasium.make(name, **how)] * many
    same = gymnasium.vector.AutoresetMode.SAME_STEP
    runs = {
        "gymnasium.make_vec": stepping(vector, steps),
        SYNC: stepping(gymnasium.vector.SyncVectorEnv(ones, autoreset_mode=same), steps),
    }
    against = {"gymnasium.make_vec": [SYNC]}
    return rows + rates(options, runs, "steps/s", steps * many, against, many)


def stepping(env: Any, steps: int) -> Run:
    """Return so many steps of an environment with zero actions; one that ends begins anew."""
    action = np.zeros(env.action_space.shape, np.float32)
    alone = action.ndim == 1

    def run() -> None:
        env.reset(seed=0)
        for _ in range(steps):
            _, _, terminated, truncated, _ = env.step(action)
            if alone and (terminated or truncated):
                env.reset()

    return run
