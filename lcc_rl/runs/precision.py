"""Precision of float32 matrix products, with its error measured on this machine."""

from __future__ import annotations

import logging

import torch

from lcc_rl.errors import unknown_name

log = logging.getLogger("lcc_rl")

PRECISIONS = ("highest", "high", "medium")
SINGLE = 1e-4  # relative error beyond which products are no longer single precision


def set_precision(name: str) -> float:
    """Set torch's precision of float32 matrix products and log the error here.

    Below ``highest`` torch may choose other kernels, which are faster on some processors; whether
    they compute in single precision at all depends on the machine, so the error is measured.

    Args:
        name: ``highest``, ``high`` or ``medium``, as in ``torch.set_float32_matmul_precision``.

    Returns:
        The relative error of a product of the size of a network's layer.

    Raises:
        ConfigError: if the name is unknown.
    """
    if name not in PRECISIONS:
        raise unknown_name("matmul_precision", name, PRECISIONS)
    torch.set_float32_matmul_precision("highest")
    best = product_error()
    torch.set_float32_matmul_precision(name)
    if name == "highest":
        return best
    error = product_error()
    report = log.info if error < SINGLE else log.warning
    report("matmul_precision=%s: relative error %.1g, at the highest %.1g", name, error, best)
    return error


def product_error() -> float:
    """Largest error of a product ``[1024, 200] × [200, 100]``, relative to its largest entry."""
    generator = torch.Generator().manual_seed(0)
    left = torch.randn(1024, 200, generator=generator)
    right = torch.randn(200, 100, generator=generator)
    exact = left.double() @ right.double()
    return float(((left @ right).double() - exact).abs().max() / exact.abs().max())
