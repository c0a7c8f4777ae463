"""Benchmark of environment steps, without a policy."""

from __future__ import annotations

from argparse import Namespace

import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv

from benchmarks.harness import Row, Run, endings, rates
from benchmarks.plain import PlainLoop, alcc, check_physics
from lcc_rl.envs import StringCollector
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

    collect = collecting(again, zero, steps, bool(ending))
    runs = {"rollout": rollout, "StringCollector": collect, "step": step, "plain loop": loop}
    return {f"{name}{ending}": run for name, run in runs.items()}


def collecting(env: TransformedEnv, action: torch.Tensor, steps: int, compiled: bool) -> Run:
    """Return so many steps of the training's own collector with one action, keeping rewards."""
    collector = StringCollector(
        env,
        TensorDictModule(lambda _: action, [OBSERVATION], [ACTION]),
        frames_per_batch=env.batch_size.numel() * steps,
        keys=[("next", *REWARD)],
        compiled=compiled,
    )

    begun = collector.state_dict()

    def run() -> None:
        collector.load_state_dict(begun)
        collector.collect()

    return run
