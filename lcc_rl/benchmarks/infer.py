"""Benchmark of inference: one action for one vehicle, as a car would compute it."""

from __future__ import annotations

import warnings
from argparse import Namespace
from collections.abc import Iterator
from functools import partial
from importlib.util import find_spec
from itertools import cycle

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from lcc_rl.agents import DDPG
from lcc_rl.benchmarks.harness import TOLERANCE, Row, Run, alternate, rows_of, times
from lcc_rl.pieces import MPC


def infer(options: Namespace) -> list[Row]:
    """Milliseconds per action of the policy for one vehicle (batch 1); a control step is 100 ms.

    "policy" takes and returns a TensorDict; the others are its network alone: as it is, exported
    (``torch.export``), frozen (``torch.jit``, which C++ can load) and, if wanted, compiled. Where
    OSQP is installed also "mpc", the model predictive controller, in moments drawn at random.
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
        if find_spec("osqp"):
            runs["mpc"] = partial(_planned, MPC().bind(), cycle(_moments()))
        spent = alternate(
            {k: partial(times, calls, run) for k, run in runs.items()}, options.repeats
        )
    return rows_of("infer", {k: 1e3 * s / calls for k, s in spent.items()}, "ms", "network", 1)


def _planned(controller: MPC, moments: Iterator[list[Tensor]]) -> Tensor:
    return controller.command(*next(moments))[0]


def _moments(count: int = 100) -> list[list[Tensor]]:
    """What the controller reads of one vehicle that follows another, ``[1, 1]`` each."""
    generator = torch.Generator().manual_seed(0)
    speed, share, *others = torch.rand(5, count, 1, 1, generator=generator)
    speed, (own, closing, ahead) = 20.0 * speed, (2.0 * x - 1.0 for x in others)
    rows = (speed, 2.0 + (1.0 + share) * speed, own, (speed + closing).clamp(min=0.0), ahead)
    return [list(moment) for moment in zip(*rows, strict=True)]


def frozen(network: nn.Module, seen: Tensor) -> nn.Module:
    """The network as a TorchScript program with its weights built in."""
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore", DeprecationWarning)  # still the shortest way to C++
        return torch.jit.freeze(torch.jit.trace(network, seen))
