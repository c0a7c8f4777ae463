"""Benchmarks of environment steps: alone, with a policy that collects, and by Gymnasium."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from benchmarks.harness import Row, Run, endings, installed, rates
from benchmarks.plain import PlainLoop, alcc, check_physics, check_resets, training
from lcc_rl.agents import DDPG
from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.agent import Scene
from lcc_rl.agents.collecting import LEARNED_FROM
from lcc_rl.agents.loop import REPORTED
from lcc_rl.envs import StringCollector
from lcc_rl.envs.collector import PLAIN_RESETS
from lcc_rl.pieces.base import ACTION, OBSERVATION, REWARD


def env(options: Namespace) -> list[Row]:
    """Return steps per second of the ALCC environment with zero actions, beside the plain loop.

    "step" is what TorchRL's collector calls (``step_and_maybe_reset``) and keeps nothing, like the
    plain loop; "StringCollector" is the training's own, which keeps the rewards; "rollout" stacks
    every entry of every time. Every run starts from the same state, far behind the leader, so that
    no episode resets. Both implementations are first checked to agree.
    """
    check_physics(options, 20 if options.quick else 250)
    rows: list[Row] = []
    steps = 10 if options.quick else 100
    for batch in (1, 16) if options.quick else (1, 64, 1024, 8192):
        for ending in endings(options):
            runs = ways(options, batch, steps, ending)
            plain = f"plain loop{ending}"
            against = {name: [plain] for name in runs if name != plain}
            rows += rates(options, runs, "steps/s", batch * steps, against, batch)
    return rows


def ways(
    options: Namespace, batch: int, steps: int, ending: str, followers: int = 1
) -> dict[str, Run]:
    """Return every way to take so many steps, all eager or, with an ending, all compiled."""
    env, again = (alcc(options, batch, True, followers) for _ in range(2))
    zero = torch.zeros(batch, 1, 1)
    plain, start = PlainLoop(env), env.reset()
    advance = plain.step
    if ending:
        # One graph per size, which is faster than one for any size; and none of other sizes, whose
        # guards would be tried first and count towards the compiler's limit.
        torch.compiler.reset()
        env.compile(warmup=3, dynamic=False)
        advance = torch.compile(plain.step, dynamic=False)

    def rollout() -> None:
        begin = {"auto_reset": False, "tensordict": start.copy(), "break_when_any_done": False}
        env.rollout(steps, lambda td: td.set(ACTION, zero), **begin)

    def step() -> None:
        td = start.copy()
        for _ in range(steps):
            _, td = env.step_and_maybe_reset(td.set(ACTION, zero))

    def loop() -> None:
        state, action = plain.start(start), zero.squeeze(-2)
        for _ in range(steps):
            state, _ = advance(state, action)

    policy = TensorDictModule(lambda _: zero, [OBSERVATION], [ACTION])
    source = string_collector(again, policy, steps, [("next", *REWARD)], bool(ending))
    begun = source.state_dict()

    def collected() -> None:
        source.load_state_dict(begun)
        source.collect()

    runs = {"rollout": rollout, "StringCollector": collected, "step": step, "plain loop": loop}
    return {f"{name}{ending}": run for name, run in runs.items()}


# -- collection: steps with the policy in the loop -------------------------------------------------

OTHER = "stable-baselines3"
KEPT = ("observation", "reward", "terminated", "done")


def collect(options: Namespace) -> list[Row]:
    """Return transitions per second, collected without exploration and kept for learning.

    First, "StringCollector", the training's own, beside TorchRL's "Collector", which keeps every
    entry; no episode ends. Then, "in training", gaps are spread at the start, vehicles collide, and
    episodes that end are replaced: beside the plain loop with the same network, and beside
    ``predict`` of stable-baselines3, with the same layers, and the plain loop as its VecEnv.
    """
    check_resets(options)
    batch, steps = (16, 10) if options.quick else (1024, 60)
    policy = DDPG().start(Scene(7)).policy
    rows: list[Row] = []
    for ending in endings(options):
        own, theirs = f"StringCollector{ending}", f"Collector{ending}"
        first, second = (alcc(options, batch, far=True) for _ in range(2))
        runs = {
            own: collector(first, policy, steps, bool(ending)),
            theirs: torchrl_collector(second, policy, steps, bool(ending)),
        }
        rows += rates(options, runs, "steps/s", batch * steps, {theirs: [own]}, batch)
    for size in (batch,) if options.quick else (20, 64, batch, 8192):
        for ending in endings(options):
            rows += in_training(options, policy, size, steps, ending)
    return rows


def in_training(options: Namespace, policy: Any, batch: int, steps: int, ending: str) -> list[Row]:
    """Return the rates in the environment of a training, whose episodes end and are replaced."""
    compiled, where = bool(ending), f" in training{ending}"
    own, plain, other = (f"{x}{where}" for x in ("StringCollector", "plain loop", OTHER))
    runs = {
        plain: loop(training(options, batch), policy.module, steps, compiled),
        own: collector(training(options, batch), policy, steps, compiled),
    }
    if installed():
        from benchmarks.theirs import PlainVector, predicting

        runs[other] = predicting(PlainVector(training(options, batch), compiled), steps)
    return rates(options, runs, "steps/s", batch * steps, {own: [plain, other]}, batch)


def collector(env: TransformedEnv, policy: Any, steps: int, compiled: bool) -> Run:
    """Return the training's collection; one call collects so many steps of every environment."""
    keys = (*LEARNED_FROM, *REPORTED)
    source = string_collector(env, shared_policy(policy), steps, keys, compiled)
    source.resets = PLAIN_RESETS  # as late in a training
    return source.collect


def string_collector(
    env: TransformedEnv, policy: Any, steps: int, keys: Sequence[Any], compiled: bool
) -> StringCollector:
    """Return the training's own collector of so many steps, which keeps some entries."""
    frames = env.batch_size.numel() * steps
    return StringCollector(env, policy, frames_per_batch=frames, keys=keys, compiled=compiled)


def torchrl_collector(env: TransformedEnv, policy: Any, steps: int, compiled: bool) -> Run:
    """Return TorchRL's collector, which keeps every entry."""
    count = env.batch_size.numel() * steps
    how: dict[str, Any] = {"track_traj_ids": False, "auto_register_policy_transforms": False}
    if compiled:
        how["compile_policy"] = {"dynamic": False}
        env.compile()
    batches = iter(
        Collector(env, shared_policy(policy), frames_per_batch=count, total_frames=-1, **how)
    )
    return lambda: next(batches)


def loop(env: TransformedEnv, network: Any, steps: int, compiled: bool) -> Run:
    """Return the collection by the plain loop, which continues from call to call."""
    plain, begun = PlainLoop(env), env.reset()
    play = plain.play if compiled else plain.play_eagerly
    moment: dict[str, Any] = {"state": plain.start(begun)}
    moment["seen"] = begun["automated", "observation"].squeeze(-2)

    def act(seen: Any, state: Any, seeds: Any) -> tuple[Any, ...]:
        action = network(seen)
        return action, *play(state, action, seeds)

    advance = torch.compile(act, dynamic=False) if compiled else act

    def run() -> None:
        seen, state, kept = moment["seen"], moment["state"], []
        for _ in range(steps):
            action, state, written, following = advance(seen, state, plain.seeds())
            kept.append((seen, action, *(written[name] for name in KEPT)))
            seen = following
        moment.update(seen=seen, state=state)
        for entries in zip(*kept, strict=True):
            torch.stack(entries, dim=1)

    return run


# -- Gymnasium -------------------------------------------------------------------------------------

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
