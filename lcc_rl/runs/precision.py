"""Setup of torch: device, threads and measured precision of float32 matrix products."""

from __future__ import annotations

import logging

import torch

from lcc_rl.config.schemas import BaseConfig
from lcc_rl.io.memory import torch_device

log = logging.getLogger("lcc_rl")

SINGLE_PRECISION = 1e-4  # relative error above which products are not in single precision


def prepare_torch(cfg: BaseConfig) -> torch.device:
    """Set up torch and return the device."""
    device = torch_device(cfg.device)
    torch.set_num_threads(cfg.threads)
    set_precision(cfg.matmul_precision)
    # TorchRL logs every buffer it allocates.
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    return device


def set_precision(name: str) -> None:
    """Set torch's precision of float32 matrix products and log their error on this machine.

    Below ``highest`` torch may choose faster kernels. Whether they compute in single precision
    depends on the machine, so the error is measured.

    Args:
        name: ``highest``, ``high`` or ``medium``, as in ``torch.set_float32_matmul_precision``.
    """
    torch.set_float32_matmul_precision("highest")
    if name == "highest":
        return
    best = product_error()
    torch.set_float32_matmul_precision(name)
    error = product_error()
    report = log.info if error < SINGLE_PRECISION else log.warning
    report("matmul_precision=%s: relative error %.1g, at the highest %.1g", name, error, best)


def product_error() -> float:
    """Return the largest error of a product ``[1024, 200] × [200, 100]`` over its maximum."""
    generator = torch.Generator().manual_seed(0)
    left = torch.randn(1024, 200, generator=generator)
    right = torch.randn(200, 100, generator=generator)
    exact = left.double() @ right.double()
    return float(((left @ right).double() - exact).abs().max() / exact.abs().max())
