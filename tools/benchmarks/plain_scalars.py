"""Scalar equations that the plain environment and the loops of numba share."""

from __future__ import annotations

from lcc_rl.functional.power import POWER_COEFFICIENTS
from lcc_rl.functional.random import MASK


def bits(counter: int) -> int:
    """Mix the low 32 bits of a number, see :func:`lcc_rl.functional.random.hash_bits`."""
    x = counter & MASK
    x = (x ^ (x >> 16)) * 0x7FEB352D & MASK
    x = (x ^ (x >> 15)) * 0x2C1B3C6D & MASK
    return x ^ (x >> 16)


def power(v: float, a: float) -> float:
    """Return the motor's power (A2) [W]."""
    (p00, p01, p02), (p10, p11, p12), (p20, p21, _), (p30, _, _) = POWER_COEFFICIENTS
    constant = p00 + v * (p10 + v * (p20 + v * p30))
    return constant + a * (p01 + v * (p11 + v * p21) + a * (p02 + v * p12))
