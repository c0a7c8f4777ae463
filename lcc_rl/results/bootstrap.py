"""Bootstrap confidence intervals over held-out windows or drives, and training seeds."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
import scipy  # loads special where it is used
from numpy.typing import ArrayLike

from lcc_rl.arrays import Floats, per_distance

CONFIDENCE = 0.95
RESAMPLES = 9999
LEAST_DRIVES = 5  # least number of drives, or of their minutes, that are resampled
RESAMPLING_SEED = 0  # equal rows give equal intervals
BOUNDED = ("", "_low", "_high")  # of the names of a value and of the bounds of its interval

Side = Mapping[str, Floats]  # columns of one side of a comparison, each ``[..., windows, seeds]``


class Minute(NamedTuple):
    """A minute of a drive, in which a window starts; windows at one time are similar."""

    drive: object
    minute: int


@dataclass(frozen=True)
class Estimate:
    """A value with the bounds of its 95 % interval; NaN bounds if nothing can be resampled.

    Two to four drives also give a t-interval, ``over_drives``. A comparison at equal flow has
    ``more_flow``, the share by which this flow exceeds that of its reference.
    """

    value: float
    low: float = np.nan
    high: float = np.nan
    over_drives: tuple[float, float] | None = None
    more_flow: float = np.nan

    def columns(self, name: str, factor: float = 1.0) -> dict[str, float]:
        """Return ``name``, ``name_low`` and ``name_high``, scaled."""
        values = zip(BOUNDED, (self.value, self.low, self.high), strict=True)
        return {f"{name}{end}": factor * value for end, value in values}


NOTHING = Estimate(np.nan)


def estimate(
    statistic: Callable[..., Any],
    *sides: Side,
    drives: Sequence[object] | None = None,
    paired: bool = False,
) -> Estimate:
    """Return a statistic of means with its interval.

    The interval is that of a clustered bootstrap: held-out windows and training seeds are
    resampled independently (the pigeonhole bootstrap, Owen 2007). All sides share the windows, and
    with ``paired`` the seeds. From n windows or seeds n − 1 are drawn, which makes the
    variance of a mean unbiased (Rao and Wu 1988). In synthetic data with 20 windows, 95 % intervals
    contain the true value in 90 to 97 % of cases with eight seeds, 80 to 91 % with four and 61 to
    84 % with two: with few seeds that differ much, the interval is too narrow. So it is over few
    drives: it contains the true saving in 84, 88, 91 and 92 % of cases with 5, 6, 9 and 18 drives
    with normal savings, in 71 to 81 % with a skewed distribution.

    Args:
        statistic: function of one mapping per side with the mean of each column, ``[...]``, or its
            resampled means, ``[..., RESAMPLES]``.
        sides: columns of each side for the same windows; one seed without training.
        drives: drive of each window, or :class:`Minute` of it. If there are at least five drives,
            whole drives are resampled, because windows of one drive are similar; else minutes of
            drives, if these are at least five; else windows.
        paired: whether equal seeds of all sides belong to one training.

    Returns:
        The statistic. It has no interval if it is NaN, if each side has one window and one seed, or
        if no resample has a value. With one seed, the interval excludes the variation of seeds.
    """
    value = float(statistic(*({key: x.mean((-2, -1)) for key, x in one.items()} for one in sides)))
    if not np.isfinite(value) or max(max(x.shape[-2:]) for one in sides for x in one.values()) < 2:
        return Estimate(value)
    streams = [1 if paired else side for side in range(1, len(sides) + 1)]
    drawn = (
        {key: resampled(x, stream, drives) for key, x in one.items()}
        for one, stream in zip(sides, streams, strict=True)
    )
    draws = statistic(*drawn)
    draws = draws[np.isfinite(draws)]
    if not len(draws):
        return Estimate(value)
    low, high = bounds(draws)
    # Of two windows one is drawn, and the value of both may lie outside the values of each.
    ends = min(float(low), value), max(float(high), value)
    return Estimate(value, *ends, _over_drives(statistic, sides, drives or (), value))


def _over_drives(
    statistic: Callable[..., Any], sides: Sequence[Side], drives: Sequence[object], value: float
) -> tuple[float, float] | None:
    """Return the t-interval over two to four drives, by the jackknife's standard error."""
    drives = whole(drives)
    names = list(dict.fromkeys(drives))
    if not 2 <= len(names) < LEAST_DRIVES:
        return None
    jackknife = []
    for name in names:
        mask = np.array([drive != name for drive in drives])
        means = ({key: x[..., mask, :].mean((-2, -1)) for key, x in one.items()} for one in sides)
        jackknife.append(float(statistic(*means)))
    half_width = student(len(names)) * float(np.std(jackknife)) * (len(names) - 1) ** 0.5
    return value - half_width, value + half_width


def whole(drives: Sequence[object]) -> list[object]:
    """Return the drive of each window, without minutes."""
    return [of.drive if isinstance(of, Minute) else of for of in drives]


def clusters(drives: Sequence[object]) -> list[object]:
    """Return the group of each window that is resampled as a whole; empty: windows are.

    Examples:
        >>> clusters([Minute("a", 0), Minute("a", 0), *(Minute("a", i) for i in range(1, 5))])[1:3]
        [Minute(drive='a', minute=0), Minute(drive='a', minute=1)]
        >>> clusters([Minute(drive, 0) for drive in "aabcde"])
        ['a', 'a', 'b', 'c', 'd', 'e']
    """
    groups = (whole(drives), list(drives))
    return next((group for group in groups if len(set(group)) >= LEAST_DRIVES), [])


def resampled(table: Floats, stream: int, drives: Sequence[object] | None) -> Floats:
    """Return the resampled means of ``[..., windows, seeds]``; ``stream`` draws the seeds."""
    drawn = drawn_windows(table.shape[-2], tuple(drives or ())) @ table
    return np.asarray((drawn * resample_weights(table.shape[-1], stream)).sum(-1))


@lru_cache(maxsize=1)  # all measures of a strategy have the same windows
def drawn_windows(count: int, drives: tuple[object, ...]) -> Floats:
    """Return the weights of windows in every resample, ``[RESAMPLES, count]``."""
    if not (groups := clusters(drives)):
        return resample_weights(count, 0)
    names = {name: code for code, name in enumerate(dict.fromkeys(groups))}
    drawn = resample_weights(len(names), 0)[:, [names[name] for name in groups]]
    return np.asarray(drawn / drawn.sum(1, keepdims=True))


@lru_cache(maxsize=8)  # tables repeat the same calls
def resample_weights(count: int, stream: int) -> Floats:
    """Return the weights of ``count`` units in every resample, ``[RESAMPLES, count]``."""
    draws, generator = max(count - 1, 1), np.random.default_rng([RESAMPLING_SEED, stream])
    return generator.multinomial(draws, np.full(count, 1.0 / count), RESAMPLES) / draws


def bounds(values: Floats) -> Floats:
    """Return the bounds of an interval from resampled values, ``[2, ...]``, by percentiles."""
    tail = (1.0 - CONFIDENCE) / 2.0
    return np.asarray(np.quantile(values, [tail, 1.0 - tail], axis=-1))


def mean(values: ArrayLike) -> Estimate:
    """Return the mean of one number per seed with its t-interval over seeds."""
    numbers = np.asarray(values, dtype=np.float64).reshape(1, -1)
    if not numbers.size:
        return NOTHING
    ends = band(numbers)[:, 0].tolist() if numbers.size > 1 else ()
    return Estimate(float(numbers.mean()), *ends)


def crossed(values: ArrayLike, drives: Sequence[object] | None = None) -> Estimate:
    """Return the mean of ``[windows, seeds]`` with its interval, see :func:`estimate`."""
    return estimate(itemgetter(""), {"": np.asarray(values, dtype=np.float64)}, drives=drives)


def band(curves: Floats) -> Floats:
    """Return the t-interval of the mean over seeds at every point of a curve, ``[2, points]``.

    Args:
        curves: ``[points, seeds]``, at least two seeds.
    """
    count = curves.shape[1]
    half = student(count) * curves.std(1, ddof=1) / count**0.5
    return curves.mean(1) + np.stack([-half, half])


def student(count: int) -> float:
    """Return the factor of the standard error of a mean of some values, of Student's t."""
    return float(scipy.special.stdtrit(count - 1, 0.5 + 0.5 * CONFIDENCE))


def share_saved(value: Any, baseline: Any) -> Any:
    """Return the saved share of a baseline's energy, which may be negative (recuperation)."""
    return (baseline - value) / abs(baseline)


def saving(
    values: ArrayLike,
    baseline: ArrayLike,
    paired: bool = False,
    drives: Sequence[object] | None = None,
    ways: tuple[ArrayLike, ArrayLike] | None = None,
) -> Estimate:
    """Return the share of a baseline's mean energy that is saved, see :func:`estimate`.

    Args:
        values: mean energy over all drivers, ``[windows, seeds]``.
        baseline: that of the baseline in the same windows, ``[windows, its seeds]``.
        paired, drives: as for :func:`estimate`.
        ways: distances of both sides, shaped as the energies. The saving is then one of energy per
            distance, a ratio of totals; energy and distance are resampled together.

    Returns:
        The share; without an interval if resampled baselines have both signs. It is NaN for a
        baseline of zero.
    """
    sides = [np.asarray(side, dtype=np.float64) for side in (values, baseline)]
    driven = [np.asarray(side, dtype=np.float64) for side in ways or map(np.ones_like, sides)]
    both = ({"energy": x, "way": distance} for x, distance in zip(sides, driven, strict=True))
    return estimate(_saved, *both, drives=drives, paired=paired)


def equal_seeds(*sides: Collection[object]) -> bool:
    """Whether all sides with several training seeds have the same ones and are resampled in pairs.

    Examples:
        >>> equal_seeds([0, 1], [1, 0], [0]), equal_seeds([0, 1], [0, 2])
        (True, False)
    """
    return len({frozenset(seeds) for seeds in sides if len(seeds) > 1}) < 2


def _saved(ours: Side, theirs: Side) -> Any:
    energy, other = (per_distance(side["energy"], side["way"]) for side in (ours, theirs))
    if (other <= 0.0).any() and (other >= 0.0).any():
        return np.full_like(energy, np.nan)
    return share_saved(energy, other)
