"""Monotone cubic interpolation (PCHIP) of many records at once.

Fritsch and Butland, SIAM J. Sci. Stat. Comput. 5 (1984) 300: the interpolant does not overshoot its
samples. Values are those of ``scipy.interpolate.PchipInterpolator``.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lcc_rl.arrays import Floats, Integers

LONG = 20  # mean length from which stretches of equal numbers are interpolated one by one


def grid_size(begin: Floats, end: Floats, step: float) -> Integers:
    """Return the number of times from ``begin`` to ``end``, both included, ``step`` apart."""
    return np.floor((end - begin) / step + 1e-6).astype(np.int64) + 1


def monotone(
    time: Floats, values: Floats, lengths: Integers, begin: Floats, counts: Integers, step: float
) -> tuple[Floats, Integers]:
    """Interpolate records to equal steps.

    Args:
        time: times of the samples, record after record, increasing in each, ``[samples]``.
        values: values of the samples, ``[samples, columns]``.
        lengths: number of samples of each record, at least 2, ``[records]``.
        begin: first new time of each record; times beyond a record count as its ends.
        counts: number of new times of each record, at least 1.
        step: distance of the new times.

    Returns:
        Values at the new times, ``[new, columns]``, and the number of new times from each sample to
        the next one, ``[samples]``.
    """
    last = np.cumsum(lengths) - 1
    start, own = last - lengths + 1, np.repeat(begin, lengths)
    first = np.ceil((time - own) / step).astype(np.int64)  # first new time from each sample on
    first -= own + step * (first - 1) >= time  # exactly, in spite of rounding
    first += own + step * first < time
    first = np.minimum(first.clip(min=0), np.repeat(counts, lengths))
    first[start] = 0
    ends = np.append(first[1:], 0)
    ends[last - 1] = counts
    ends[last] = first[last]
    number, since = ends - first, own + step * first - time
    width = np.diff(time, append=time[-1])
    width[last] = 1.0
    found = np.empty((values.shape[1], counts.sum()))
    place = np.cumsum(number) - number
    groups = [*_groups(number)]
    before, beyond = place[start], place[last] - 1
    early, late = begin < time[start], begin + step * (counts - 1) > time[last]
    for samples, result in zip(values.T, found, strict=True):
        factors = _factors(samples, width, start, last, since)
        for many, rows in groups:
            later = np.vander(step * np.arange(many), 4, increasing=True).T
            if isinstance(rows, slice):
                to = result[place[rows.start] :][: (rows.stop - rows.start) * many]
                np.matmul(factors[rows], later, out=to.reshape(-1, many))
            else:
                result[place[rows, None] + np.arange(many)] = factors[rows] @ later
        result[before[early]] = samples[start[early]]
        result[beyond[late]] = samples[last[late]]
    return found.T, number


def _groups(number: Integers) -> Iterator[tuple[int, slice | Integers]]:
    """Yield each number of new times with its samples: long stretches of them, or all."""
    ends = np.append(np.flatnonzero(np.diff(number)) + 1, len(number))
    if len(ends) * LONG > len(number):
        for many in np.unique(number[number > 0]):
            yield int(many), np.flatnonzero(number == many)
        return
    for first, end in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True):
        if number[first]:
            yield int(number[first]), slice(first, end)


def _factors(
    values: Floats, width: Floats, start: Integers, last: Integers, since: Floats
) -> Floats:
    """Return the cubic from each sample on, in powers of the time after ``since``, ``[n, 4]``."""
    slope = np.diff(values, append=values[-1]) / width
    rate = _rates(width, slope, start, last)
    bend = (rate + np.append(rate[1:], 0.0) - 2 * slope) / width
    square, cube = (slope - rate) / width - bend, bend / width
    total = values + since * (rate + since * (square + since * cube))
    rate += since * (2 * square + 3 * since * cube)
    return np.stack([total, rate, square + 3 * since * cube, cube], -1)


def _rates(width: Floats, slope: Floats, start: Integers, last: Integers) -> Floats:
    """Return the derivative at each sample: a weighted harmonic mean of both slopes."""
    before, here = np.roll(slope, 1), np.roll(width, 1)
    weights = 2 * width + here, width + 2 * here
    with np.errstate(all="ignore"):
        mean = (weights[0] / before + weights[1] / slope) / (weights[0] + weights[1])
        rate = np.where(before * slope > 0, 1.0 / mean, 0.0)
    for place, way in ((start, 1), (last, -1)):
        near, next_ = (start, start + 1) if way == 1 else (last - 1, last - 2)
        next_ = np.where(last - start > 1, next_, near)
        a, b, m, n = width[near], width[next_], slope[near], slope[next_]
        end = ((2 * a + b) * m - a * n) / (a + b)
        end = np.where(np.sign(end) != np.sign(m), 0.0, end)
        steep = (np.sign(m) != np.sign(n)) & (np.abs(end) > 3 * np.abs(m))
        rate[place] = np.where(steep, 3 * m, end)
    return rate
