"""Benchmark of the driver estimator, beside the IDM step itself."""

from __future__ import annotations

from argparse import Namespace
from functools import partial

import torch
from torchrl.envs.utils import step_mdp

from lcc_rl.benchmarks.harness import Row, Run, alternate, endings, rows_of, times
from lcc_rl.benchmarks.plain import alcc
from lcc_rl.envs.rollout import ACTION


def estimator(options: Namespace) -> list[Row]:
    """Microseconds per step of the driver estimator, beside those of the IDM step itself."""
    batch, calls = (16, 5) if options.quick else (1024, 300)
    env = alcc(options, batch)
    zero = torch.zeros(batch, 1, 1, device=options.device)
    td = env.step(env.reset().set(ACTION, zero))
    for _ in range(10):
        td = env.step(step_mdp(td).set(ACTION, zero))
    pieces = {type(piece).__name__: piece for piece in env.transform}
    rows: list[Row] = []
    for ending in endings(options):
        runs: dict[str, Run] = {}
        for name in ("DriverEstimator", "IDM"):
            compute = pieces[name].compute
            compute = torch.compile(compute, dynamic=False) if ending else compute
            call = partial(compute, *(td.get(key) for key in pieces[name].in_keys))
            runs[f"{name}{ending}"] = partial(times, calls, call)
        with torch.no_grad():
            spent = alternate(runs, options.repeats)
        cost = {name: 1e6 * seconds / calls for name, seconds in spent.items()}
        rows += rows_of("estimator", cost, "µs/step", f"IDM{ending}", batch)
    return rows
