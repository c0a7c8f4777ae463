"""Benchmark of collection: environment steps with the policy in the loop."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from benchmarks.harness import Row, Run, endings, installed, rates
from benchmarks.plain import PlainLoop, State, alcc, check_resets, training
from benchmarks.plain_numba import NUMBA, NumbaLoop, check_loops
from lcc_rl.agents import DDPG
from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.agent import Scene
from lcc_rl.agents.collecting import LEARNED_FROM
from lcc_rl.agents.loop import REPORTED
from lcc_rl.envs import StringCollector

OTHER = "stable-baselines3"
KEPT = ("observation", "reward", "terminated", "done")


def collect(options: Namespace) -> list[Row]:
    """Return transitions per second, collected without exploration and kept for learning.

    "StringCollector" is the training's own, "Collector" TorchRL's, which keeps every entry;
    compiled, its environment is, by ``env.compile()``, and its policy. The
    plain loop runs the same network and stacks what a learner needs. First the vehicles start so
    far apart that no episode ends; then, "in training", gaps are spread at the start, vehicles
    collide, and episodes that end are replaced, by the plain loop, too. stable-baselines3 calls
    ``predict`` and steps the plain loop as a VecEnv of equal width; its network has the same
    layers. Loops of numbers that numba compiles, with the same network, are the limit.
    """
    check_resets(options)
    check_loops(training(options, 16), 20 if options.quick else 200)
    batch, steps = (16, 10) if options.quick else (1024, 60)
    policy = DDPG().start(Scene(7)).policy
    runs: dict[str, Run] = {}
    against: dict[str, list[str]] = {}
    for ending in endings(options):
        own, theirs, plain = (
            f"{x}{ending}" for x in ("StringCollector", "Collector", "plain loop")
        )
        env, compiled = alcc(options, batch, far=True), bool(ending)
        runs[plain] = loop(env, policy.module, steps, compiled, resets=False)
        runs[own] = collector(env, policy, steps, compiled)
        runs[theirs] = torchrl_collector(alcc(options, batch, far=True), policy, steps, compiled)
        against |= {own: [plain], theirs: [plain, own]}
    counts = dict.fromkeys(runs, batch * steps)
    rows = rates(options, runs, "steps/s", counts, against, batch)
    for size in (batch,) if options.quick else (20, 64, batch, 8192):
        for ending in endings(options):
            rows += in_training(options, policy, size, steps, ending)
    return rows


def in_training(options: Namespace, policy: Any, batch: int, steps: int, ending: str) -> list[Row]:
    """Return the same in the environment of a training, whose episodes end and are replaced."""
    compiled, where = bool(ending), f" in training{ending}"
    own, plain, other = (f"{x}{where}" for x in ("StringCollector", "plain loop", OTHER))
    runs = {
        plain: loop(training(options, batch), policy.module, steps, compiled, resets=True),
        own: collector(training(options, batch), policy, steps, compiled),
    }
    env = training(options, batch)
    runs[NUMBA] = numba_loop(NumbaLoop(PlainLoop(env), env.reset()), policy.module, steps)
    if installed():
        from benchmarks.theirs import PlainVector, predicting

        runs[other] = predicting(options, PlainVector(training(options, batch), compiled), steps)
    counts, against = dict.fromkeys(runs, batch * steps), {own: [plain, other, NUMBA]}
    return rates(options, runs, "steps/s", counts, against, batch, first=compiled)


def collector(env: TransformedEnv, policy: Any, steps: int, compiled: bool) -> Run:
    """Return the training's collection; one call collects so many steps of every environment."""
    return StringCollector(
        env,
        shared_policy(policy),
        frames_per_batch=env.batch_size.numel() * steps,
        keys=(*LEARNED_FROM, *REPORTED),
        compiled=compiled,
    ).collect


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


def loop(
    env: TransformedEnv,
    network: Callable[[Tensor], Tensor],
    steps: int,
    compiled: bool,
    resets: bool,
) -> Run:
    """Return the same as a plain loop over tensors.

    With ``resets`` it replaces episodes that end and continues from call to call.
    """
    plain, begun = PlainLoop(env), env.reset()
    play = (plain.play if compiled else plain.play_eagerly) if resets else plain.play_on
    moment: dict[str, Any] = {"state": plain.start(begun)}
    moment["seen"] = begun["automated", "observation"].squeeze(-2)

    def act(seen: Tensor, state: State, seeds: Tensor | None) -> tuple[Any, ...]:
        action = network(seen)
        return action, *play(state, action, seeds)

    advance = torch.compile(act, dynamic=False) if compiled else act

    def run() -> None:
        seen, state, kept = moment["seen"], moment["state"], []
        for _ in range(steps):
            seeds = plain.seeds() if resets else None
            action, state, written, following = advance(seen, state, seeds)
            kept.append((seen, action, *(written[name] for name in KEPT if name in written)))
            seen = following
        if resets:
            moment.update(seen=seen, state=state)
        for entries in zip(*kept, strict=True):
            torch.stack(entries, dim=1)

    return run


def numba_loop(loops: NumbaLoop, network: Callable[[Tensor], Tensor], steps: int) -> Run:
    """Return the same as a loop over numbers, whose network is that of torch."""

    def run() -> None:
        kept = []
        for _ in range(steps):
            seen = torch.from_numpy(loops.seen.copy())
            action = network(seen)
            rewards, ends = loops.step(action.numpy().ravel())
            kept.append((seen, action, *map(torch.from_numpy, (rewards, *ends, loops.seen.copy()))))
        for entries in zip(*kept, strict=True):
            torch.stack(entries, dim=1)

    return run
