"""Counter-based random numbers: a draw is a function of (seed, step, stream), not of history.

An episode therefore has the same noise at any place in the batch, with any controller and on any
device, and its seed is the only state. The counter is hashed by integers (two rounds of xor-shift
and multiply on 32 bits), as in
Salmon et al., "Parallel random numbers: as easy as 1, 2, 3" (SC 2011).
"""

from __future__ import annotations

import zlib

import torch
from torch import Tensor

LOW_BITS = 0xFFFFFFFF
# The golden ratio: consecutive counters differ in about half the bits.
STEP_INCREMENT = 0x9E3779B9
STREAM_INCREMENT = 0x85EBCA6B


def stream_id(name: str) -> int:
    """Return the stream of a name, such as ``"hdv.noise"``."""
    return zlib.crc32(name.encode())


def hash_bits(counter: Tensor) -> Tensor:
    """Mix the low 32 bits of an int64 tensor; the result has 32 well-mixed bits in int64."""
    x = counter & LOW_BITS
    x = (x ^ (x >> 16)) * 0x7FEB352D & LOW_BITS
    x = (x ^ (x >> 15)) * 0x2C1B3C6D & LOW_BITS
    return x ^ (x >> 16)


def uniform(seed: Tensor, step: Tensor | int, stream: Tensor | int = 0) -> Tensor:
    """Draw from U[0, 1) by counter.

    Args:
        seed: seed of each episode, int64, any shape.
        step: step within the episode, broadcastable to ``seed``.
        stream: purpose of the draw; different streams are independent.

    Returns:
        float32 of the broadcast shape.
    """
    # The mask keeps the low 32 bits, so that the product fits into 64.
    bits = hash_bits(seed + step * STEP_INCREMENT + (stream * STREAM_INCREMENT & LOW_BITS))
    return (bits >> 8).to(torch.float32) * 2.0**-24


def normal(seed: Tensor, step: Tensor | int, stream: Tensor | int = 0) -> Tensor:
    """Draw from N(0, 1) by counter; arguments as in :func:`uniform`."""
    # The middles of the uniform draw's cells. The last would be rounded to 1, which maps to ∞.
    middle = (uniform(seed, step, stream) + 2.0**-25).clamp(max=1.0 - 2.0**-24)
    return torch.special.ndtri(middle)


def between(bounds: tuple[float, float], seed: Tensor, stream: Tensor | int) -> Tensor:
    """Draw uniformly between two bounds, once in an episode; float32 of the broadcast shape."""
    return bounds[0] + (bounds[1] - bounds[0]) * uniform(seed, 0, stream)


def choose(seed: Tensor, count: Tensor | int, stream: Tensor | int = 0) -> Tensor:
    """Draw an index from 0 … count − 1 by counter; int64 of the broadcast shape."""
    bits = hash_bits(seed + (stream * STREAM_INCREMENT & LOW_BITS))  # as in :func:`uniform`
    return bits * count >> 32
