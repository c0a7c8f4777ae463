"""Benchmark of inference: one action for one vehicle, as a car would compute it."""

from __future__ import annotations

import warnings
from argparse import Namespace
from functools import partial

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.harness import TOLERANCE, Row, Run, alternate, rows_of, times
from lcc_rl.agents import DDPG


def infer(options: Namespace) -> list[Row]:
    """Milliseconds per action of the policy for one vehicle (batch 1); a control step is 100 ms.

    "policy" takes and returns a TensorDict; the others are its network alone: as it is, exported
    (``torch.export``), frozen (``torch.jit``, which C++ can load) and, if wanted, compiled.
    """
    calls = 10 if options.quick else 1000
    policy = DDPG(observation_size=7, action_size=1, seed=0, device=options.device).policy
    seen = torch.rand(1, 7, device=options.device)
    td = TensorDict({"observation": seen}, [1], device=options.device)
    network = policy.module.eval()
    runs: dict[str, Run] = {"policy": partial(policy, td), "network": partial(network, seen)}
    runs["exported"] = partial(torch.export.export(network, (seen,)).module(), seen)
    runs["frozen"] = partial(frozen(network, seen), seen)
    if options.compile:
        runs["compiled"] = partial(torch.compile(network, dynamic=False), seen)
    with torch.no_grad():
        wanted = network(seen)
        for name, run in runs.items():
            got = run()["action"] if name == "policy" else run()
            if not float((got - wanted).abs().max()) <= TOLERANCE:
                raise RuntimeError(f"{name}: another action than the network's")
        spent = alternate(
            {k: partial(times, calls, run) for k, run in runs.items()}, options.repeats
        )
    return rows_of("infer", {k: 1e3 * s / calls for k, s in spent.items()}, "ms", "network", 1)


def frozen(network: nn.Module, seen: Tensor) -> nn.Module:
    """The network as a TorchScript program with its weights built in."""
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore", DeprecationWarning)  # still the shortest way to C++
        return torch.jit.freeze(torch.jit.trace(network, seen))
