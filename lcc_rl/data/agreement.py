"""Agreement of gaps with speeds: slope and lag of each pair, and the mistake that fits."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from math import exp, log
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lcc_rl.data.tables import SI, SPEEDS, UNITS
from lcc_rl.data.trajectories import FRAME
from lcc_rl.errors import Concern, DataError

OF_PAIRS = {"episode", "time_s", "gap_m", "follower_speed_mps", "leader_speed_mps"}
SIGNALS = {"gap": "gap_m", "leader": "leader_speed_mps", "follower": "follower_speed_mps"}
WINDOW, EVERY, REACH = 2.0, 1.0, 3.0  # changes compared, time between them, longest lag [s]
# Of changes [s], share explained, relative motion in a window [m]: less is too little to tell.
LEAST_S, LEAST_FIT, LEAST_MOTION, LEAST_ALL_S = 15.0, 0.9, 0.15, 100.0
GAIN, FLOOR = 6.0, 2e-4  # a lag leaves so much less unexplained; what exact data leave
RIDGE = np.diag([1e-6, 1e-6, 0.1])  # [m²]: of a bias of speeds, which steady traffic leaves open
LEAST_WAY = 50.0  # a shorter way says nothing of the unit of a speed [m]
NEAR, ALIKE = 1.25, 1.05  # a mistake is so near to the coefficients, or as near as another one
LOUD = 0.3  # lag that is reported [s]
STANDING, LEAST_STANDING, FAR = 0.5, 300, 15.0  # speed [m/s], samples; gap that may be in feet [m]
Place = Callable[[int, str], str]  # describes the sample of a row, and a column, to the user
Floats = NDArray[np.float64]


def agreement(episodes: pd.DataFrame) -> pd.DataFrame:
    """Return how the gap of each pair depends on its speeds.

    Least squares fit the change of the gap in 2 s by ``leader`` times the way of the leader less
    ``follower`` times the way of the follower, and a constant for biased speeds: 1 and 1 for
    consistent data, −1 and −1 where the cars are exchanged, other sizes for other units. One of the
    three signals may be late by up to 3 s: the lag that explains most, if it leaves less than a
    sixth of the rest without lag.

    Args:
        episodes: rows of an episode lie together, 0.1 s apart: columns ``OF_PAIRS`` and, where
            known, recording, follower_id and leader_id, which make a pair.

    Returns:
        A row for each pair and a last one of all, which has no lag: row (the pair's first), seconds
        (compared), leader, follower, slope (of the change of gaps over the relative way), fit
        (share of the variance explained), motion (relative way, root mean square [m]), late [s],
        signal (that is late), own, ahead (ways of the cars [m]) and grown (change of the gap [m]).
    """
    keys = [name for name in ("recording", "follower_id", "leader_id") if name in episodes]
    pair = episodes.groupby(keys or ["episode"], sort=False).ngroup().to_numpy()
    number, pairs = episodes["episode"].to_numpy(), int(pair.max(initial=-1)) + 1
    width, every, reach = (round(seconds / FRAME) for seconds in (WINDOW, EVERY, REACH))
    whole = width + 2 * reach
    rows = np.flatnonzero(number[whole:] == number[:-whole])[::every] + reach
    series = [episodes[name].to_numpy(np.float64) for name in SIGNALS.values()]
    series[1:] = [np.cumsum((v + np.append(0.0, v[:-1])) * FRAME / 2) for v in series[1:]]

    def total(values: Floats) -> Floats:
        sums = np.bincount(pair[rows], values, pairs)
        return np.append(sums, sums.sum())

    def fit(late: Floats) -> list[Floats]:
        shifted = [rows + k for k in late.astype(int)]
        gap, ahead, own = (x[k + width] - x[k] for x, k in zip(series, shifted, strict=True))
        terms = ahead, -own, np.ones(len(rows)), gap
        sums = np.moveaxis(np.array([[total(x * y) for x in terms] for y in terms]), -1, 0)
        found = np.linalg.solve(sums[:, :3, :3] + RIDGE, sums[:, :3, 3:])
        rest = sums[:, 3, 3] - (found * sums[:, :3, 3:]).sum(axis=(1, 2))
        motion = total((ahead - own) ** 2)
        slope = total(gap * (ahead - own)) / motion
        ways = (total(way) * EVERY / WINDOW for way in (own, ahead, gap))
        rest /= sums[:, 3, 3] - sums[:, 2, 3] ** 2 / count
        rest = np.nan_to_num(rest, nan=9.0)
        return [*found[:, :2, 0].T, slope, rest, np.sqrt(motion / count), *ways]

    count = total(np.ones(len(rows)))
    shifts = [k * signal for k in range(-reach, reach + 1) if k for signal in np.eye(3)]
    lags = np.stack([np.zeros(3), *shifts])
    with np.errstate(all="ignore"):  # of pairs without a change
        fits = np.array([fit(late) for late in lags])
    rest = np.maximum(fits[:, 3], FLOOR)
    best = np.where(rest[0] >= GAIN * rest.min(axis=0), rest.argmin(axis=0), 0)
    best[-1] = 0
    names = ["leader", "follower", "slope", "rest", "motion", "own", "ahead", "grown"]
    found = pd.DataFrame(fits[best, :, np.arange(pairs + 1)], columns=names)
    return found.assign(
        fit=1 - found["rest"],
        row=np.append(np.unique(pair, return_index=True)[1], 0),
        seconds=EVERY * count,
        late=FRAME * lags[best].sum(axis=1),
        signal=np.array([*SIGNALS])[np.abs(lags[best]).argmax(axis=1)],
    )


def mistakes(units: Mapping[str, str]) -> Iterator[tuple[bool, str, str, float, float]]:
    """Yield what may be wrong with a pair.

    Args:
        units: units that the gap and the speeds were read in, by their keys in ``data.units``.

    Yields:
        Whether it doubts a unit that nobody declared, the signal at fault, a question to the user,
        and the coefficients of leader and follower (:func:`agreement`).
    """
    yield True, "follower", "are leader and follower exchanged?", -1.0, -1.0
    for signal, subject, quantity, keys, leader, follower in (
        ("gap", "is the gap", "length", ("gap", "position"), -1, -1),
        ("follower", "are both speeds", "speed", ("speed", "follower_speed", "leader_speed"), 1, 1),
        ("leader", "is the leader's speed", "speed", ("leader_speed",), 1, 0),
        ("follower", "is the follower's speed", "speed", ("follower_speed",), 0, 1),
    ):
        named = [key for key in keys if key in units][: 1 if signal == "gap" else None]
        declared = units.get([*named, quantity][0], SI[quantity])
        if len({units[key] for key in named}) > 1:
            continue
        for unit, size in (UNITS["length"] if signal == "gap" else SPEEDS).items():
            factor, default = size / UNITS[quantity][declared], declared == SI[quantity]
            option = " ".join(f"data.units.{key}={unit}" for key in named)
            words = f"{subject} in {unit}{option and f' ({option})'}?"
            if factor != 1.0:
                yield default, signal, words, factor**leader, factor**follower


def check_pairs(
    episodes: pd.DataFrame,
    place: Place,
    units: Mapping[str, str],
    max_mismatch: float,
    max_lag: float,
) -> tuple[list[str], bool]:
    """Check that the gaps of each pair agree with its speeds.

    Args:
        episodes: see :func:`agreement`.
        place: describes the sample of a row.
        units: see :func:`mistakes`.
        max_mismatch, max_lag: see :class:`lcc_rl.data.plausible.Plausible`.

    Returns:
        A line on lags, that of medians, and whether any pair agrees.

    Raises:
        DataError: naming the pair and what fits, if one is exchanged, in another unit or late, or
            if none agrees.
    """
    found = agreement(episodes)
    pairs, every = found.iloc[:-1], found.iloc[-1]
    moves = found["motion"] >= LEAST_MOTION
    told = moves[:-1] & (pairs["seconds"] >= LEAST_S) & (pairs["fit"] >= LEAST_FIT)
    span = 1 / max_mismatch, max_mismatch
    right = told & pairs["leader"].between(*span) & pairs["follower"].between(*span)

    def said(cases: list[tuple[int, str, str]]) -> Iterator[str]:
        """A line on the case in the middle of several, if there is one."""
        for row, signal, words in cases[len(cases) // 2 :][:1]:
            count = f"; {len(cases):,} of {len(pairs):,} pairs" if len(pairs) > 1 else ""
            yield f"{place(row, SIGNALS[signal])}: {words}{count}"

    late = pairs[right & (pairs["late"].abs() > LOUD - FRAME / 2)].sort_values("late")
    unclear = pairs.assign(told=told)[~right].to_dict("records")
    wrong = [fit for pair in unclear for fit in _mistaken(pair, units, max_mismatch)]
    for line in (*said(wrong), *said(_late(late[late["late"].abs() > max_lag]))):
        raise DataError(line)
    if (
        every["seconds"] >= LEAST_ALL_S
        and moves.iloc[-1]
        and not (right.any() or span[0] <= every["slope"] <= span[1])
    ):
        raise DataError(
            f"gaps change by {every['slope']:.2f} m where the speeds of leader and follower say "
            "1 m, and no unit fits: are they gaps to the leader, and do speeds need smoothing?"
        )
    lines = [Concern(line) for line in said(_late(late))]
    return [*lines, medians(episodes, pairs[told], len(pairs))], bool(right.any())


def _mistaken(
    pair: Mapping[Any, Any], units: Mapping[str, str], max_mismatch: float
) -> list[tuple[int, str, str]]:
    """Row, signal and words on the mistakes nearest to a pair; nothing if none is near.

    Where the gap tells too little, the ways of both cars do. That of the leader may be less by what
    the gap grows: whichever is nearer to the follower's counts, since a gap may jump to another
    car.
    """
    own, ahead, a, b = (pair[name] for name in ("own", "ahead", "leader", "follower"))
    ways = (max(way, 1.0) for way in (ahead, ahead - pair["grown"]))
    apart = min((log(max(own, 1.0) / way) for way in ways), key=abs)
    words = (
        f"the gap changes by {a:.2f} m where the leader drives 1 m, and by {-b:.2f} m where the "
        "follower does (expected: 1 and -1)"
    )
    if not pair["told"]:
        words = f"by their speeds, the follower drives {own:.4g} m, the leader {ahead:.4g} m"
        if max(own, ahead) < LEAST_WAY or abs(apart) < log(max_mismatch):
            return []
    near = []
    for default, signal, question, leader, follower in mistakes(units):
        ratios = [a / leader, b / follower]
        if not pair["told"]:
            ratios = [exp(apart) * follower / leader] if leader != follower else [0.0]
        off = max(abs(log(ratio)) for ratio in ratios) if min(ratios) > 0 else np.inf
        near.append((off, default, signal, question))
    least = min(near)[0]
    near = [x for x in sorted(near, key=lambda x: x[1:2]) if x[0] < least + log(ALIKE)]
    questions = " or ".join(x[3] for x in near)
    return [(pair["row"], near[0][2], f"{words}; {questions}")] if least < log(NEAR) else []


def _late(pairs: pd.DataFrame) -> list[tuple[int, str, str]]:
    """Row, signal and words on the signal of each pair that is late."""
    found = []
    for pair in pairs.to_dict("records"):
        what = "gap" if pair["signal"] == "gap" else f"{pair['signal']}'s speed"
        lag = f"{abs(pair['late']):.1f} s {'late' if pair['late'] > 0 else 'early'}"
        found.append((pair["row"], pair["signal"], f"the {what} is {lag}; are clocks apart?"))
    return found


def medians(episodes: pd.DataFrame, told: pd.DataFrame, pairs: int) -> str:
    """Return the line by which a user sees whether units are right.

    Args:
        episodes: the table in SI.
        told: rows of :func:`agreement` of pairs from which something can be told.
        pairs: how many there are.
    """
    speed, gap = episodes["follower_speed_mps"], episodes["gap_m"]
    behind = (gap / speed)[speed > 1.0].median()
    line = (
        f"medians: speed {speed.median():.3g} m/s, gap {gap.median():.3g} m, time gap "
        f"{behind:.2g} s above 1 m/s; "
    )
    if len(told):
        slope, late = told["slope"].median(), told["late"].median()
        line += f"slope of gaps over speeds {slope:.2f}, lag {late:.1f} s, of {len(told):,} pair(s)"
    if len(told) < pairs:
        line += f"{', ' * bool(len(told))}too little to tell slope and lag of {pairs - len(told):,}"
    stand = gap[episodes[["follower_speed_mps", "leader_speed_mps"]].max(axis=1) < STANDING]
    if len(stand) < LEAST_STANDING or stand.median() < FAR:
        return line
    return Concern(f"{line}; cars stand {stand.median():.3g} m apart: are all columns in feet?")
