"""Whether tensors hold finite numbers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor


def any_lost(values: Iterable[Tensor]) -> bool:
    """Whether something may not be a number: a sum of each, which neither NaN nor inf leaves."""
    sums = [value.sum() for value in values if value.is_floating_point()]
    return bool(sums) and not bool(torch.stack(sums).sum().isfinite())


def lost_weight(weights: Mapping[str, Tensor]) -> str | None:
    """Name the first weight that holds something other than numbers; None where none does."""
    if not any_lost(weights.values()):
        return None
    return next((name for name, x in weights.items() if not bool(x.isfinite().all())), None)
