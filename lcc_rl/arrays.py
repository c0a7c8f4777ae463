"""Types of NumPy arrays, and a ratio of arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]


def per_distance(energy: Any, way: Any) -> Any:
    """Return energy per distance; NaN for vehicles that do not move."""
    return energy / np.where(way > 0.0, way, np.nan)
