"""Benchmark of collection: environment steps with the policy in the loop."""

from __future__ import annotations

import logging
from argparse import Namespace
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from benchmarks.harness import Row, Run, alternate, endings, first_calls, installed, rows_of
from benchmarks.plain import PlainLoop, alcc, check_resets, training
from benchmarks.scalar import check_scalar, gymnasium_env
from lcc_rl.agents import DDPG
from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.agent import Scene
from lcc_rl.agents.loop import REPORTED
from lcc_rl.agents.replay import LEARNED_FROM
from lcc_rl.envs import StringCollector

OTHER = "stable-baselines3"
BATCHED = "stable-baselines3, batched"
OWN, PLAIN = "StringCollector", "plain loop"
ALTERNATIVE = ("stable_baselines3", "gymnasium")
SIDE_BY_SIDE = 8  # environments of stable-baselines3's DummyVecEnv


def collect(options: Namespace) -> list[Row]:
    """Transitions per second, collected by the actor without exploration, kept for learning.

    "StringCollector" is the training's own, "Collector" TorchRL's, which keeps every entry. The
    plain loop runs the same network and stacks what a learner needs. First where the vehicles
    start so far apart that no episode ends, then "in training": gaps spread at the start,
    collisions, and episodes that end replaced, by the plain loop, too. stable-baselines3 calls
    ``predict`` and steps a DummyVecEnv of 8 plain Gymnasium environments or, "batched", the plain
    loop as a VecEnv of equal width; its network has the same layers.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    check_resets(options)
    batch, steps = (16, 10) if options.quick else (1024, 60)
    policy = DDPG().start(Scene(7, device=options.device)).policy
    runs: dict[str, Run] = {}
    for ending in endings(options):
        env = alcc(options, batch, 30)
        runs[f"{PLAIN}{ending}"] = loop(env, policy.module, steps, bool(ending))
        runs[f"{OWN}{ending}"] = collector(env, policy, steps, bool(ending))
    runs["Collector"] = torchrl_collector(alcc(options, batch, 30), policy, steps)
    counts, other = dict.fromkeys(runs, batch * steps), stable_baselines(options)
    if other is not None:
        runs[OTHER], counts[OTHER] = other
    with torch.no_grad():
        spent = alternate(runs, options.repeats)
    rates = {name: counts[name] / seconds for name, seconds in spent.items()}
    rows: list[Row] = []
    for ending in endings(options):
        plain = f"{PLAIN}{ending}"
        pair = {name: rates[name] for name in (f"{OWN}{ending}", plain)}
        rows += rows_of("collect", pair, "steps/s", plain, batch)
    if other is not None:
        rates = {name: rate for name, rate in rates.items() if not name.startswith("plain")}
        rows += rows_of("collect", rates, "steps/s", OTHER, batch)
    for size in (batch,) if options.quick else (20, batch, 8192):
        rows += in_training(options, policy, size, steps)
    return rows


def in_training(options: Namespace, policy: Any, batch: int, steps: int) -> list[Row]:
    """The same in the environment of a training, whose episodes end and are replaced."""
    rows: list[Row] = []
    for ending in endings(options):
        compiled, where = bool(ending), f" in training{ending}"
        own, plain, other = f"{OWN}{where}", f"{PLAIN}{where}", f"{BATCHED}{where}"
        env = training(options, batch)
        runs = {
            plain: loop_with_resets(env, policy.module, steps, compiled),
            own: collector(training(options, batch), policy, steps, compiled),
        }
        if installed(*ALTERNATIVE):
            runs[other] = batched(options, batch, steps, compiled)
        with torch.no_grad():
            first = first_calls(runs) if compiled else {}
            spent = alternate(runs, options.repeats)
        rates = {name: batch * steps / seconds for name, seconds in spent.items()}
        rows += rows_of("collect", {own: rates[own], plain: rates[plain]}, "steps/s", plain, batch)
        if other in rates:
            pair = {own: rates[own], other: rates[other]}
            rows += rows_of("collect", pair, "steps/s", other, batch)
        rows += rows_of("collect", first, "s, first call", None, batch)
    return rows


def collector(env: TransformedEnv, policy: Any, steps: int, compiled: bool) -> Run:
    """The training's collection; one call collects so many steps of every environment."""
    return StringCollector(
        env,
        shared_policy(policy),
        frames_per_batch=env.batch_size.numel() * steps,
        keys=(*LEARNED_FROM, *REPORTED),
        compiled=compiled,
    ).collect


def torchrl_collector(env: TransformedEnv, policy: Any, steps: int) -> Run:
    """TorchRL's collector, which keeps every entry."""
    count = env.batch_size.numel() * steps
    how = {"track_traj_ids": False, "auto_register_policy_transforms": False}
    batches = iter(
        Collector(env, shared_policy(policy), frames_per_batch=count, total_frames=-1, **how)
    )
    return lambda: next(batches)


def loop(
    env: TransformedEnv, network: Callable[[Tensor], Tensor], steps: int, compiled: bool
) -> Run:
    """The same as a plain loop over tensors."""
    plain, start = PlainLoop(env), env.reset()
    first, state = start["automated", "observation"].squeeze(-2), plain.start(start)

    def act(seen: Tensor, state: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor], Any]:
        action = network(seen)
        after, written = plain.step(state, action)
        return action, after, written

    advance = torch.compile(act, dynamic=False) if compiled else act

    def run() -> None:
        now, seen, kept = state, first, []
        for _ in range(steps):
            action, now, written = advance(seen, now)
            kept.append((seen, action, written["reward"], written["observation"]))
            seen = written["observation"]
        for entries in zip(*kept, strict=True):
            torch.stack(entries, dim=1)

    return run


def loop_with_resets(
    env: TransformedEnv, network: Callable[[Tensor], Tensor], steps: int, compiled: bool
) -> Run:
    """The plain loop that replaces episodes that end, and so goes on from call to call."""
    plain, begun = PlainLoop(env), env.reset()
    play = plain.play if compiled else plain.play_eagerly
    moment = {"state": plain.start(begun), "seen": begun["automated", "observation"].squeeze(-2)}

    def act(seen: Tensor, state: dict[str, Tensor], seeds: Tensor) -> tuple[Any, ...]:
        action = network(seen)
        return action, *play(state, action, seeds)

    advance = torch.compile(act, dynamic=False) if compiled else act

    def run() -> None:
        seen, state, kept = moment["seen"], moment["state"], []
        for _ in range(steps):
            action, state, written, following = advance(seen, state, plain.seeds())
            ends = (written[name] for name in ("observation", "reward", "terminated", "done"))
            kept.append((seen, action, *ends))
            seen = following
        moment["seen"], moment["state"] = seen, state
        for entries in zip(*kept, strict=True):
            torch.stack(entries, dim=1)

    return run


def batched(options: Namespace, batch: int, steps: int, compiled: bool) -> Run:
    """``predict`` of stable-baselines3 on the plain loop as a VecEnv; nothing is kept."""
    from benchmarks.vector import PlainVector

    vector = PlainVector(training(options, batch), compiled)
    model, state = their_model(options, vector), {"seen": vector.reset()}

    def run() -> None:
        for _ in range(steps):
            action, _ = model.predict(state["seen"], deterministic=True)
            state["seen"], *_ = vector.step(action)

    return run


def stable_baselines(options: Namespace) -> tuple[Run, int] | None:
    """``predict`` and DummyVecEnv(8), and how many transitions one call makes; None without it."""
    if not installed(*ALTERNATIVE):
        return None
    steps = 10 if options.quick else 300
    vector, model = stable_baselines_model(options)
    state = {"seen": vector.reset()}

    def run() -> None:
        for _ in range(steps):
            action, _ = model.predict(state["seen"], deterministic=True)
            state["seen"], *_ = vector.step(action)

    return run, steps * SIDE_BY_SIDE


def stable_baselines_model(options: Namespace, environments: int = SIDE_BY_SIDE, **how: Any) -> Any:
    """Build SB3's DDPG with the paper's layers on so many Gymnasium environments."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    env = alcc(options, 1)
    check_scalar(env, PlainLoop(env), 20 if options.quick else 250)
    plain, horizon = PlainLoop(env), env.base_env.horizon
    makers = [lambda i=i: gymnasium_env(plain, horizon, i) for i in range(environments)]
    vector = DummyVecEnv(makers)
    return vector, their_model(options, vector, **how)


def their_model(options: Namespace, vector: Any, **how: Any) -> Any:
    """Build SB3's DDPG with the paper's layers on a vectorised environment."""
    from stable_baselines3 import DDPG as Theirs

    layers = {"net_arch": [200, 100, 50]}
    settings = {"policy_kwargs": layers, "gamma": 0.9, "device": options.device, **how}
    return Theirs("MlpPolicy", vector, **settings)
