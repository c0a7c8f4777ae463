"""Bootstrap confidence intervals over held-out windows or drives, and training seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

CONFIDENCE = 0.95
RESAMPLES = 9999
LEAST_DRIVES = 5  # fewer tell too little of how drives differ
SEED = 0  # of the resampling: the same rows give the same interval


@dataclass(frozen=True)
class Estimate:
    """A value with the bounds of its 95 % interval; NaN bounds if nothing can be resampled."""

    value: float
    low: float = np.nan
    high: float = np.nan

    def columns(self, name: str, factor: float = 1.0) -> dict[str, float]:
        """Return ``name``, ``name_low`` and ``name_high``, scaled."""
        values = {"": self.value, "_low": self.low, "_high": self.high}
        return {f"{name}{end}": factor * value for end, value in values.items()}


def mean(values: ArrayLike) -> Estimate:
    """Return the mean of one number per seed with its percentile-bootstrap interval."""
    numbers = np.asarray(values, dtype=np.float64).ravel()
    if len(numbers) < 2:
        return Estimate(_mean(numbers))
    low, high = _bounds(numbers)
    return Estimate(_mean(numbers), float(low), float(high))


def crossed(values: ArrayLike, drives: Sequence[object] | None = None) -> Estimate:
    """Return the mean of ``[windows, seeds]`` with its interval, resampled as in :func:`saving`."""
    table = np.asarray(values, dtype=np.float64)
    if max(table.shape) < 2:
        return Estimate(_mean(table))
    return Estimate(_mean(table), *bounds(_means(table, 1, drives)))


def share_saved(value: Any, baseline: Any) -> Any:
    """Return the saved share of a baseline's energy, also if that is negative (recuperation)."""
    return (baseline - value) / abs(baseline)


def saving(
    values: ArrayLike,
    baseline: ArrayLike,
    paired: bool = False,
    drives: Sequence[object] | None = None,
    ways: tuple[ArrayLike, ArrayLike] | None = None,
) -> Estimate:
    """Return the share saved by the mean against that of a baseline, see :func:`share_saved`.

    The interval is that of a clustered bootstrap: held-out windows and training seeds are
    resampled crosswise (the pigeonhole bootstrap, Owen 2007). Both sides meet the same windows;
    the seeds of two trainings are independent. From n windows or seeds n − 1 are drawn, which
    makes the variance of a mean unbiased (Rao and Wu 1988). In synthetic data with 20 windows, 95 %
    intervals of eight seeds hold the truth in 90 to 97 % of cases, of four in 80 to 91 %, of two
    in 61 to 84 %: with few seeds that differ much, the interval is too narrow.

    Args:
        values: mean energy over all drivers, ``[windows, seeds]``.
        baseline: that of the baseline in the same windows, ``[windows, its seeds]``; a single
            column if it was not trained (a human driver).
        paired: column by column, both sides come from the same training.
        drives: what each window is cut from; whole drives are resampled if there are at least
            five, because windows of one drive are alike.
        ways: the distances of both sides, as the energies: what is saved is then energy per
            distance, ratios of totals, in which energy and distance are resampled together.

    Returns:
        The share with its interval; without one if there is one window and one seed of each, or if
        resampled baselines are of both signs: then no share of them means anything. The share of a
        baseline of zero is NaN. If a side has one seed, the interval does not cover what another
        seed would change.
    """
    sides = [np.asarray(side, dtype=np.float64) for side in (values, baseline)]
    driven = [np.asarray(side, dtype=np.float64) for side in ways or map(np.ones_like, sides)]
    ours, theirs = (_mean(x) / _mean(way) for x, way in zip(sides, driven, strict=True))
    if theirs == 0.0:
        return Estimate(np.nan)
    value = share_saved(ours, theirs)
    if max(shape for side in sides for shape in side.shape) < 2:
        return Estimate(value)
    means = (
        _means(x, stream, drives) / _means(way, stream, drives)
        for x, way, stream in zip(sides, driven, (1, 1 if paired else 2), strict=True)
    )
    own, other = means
    if other.min() <= 0.0 <= other.max():
        return Estimate(value)
    low, high = bounds(share_saved(own, other))
    # Of two windows one is drawn, and the share of both may lie outside those of either.
    return Estimate(value, min(low, value), max(high, value))


def _means(
    table: NDArray[np.float64], stream: int, drives: Sequence[object] | None = None
) -> NDArray[np.float64]:
    """Return the resampled means of ``[windows, seeds]``; a stream draws its own seeds."""
    drawn = drawn_windows(len(table), drives) @ table
    return (drawn * weights(table.shape[1], stream)).sum(1)


def drawn_windows(count: int, drives: Sequence[object] | None = None) -> NDArray[np.float64]:
    """Return the weights of windows in every resample, ``[RESAMPLES, count]``; of whole drives.

    Args:
        count: number of windows.
        drives: as of :func:`saving`.
    """
    if drives is None or len(set(drives)) < LEAST_DRIVES:
        return weights(count, 0)
    names = {name: code for code, name in enumerate(dict.fromkeys(drives))}
    drawn = weights(len(names), 0)[:, [names[name] for name in drives]]
    return drawn / drawn.sum(1, keepdims=True)


def bounds(resampled: NDArray[np.float64]) -> tuple[float, float]:
    """Return the bounds of an interval from resampled estimates, by their percentiles."""
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = np.quantile(resampled, [tail, 1.0 - tail])
    return float(low), float(high)


@lru_cache(maxsize=8)  # a table asks for the same ones again and again
def weights(count: int, stream: int) -> NDArray[np.float64]:
    """Return the weights of ``count`` units in every resample, ``[RESAMPLES, count]``."""
    draws, generator = max(count - 1, 1), np.random.default_rng([SEED, stream])
    return generator.multinomial(draws, np.full(count, 1.0 / count), RESAMPLES) / draws


def band(curves: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the bounds of the mean over seeds at every point of a curve, each ``[points]``.

    Args:
        curves: ``[points, seeds]``, at least two seeds.
    """
    return _bounds(curves, RESAMPLES // 9, axis=1)


def _bounds(
    sample: NDArray[np.float64], resamples: int = RESAMPLES, axis: int = 0
) -> tuple[Any, Any]:
    from scipy.stats import bootstrap  # here: it loads for a second

    found = bootstrap(
        [sample],
        np.mean,
        axis=axis,
        vectorized=True,
        n_resamples=resamples,
        confidence_level=CONFIDENCE,
        method="percentile",
        random_state=np.random.default_rng(SEED),
    )
    return found.confidence_interval.low, found.confidence_interval.high


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if len(values) else float("nan")
