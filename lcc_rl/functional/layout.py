"""Memory layout of a batch of strings: the episodes are contiguous.

Entries are ``[*batch, N, w]``. With the batch innermost in memory, selected vehicles, one component
of an entry and sums over vehicles are runs of contiguous numbers for any N and w.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def reverse(entry: Tensor) -> Tensor:
    """Return a view with the dimensions in reverse order."""
    return entry.permute(tuple(range(entry.ndim - 1, -1, -1)))


def batch_innermost(entry: Tensor) -> Tensor:
    """Return an entry, copied where necessary, whose first dimensions are innermost in memory."""
    return reverse(reverse(entry).contiguous())


def join(parts: Sequence[Tensor], dim: int) -> Tensor:
    """Concatenate entries; the batch is innermost in memory.

    Args:
        parts: entries ``[*batch, N, w]``.
        dim: −2 for vehicles, −1 for components of the entry.
    """
    return reverse(torch.cat([reverse(part) for part in parts], -1 - dim))


def total(entry: Tensor, dim: int) -> Tensor:
    """Sum over vehicles (−2) or components (−1), in an order independent of the memory layout."""
    return entry.contiguous().sum(dim, keepdim=True)
