"""Benchmark of collection: environment steps with the policy in the loop."""

from __future__ import annotations

from argparse import Namespace
from typing import Any

import torch
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from benchmarks.harness import Row, Run, endings, installed, rates
from benchmarks.plain import PlainLoop, alcc, check_resets, training
from lcc_rl.agents import DDPG
from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.agent import Scene
from lcc_rl.agents.collecting import LEARNED_FROM
from lcc_rl.agents.loop import REPORTED
from lcc_rl.envs import StringCollector
from lcc_rl.envs.collector import PLAIN_RESETS

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
    source = StringCollector(
        env,
        shared_policy(policy),
        frames_per_batch=env.batch_size.numel() * steps,
        keys=(*LEARNED_FROM, *REPORTED),
        compiled=compiled,
    )
    source.resets = PLAIN_RESETS  # as late in a training
    return source.collect


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
