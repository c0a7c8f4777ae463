"""Bootstrap confidence intervals of means over training seeds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import bootstrap

CONFIDENCE = 0.95
RESAMPLES = 9999
SEED = 0  # of the resampling: the same rows give the same interval


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % interval over seeds; of one seed the bounds are missing.

    Args:
        value: the estimate.
        low: lower bound of the interval.
        high: upper bound of the interval.
    """

    value: float
    low: float
    high: float

    def columns(self, name: str, factor: float = 1.0) -> dict[str, float]:
        """Return ``name``, ``name_low`` and ``name_high``, scaled."""
        return {
            name: factor * self.value,
            f"{name}_low": factor * self.low,
            f"{name}_high": factor * self.high,
        }


def mean(values: ArrayLike) -> Estimate:
    """Return the mean of one number per seed with its percentile-bootstrap interval."""
    numbers = _numbers(values)
    if len(numbers) < 2:
        return Estimate(_mean(numbers), np.nan, np.nan)
    low, high = _bounds([numbers], np.mean)
    return Estimate(_mean(numbers), float(low), float(high))


def share_saved(value: Any, baseline: Any) -> Any:
    """Return the saved share of a baseline's energy, also where that is negative (recuperation)."""
    return (baseline - value) / abs(baseline)


def saving(values: ArrayLike, baseline: ArrayLike, exact: bool = False) -> Estimate:
    """Return the share saved by the mean against that of a baseline, see :func:`share_saved`.

    The seeds of two trainings are independent, so both sides are resampled independently.

    Args:
        values: mean energy of each seed.
        baseline: mean energy of each seed of the baseline.
        exact: the baseline was not trained (a human driver): its value is known exactly.

    Returns:
        The share with its interval; without one where a trained side has a single seed.
    """
    own, other = _numbers(values), _numbers(baseline)
    value = share_saved(_mean(own), _mean(other))
    if len(own) < 2 or (len(other) < 2 and not exact):
        return Estimate(value, np.nan, np.nan)
    if exact:
        low, high = _bounds([own], lambda a, axis: share_saved(np.mean(a, axis), _mean(other)))
    else:
        low, high = _bounds(
            [own, other], lambda a, b, axis: share_saved(np.mean(a, axis), np.mean(b, axis))
        )
    return Estimate(value, float(low), float(high))


def band(curves: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bounds of the mean over seeds at every point of a curve.

    Args:
        curves: ``[points, seeds]``, at least two seeds.

    Returns:
        Lower and upper bound, each ``[points]``.
    """
    return _bounds([curves], np.mean, RESAMPLES // 9, axis=1)


def _bounds(
    samples: list[NDArray[np.float64]], statistic: object, resamples: int = RESAMPLES, axis: int = 0
) -> tuple[Any, Any]:
    found = bootstrap(
        samples,
        statistic,
        axis=axis,
        vectorized=True,
        n_resamples=resamples,
        confidence_level=CONFIDENCE,
        method="percentile",
        random_state=np.random.default_rng(SEED),
    )
    return found.confidence_interval.low, found.confidence_interval.high


def _numbers(values: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(values, dtype=np.float64).ravel()


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if len(values) else float("nan")
