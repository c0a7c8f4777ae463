"""Networks in one vector, for which Adam and target steps are one operation each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn


def views(vector: Tensor, tensors: Sequence[Tensor]) -> list[Tensor]:
    """Return consecutive parts of a vector in the shapes of tensors."""
    parts = vector.split([tensor.numel() for tensor in tensors])
    return [part.view(tensor.shape) for part, tensor in zip(parts, tensors, strict=True)]


def as_vector(tensors: Sequence[Tensor]) -> Tensor:
    """Move tensors into one vector and make them views of it; return the vector."""
    vector = torch.cat([tensor.detach().reshape(-1) for tensor in tensors])
    for tensor, view in zip(tensors, views(vector, tensors), strict=True):
        tensor.data = view
    return vector


def vector_adam(
    vector: Tensor, slopes: Tensor, sizes: Sequence[int], rates: Sequence[float]
) -> torch.optim.Adam:
    """Return Adam for a vector of weights with a learning rate per part.

    Args:
        vector: the weights.
        slopes: tensor of their derivatives.
        sizes: sizes of the parts.
        rates: learning rate of each part; equal rates need one step only.
    """
    if len(set(rates)) == 1:
        sizes, rates = [len(vector)], rates[:1]
    groups = []
    for part, slope, rate in zip(vector.split(sizes), slopes.split(sizes), rates, strict=True):
        parameter = nn.Parameter(part)
        parameter.grad = slope
        groups.append({"params": [parameter], "lr": rate})
    return torch.optim.Adam(groups, fused=True)


@torch.no_grad()
def take_step(optimizer: torch.optim.Adam) -> None:
    """Take the step of ``optimizer.step()`` without torch's overhead per call."""
    if not optimizer.state:  # created by the first step
        optimizer.step()
        return
    for group in optimizer.param_groups:
        first, second = group["betas"]
        parameters = group["params"]
        states = [optimizer.state[parameter] for parameter in parameters]
        averages, squares, steps = (
            [state[name] for state in states] for name in ("exp_avg", "exp_avg_sq", "step")
        )
        for step in steps:
            step += 1
        torch._fused_adam_(
            parameters,
            [parameter.grad for parameter in parameters],
            averages,
            squares,
            [],
            steps,
            lr=group["lr"],
            beta1=first,
            beta2=second,
            weight_decay=0.0,
            eps=group["eps"],
            amsgrad=False,
            maximize=False,
        )


@contextmanager
def denormals_flushed() -> Iterator[None]:
    """Flush denormal numbers to zero, if the processor supports it.

    The momentum of a weight without a gradient, such as one behind a ReLU that is always zero,
    becomes denormal; arithmetic with such numbers is many times slower.
    """
    before = not bool(torch.tensor(1e-39) * 1.0)
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)
