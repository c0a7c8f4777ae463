"""Interval room: how sure a mean over training seeds is, by bootstrap."""

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
    """A value with its 95 % interval over seeds; the bounds are missing where there is one seed.

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
    """Estimate the mean over seeds.

    Args:
        values: one number per seed.

    Returns:
        The mean with its percentile-bootstrap interval.
    """
    numbers = _numbers(values)
    if len(numbers) < 2:
        return Estimate(_mean(numbers), np.nan, np.nan)
    low, high = _interval([numbers], np.mean)
    return Estimate(_mean(numbers), low, high)


def share_saved(value: Any, baseline: Any) -> Any:
    """Return the share of a baseline's energy that is saved.

    Positive where less is drawn, also where the baseline itself gains energy (by recuperation).
    """
    return (baseline - value) / abs(baseline)


def saving(values: ArrayLike, baseline: ArrayLike, exact: bool = False) -> Estimate:
    """Estimate the share saved against a baseline, of the means, see :func:`share_saved`.

    Seeds of two trainings have nothing in common, so each side is resampled on its own.

    Args:
        values: mean energy of each seed.
        baseline: mean energy of each seed of the baseline.
        exact: the baseline was not trained (a human driver): its one value is known.

    Returns:
        The share with its interval; without one where a trained side has a single seed.
    """
    own, other = _numbers(values), _numbers(baseline)
    value = share_saved(_mean(own), _mean(other))
    if len(own) < 2 or (len(other) < 2 and not exact):
        return Estimate(value, np.nan, np.nan)
    if exact:
        low, high = _interval([own], lambda a, axis: share_saved(np.mean(a, axis), _mean(other)))
    else:
        low, high = _interval(
            [own, other],
            lambda a, b, axis: share_saved(np.mean(a, axis), np.mean(b, axis)),
        )
    return Estimate(value, low, high)


def band(curves: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bounds of the mean over seeds at every point of a curve.

    Args:
        curves: ``[points, seeds]``, at least two seeds.

    Returns:
        Lower and upper bound, each ``[points]``.
    """
    found = bootstrap(
        (curves,),
        np.mean,
        axis=1,
        vectorized=True,
        n_resamples=RESAMPLES // 9,
        confidence_level=CONFIDENCE,
        method="percentile",
        random_state=np.random.default_rng(SEED),
    )
    return found.confidence_interval.low, found.confidence_interval.high


def _interval(samples: list[NDArray[np.float64]], statistic: object) -> tuple[float, float]:
    found = bootstrap(
        samples,
        statistic,
        vectorized=True,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        random_state=np.random.default_rng(SEED),
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def _numbers(values: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(values, dtype=np.float64).ravel()


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if len(values) else float("nan")
