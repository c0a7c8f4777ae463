"""Benchmark of environment steps, without a policy."""

from __future__ import annotations

from argparse import Namespace

import numpy as np
import torch

from benchmarks.harness import Row, alternate, endings, rows_of
from benchmarks.plain import PlainLoop, alcc, check_physics
from lcc_rl.envs.rollout import ACTION


def env(options: Namespace) -> list[Row]:
    """Steps per second of the ALCC environment with zero actions, beside the plain loop.

    "step" is what a collector calls (``step_and_maybe_reset``) and keeps nothing, like the plain
    loop; "rollout" stacks every entry of every moment. The vehicles start 30 s apart, so that no
    episode ends within a run and nobody resets. Both are first checked to be the same physics.
    """
    check_physics(options, 20 if options.quick else 250)
    rows: list[Row] = []
    for batch in (1, 16) if options.quick else (1, 64, 1024, 8192):
        for ending in endings(options):
            rates = env_rates(options, batch, ending)
            rows += rows_of("env", rates, "steps/s", f"plain loop{ending}", batch)
    return rows


def env_rates(options: Namespace, batch: int, ending: str) -> dict[str, np.ndarray]:
    """Steps per second of every way to step, all eager or, with an ending, all compiled."""
    steps, env = 10 if options.quick else 100, alcc(options, batch, 30)
    zero = torch.zeros(batch, 1, 1, device=options.device)
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

    runs = {f"rollout{ending}": rollout, f"step{ending}": step, f"plain loop{ending}": loop}
    with torch.no_grad():
        spent = alternate(runs, options.repeats)
    return {name: batch * steps / seconds for name, seconds in spent.items()}
