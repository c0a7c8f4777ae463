"""Types of NumPy arrays, ratios, and times of steps."""

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


def times(steps: Any, time_step: float) -> Floats:
    """Return the times of numbered steps, to 1 ns: 0.3 s, not 0.30000000000000004 s."""
    return np.round(steps * time_step, 9)
