"""Monotone cubic interpolation (PCHIP) of many records at once.

It does not overshoot its samples (Fritsch and Butland, SIAM J. Sci. Stat. Comput. 5 (1984) 300).
"""

from __future__ import annotations

import numpy as np

from lcc_rl.arrays import Floats, Integers


def grid_size(begin: Floats, end: Floats, step: float) -> Integers:
    """Return the number of times from ``begin`` to ``end``, both included, ``step`` apart."""
    return np.floor((end - begin) / step + 1e-6).astype(np.int64) + 1


def monotone(
    time: Floats, values: Floats, lengths: Integers, begin: Floats, counts: Integers, step: float
) -> tuple[Floats, Integers]:
    """Interpolate records to equal steps, as ``scipy.interpolate.PchipInterpolator`` does.

    Args:
        time: times of the samples, record after record, increasing in each, ``[samples]``.
        values: values of the samples, ``[samples, columns]``.
        lengths: number of samples of each record, at least 2, ``[records]``.
        begin: first new time of each record.
        counts: number of new times of each record.
        step: distance of the new times.

    Returns:
        Values at the new times, ``[new, columns]``, and how many of these follow each sample.
    """
    last = np.cumsum(lengths) - 1
    start, own = last - lengths + 1, np.repeat(begin, lengths)
    first = np.ceil((time - own) / step - 1e-9).clip(0, np.repeat(counts, lengths)).astype(np.int64)
    first[start], first[last] = 0, counts
    number, width = np.diff(first, append=0), np.diff(time, append=0.0)
    number[last], width[last] = 0, 1.0
    since, place = own + step * first - time, np.cumsum(number) - number
    groups = [(many, np.flatnonzero(number == many)) for many in np.unique(number[number > 0])]
    found = np.empty((values.shape[1], counts.sum()))
    for y, result in zip(values.T, found, strict=True):
        slope = np.diff(y, append=0.0) / width
        rate = _rates(width, slope, start, last)
        cube = (rate + np.append(rate[1:], 0.0) - 2 * slope) / width**2
        square = (slope - rate) / width - cube * width
        value = y + since * (rate + since * (square + since * cube))
        change = rate + since * (2 * square + 3 * since * cube)
        factors = np.stack([value, change, square + 3 * since * cube, cube], -1)
        for many, rows in groups:
            later = np.vander(step * np.arange(many), 4, increasing=True).T
            result[place[rows, None] + np.arange(many)] = factors[rows] @ later
    return found.T, number


def _rates(width: Floats, slope: Floats, start: Integers, last: Integers) -> Floats:
    """Return the derivative at each sample: a weighted harmonic mean of both slopes."""
    before, here = np.roll(slope, 1), np.roll(width, 1)
    long, short = 2 * width + here, width + 2 * here
    with np.errstate(all="ignore"):
        mean = (long + short) / (long / before + short / slope)
    rate = np.where(before * slope > 0, mean, 0.0)
    for place, near, far in ((start, start, start + 1), (last, last - 1, last - 2)):
        far = np.where(last - start > 1, far, near)
        a, b, m, n = width[near], width[far], slope[near], slope[far]
        end = ((2 * a + b) * m - a * n) / (a + b)
        end = np.where((m * n < 0) & (np.abs(end) > 3 * np.abs(m)), 3 * m, end)
        rate[place] = np.where(end * m > 0, end, 0.0)
    return rate
