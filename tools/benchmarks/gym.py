"""Benchmark of Gymnasium's environments beside the same physics in plain Python."""

from __future__ import annotations

from argparse import Namespace
from typing import Any

import numpy as np

from benchmarks.harness import Row, Run, agree, installed, rates

SMALL = ["data.platoons=3", "data.recordings=2", "data.vehicles=3", "data.duration_s=[35,45]"]
MANY = 64


def gym(options: Namespace) -> list[Row]:
    """Return steps per second of Gymnasium's environments with zero actions, resets included.

    Alternatives are an environment of the same physics in plain Python floats, and Gymnasium's
    ``SyncVectorEnv`` of these. Both are first checked to play the same episode.
    """
    if not installed():
        return []
    import gymnasium

    import lcc_rl.interfaces.gym  # noqa: F401 - registers the environments
    from benchmarks.plain_env import PlainEnv

    steps, overrides = (50, SMALL) if options.quick else (3000, [])
    one = gymnasium.make("lcc_rl/alcc-v0", overrides=overrides)
    many = gymnasium.make_vec("lcc_rl/alcc-v0", num_envs=MANY, overrides=overrides)
    inner = one.unwrapped.episodes.env
    check(one, PlainEnv(inner))
    same = gymnasium.vector.AutoresetMode.SAME_STEP
    plain = gymnasium.vector.SyncVectorEnv([lambda: PlainEnv(inner)] * MANY, autoreset_mode=same)
    names = ("gymnasium.make", "plain Python")
    runs = {names[0]: stepping(one, steps), names[1]: stepping(PlainEnv(inner), steps)}
    rows = rates(options, runs, "steps/s", dict.fromkeys(runs, steps), {names[0]: names[1:]}, 1)
    names = ("gymnasium.make_vec", "SyncVectorEnv of plain Python")
    steps //= 10
    runs = {names[0]: stepping(many, steps), names[1]: stepping(plain, steps)}
    counts = dict.fromkeys(runs, steps * MANY)
    return rows + rates(options, runs, "steps/s", counts, {names[0]: names[1:]}, MANY)


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


def check(one: Any, plain: Any) -> None:
    """Check that both play the same episode.

    Raises:
        RuntimeError: if they do not.
    """
    seen, rng = [one.reset(seed=0, options={"episode.seed": 7})[0]], np.random.default_rng(0)
    other = [plain.begin(7)]
    ended = False
    while not ended:
        action = rng.uniform(-0.5, 0.5, 1).astype(np.float32)
        (observation, reward, *ends, _), theirs = one.step(action), plain.step(action)
        seen.append(np.append(observation, reward))
        other.append(np.append(theirs[0], theirs[1]))
        ended = any(ends)
    for own, their in zip(seen, other, strict=True):
        agree("the environment in plain Python", own, their)
