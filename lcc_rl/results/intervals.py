"""95 % intervals over held-out windows or drives, and training seeds, by Student's t."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
import scipy  # loads special where it is used
from numpy.typing import ArrayLike

from lcc_rl.arrays import Floats, per_distance

CONFIDENCE = 0.95
BOUNDED = ("", "_low", "_high")  # of the names of a value and of the bounds of its interval

Side = Mapping[str, Floats]  # columns of one side of a comparison, each ``[..., windows, seeds]``


class Minute(NamedTuple):
    """A minute of a drive, in which a window starts; windows at one time are similar."""

    drive: object
    minute: int


@dataclass(frozen=True)
class Estimate:
    """A value with the bounds of its 95 % interval; NaN bounds if nothing varies.

    A comparison at equal flow has ``more_flow``, the share by which this flow exceeds that of its
    reference.
    """

    value: float
    low: float = np.nan
    high: float = np.nan
    more_flow: float = np.nan

    def within(self, least: float = -np.inf, most: float = np.inf) -> Estimate:
        """Return it with the bounds of its interval cut at the ends of a range."""
        low, high = np.clip([self.low, self.high], least, most).tolist()
        return replace(self, low=low, high=high)

    @property
    def percent(self) -> tuple[float, float, float]:
        """The value and its bounds in per cent."""
        return 100.0 * self.value, 100.0 * self.low, 100.0 * self.high

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

    The variance is that of the jackknife (Efron and Stein 1981): over held-out windows, and over
    the training seeds of each side, each left out in turn. The sum of these variances has the
    degrees of freedom of Satterthwaite (1946). In synthetic data with 2 to 18 drives and 1 to 8
    seeds, the interval contains the true saving in 87 to 97 % of cases if savings are normal, in 79
    to 95 % if they are skewed; in 79 to 96 % also if seeds differ much.

    Args:
        statistic: function of one mapping per side with the mean of each column, ``[...]``, or with
            those without one group after the other, ``[..., groups]``.
        sides: columns of each side for the same windows; one seed without training.
        drives: drive of each window, or :class:`Minute` of it, see :func:`clusters`. Windows of one
            are similar and left out together.
        paired: whether equal seeds of all sides belong to one training.

    Returns:
        The statistic. It has no interval if it is NaN or would be without some group, and if each
        side has one window and one seed. With one seed, the interval excludes the variation of
        seeds.
    """
    value = float(statistic(*({key: x.mean((-2, -1)) for key, x in one.items()} for one in sides)))
    without = (np.asarray(statistic(*means)) for means in _left_out(sides, drives, paired))
    parts = [(x.var() * (x.size - 1), x.size - 1) for x in without]
    total = sum(part for part, _ in parts)
    if not parts or not np.isfinite(value + total):
        return Estimate(value)
    if total == 0.0:
        return Estimate(value, value, value)
    half = student(total**2 / sum(part**2 / free for part, free in parts)) * total**0.5
    return Estimate(value, value - half, value + half)


def _left_out(
    sides: Sequence[Side], drives: Sequence[object] | None, paired: bool
) -> Iterator[list[dict[str, Floats]]]:
    """Yield the means of all sides without each of the windows' groups, and without each seed."""
    if (windows := next(iter(sides[0].values())).shape[-2]) > 1:
        groups = clusters(drives or ()) or range(windows)
        yield [{key: means_without(x.mean(-1), groups) for key, x in one.items()} for one in sides]
    seeds = [next(iter(one.values())).shape[-1] for one in sides]
    varied = [place for place, count in enumerate(seeds) if count > 1]
    means = [{key: x.mean((-2, -1))[..., None] for key, x in one.items()} for one in sides]
    for places in filter(None, [varied] if paired else [[place] for place in varied]):
        found = means.copy()
        for place in places:
            each = range(seeds[place])
            found[place] = {x: means_without(y.mean(-2), each) for x, y in sides[place].items()}
        yield found


def means_without(values: Floats, groups: Sequence[object]) -> Floats:
    """Return the means of ``[..., values]`` without each of their groups, ``[..., groups]``.

    Examples:
        >>> means_without(np.array([1.0, 2.0, 3.0]), ["a", "a", "b"])
        array([3. , 1.5])
    """
    names = {name: code for code, name in enumerate(dict.fromkeys(groups))}
    codes = np.array([names[name] for name in groups])
    order, counts = np.argsort(codes, kind="stable"), np.bincount(codes)
    sums = np.add.reduceat(values[..., order], counts.cumsum() - counts, axis=-1)
    return np.asarray((values.sum(-1, keepdims=True) - sums) / (len(codes) - counts))


def clusters(drives: Sequence[object]) -> list[object]:
    """Return the group of each window: drives, or minutes of a single one; else empty.

    Examples:
        >>> clusters([Minute("a", 0), Minute("a", 0), Minute("a", 3)])
        [Minute(drive='a', minute=0), Minute(drive='a', minute=0), Minute(drive='a', minute=3)]
        >>> clusters([Minute(drive, 0) for drive in "aab"])
        ['a', 'a', 'b']
    """
    whole = [of.drive if isinstance(of, Minute) else of for of in drives]
    unit = varied(len({*whole}), len({*drives}))
    return {"drives": whole, "minutes": [*drives]}.get(unit, [])


def varied(drives: int, minutes: int = 0) -> str:
    """Return what intervals are over: several drives, else minutes of the only one, or windows."""
    return "drives" if drives > 1 else "minutes" if minutes > 1 else "windows"


def mean(values: ArrayLike) -> Estimate:
    """Return the mean of one number per seed with its interval over seeds."""
    numbers = np.asarray(values, dtype=np.float64).reshape(1, -1)
    return crossed(numbers) if numbers.size else NOTHING


def crossed(values: ArrayLike, drives: Sequence[object] | None = None) -> Estimate:
    """Return the mean of ``[windows, seeds]`` with its interval, see :func:`estimate`."""
    return estimate(itemgetter(""), {"": np.asarray(values, dtype=np.float64)}, drives=drives)


def band(curves: Floats) -> Floats:
    """Return the t-interval of the mean over seeds at every point of a curve, ``[2, points]``.

    Args:
        curves: ``[points, seeds]``, at least two seeds.
    """
    count = curves.shape[1]
    half = student(count - 1) * curves.std(1, ddof=1) / count**0.5
    return curves.mean(1) + np.stack([-half, half])


def student(freedom: float) -> float:
    """Return the factor of the standard error of a mean, of Student's t."""
    return float(scipy.special.stdtrit(freedom, 0.5 + 0.5 * CONFIDENCE))


def share_saved(value: Any, baseline: Any) -> Any:
    """Return the saved share of a baseline's energy, which may be negative; NaN if it is zero."""
    return (baseline - value) / np.where(baseline == 0.0, np.nan, abs(baseline))


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
            distance, a ratio of totals; energy and distance vary together.

    Returns:
        The share; NaN for a baseline of zero. It has no interval if the baseline's energy has both
        signs and its own interval includes zero.
    """
    sides = [np.asarray(side, dtype=np.float64) for side in (values, baseline)]
    driven = [np.asarray(side, dtype=np.float64) for side in ways or map(np.ones_like, sides)]
    both = [{"energy": x, "way": distance} for x, distance in zip(sides, driven, strict=True)]

    def saved(ours: Side, theirs: Side) -> Any:
        return share_saved(per_distance(**ours), per_distance(**theirs))

    found = estimate(saved, *both, drives=drives, paired=paired)
    if sides[1].min() < 0.0 < sides[1].max():
        base = estimate(lambda theirs: per_distance(**theirs), both[1], drives=drives)
        found = Estimate(found.value) if base.low <= 0.0 <= base.high else found
    return found


def equal_seeds(*sides: Collection[object]) -> bool:
    """Whether all sides with several training seeds have the same ones, left out together.

    Examples:
        >>> equal_seeds([0, 1], [1, 0], [0]), equal_seeds([0, 1], [0, 2])
        (True, False)
    """
    return len({frozenset(seeds) for seeds in sides if len(seeds) > 1}) < 2
