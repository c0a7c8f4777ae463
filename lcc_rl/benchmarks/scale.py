"""Benchmark of scale: cost against the size of the batch and the length of the string."""

from __future__ import annotations

from argparse import Namespace

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from lcc_rl.benchmarks.env import collecting
from lcc_rl.benchmarks.harness import Row, Run, alternate, endings, rows_of
from lcc_rl.benchmarks.plain import PlainLoop, alcc
from lcc_rl.envs.rollout import ACTION


def scale(options: Namespace) -> list[Row]:
    """Nanoseconds per transition by batch, and microseconds per step by number of followers.

    A ratio of 1 to the smallest batch says that cost grows exactly in proportion; below 1, that
    it grows less. Followers: batch 1,024, cost beside that of the shortest string. Vehicles: the
    same cost, uncompiled, per vehicle; and a long string beside the plain loop of the same.
    """
    rows: list[Row] = []
    batches = (16, 32) if options.quick else (1024, 4096, 8192, 32768)
    for ending in endings(options):
        runs, steps = {}, 5 if options.quick else 30
        for batch in batches:
            runs[f"batch {batch}{ending}"] = stepping(options, batch, 1, steps, bool(ending))
        with torch.no_grad():
            spent = alternate(runs, options.repeats)
        sizes = zip(spent, batches, strict=True)
        costs = {name: 1e9 * spent[name] / (batch * steps) for name, batch in sizes}
        rows += rows_of("scale", costs, "ns/transition", f"batch {batches[0]}{ending}")
        rows += followers(options, ending) + beside_plain(options, ending)
    return rows + vehicles(options)


def followers(options: Namespace, ending: str) -> list[Row]:
    """Microseconds per step and follower at several lengths of the string."""
    batch, counts, steps = (16, (1, 3), 5) if options.quick else (1024, (1, 10, 100), 20)
    runs = {
        f"{count} followers{ending}": stepping(options, batch, count, steps, bool(ending))
        for count in counts
    }
    with torch.no_grad():
        spent = alternate(runs, options.repeats)
    pairs = zip(spent, counts, strict=True)
    costs: dict[str, np.ndarray] = {name: 1e6 * spent[name] / (steps * n) for name, n in pairs}
    return rows_of("scale", costs, "µs/(step·follower)", f"{counts[0]} followers{ending}", batch)


def vehicles(options: Namespace) -> list[Row]:
    """Microseconds per step and vehicle of the shortest string and of a long one."""
    batch, counts, steps = (16, (1, 9), 5) if options.quick else (1024, (1, 99), 20)
    names = {f"automated human*{n}" if n > 1 else "automated human": n for n in counts}
    runs = {name: stepping(options, batch, n, steps, False) for name, n in names.items()}
    with torch.no_grad():
        spent = alternate(runs, options.repeats)
    costs = {name: 1e6 * spent[name] / (steps * (n + 1)) for name, n in names.items()}
    return rows_of("scale", costs, "µs/(step·vehicle)", "automated human", batch)


def beside_plain(options: Namespace, ending: str) -> list[Row]:
    """Microseconds per step and vehicle of a long string, and of the plain loop of the same."""
    batch, behind, steps = (16, 9, 5) if options.quick else (1024, 99, 20)
    env, name = alcc(options, batch, 30, behind), f"automated human*{behind}"
    zero = torch.zeros(batch, 1, 1, device=options.device)
    plain, start = PlainLoop(env), env.reset()
    advance_plain = torch.compile(plain.step, dynamic=False) if ending else plain.step

    def loop() -> None:
        state = plain.start(start)
        for _ in range(steps):
            state, _ = advance_plain(state, zero[:, 0])

    runs: dict[str, Run] = {
        f"{name}, StringCollector{ending}": collecting(env, zero, steps, bool(ending)),
        f"{name}, step{ending}": stepping(options, batch, behind, steps, bool(ending)),
        f"{name}, plain loop{ending}": loop,
    }
    with torch.no_grad():
        spent = alternate(runs, options.repeats)
    # As rates: a ratio is that of the speeds.
    rates = {name: steps * batch * (behind + 1) / each for name, each in spent.items()}
    return rows_of("scale", rates, "vehicle steps/s", f"{name}, plain loop{ending}", batch)


def stepping(options: Namespace, batch: int, behind: int, steps: int, compiled: bool) -> Run:
    """So many steps of an environment with zero actions, from its first moment."""
    env = alcc(options, batch, 30, behind)
    start, zero = env.reset(), torch.zeros(batch, 1, 1, device=options.device)
    if compiled:
        # One graph per size; each environment is an object of its own, so none is tried in vain.
        torch._dynamo.config.recompile_limit = 64
        env.compile(warmup=3, dynamic=False)
    return lambda: advance(env, start, zero, steps)


def advance(env: TransformedEnv, start: TensorDictBase, action: torch.Tensor, steps: int) -> None:
    """Step and keep nothing."""
    td = start.copy()
    for _ in range(steps):
        _, td = env.step_and_maybe_reset(td.set(ACTION, action))
