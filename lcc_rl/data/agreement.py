"""Agreement of gaps with speeds: slope and lag of each pair, and the probable mistake."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from math import exp, inf, log
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lcc_rl.arrays import Floats
from lcc_rl.data.columns import FRAMES, SI, SPEEDS, UNITS, Units, unit_size
from lcc_rl.data.grid import Place, stretches
from lcc_rl.data.trajectories import FRAME, starts_of
from lcc_rl.errors import Concern, DataError

OF_PAIRS = {"episode", "time_s", "gap_m", "follower_speed_mps", "leader_speed_mps"}
PAIR_SIGNALS = {"gap": "gap_m", "leader": "leader_speed_mps", "follower": "follower_speed_mps"}
CHANGE_S, EVERY_S = 2.0, 1.0  # changes compared, and the time between them [s]
LONGEST_LAG = 3.0  # [s]
# Least compared time [s], share explained and relative motion in a window [m] for a clear result.
LEAST_S, LEAST_FIT, LEAST_MOTION, LEAST_ALL_S = 6.0, 0.9, 0.15, 100.0
SURE_FIT, SAME = 0.97, 1e-3  # least share for small biases; motion of equal speeds [m]
GAIN, FLOOR = 6.0, 2e-4  # factor on the residual by which a lag is accepted; that of exact data
RIDGE = np.diag([1e-6, 1e-6, 0.1])  # [m²]: for a bias of speeds, unknown in steady traffic
LEAST_WAY = 50.0  # least distance from which the unit of a speed is concluded [m]
NEAR_MISTAKE, ALIKE = 1.25, 1.05  # largest factors to a mistake's coefficients; between mistakes
STRAY = 0.2  # largest distance left of a relative speed, as a share of the follower's
# Range of distance by positions divided by distance by speeds; largest median error of gaps [m].
AGREE, POSITIONED = (0.8, 1.25), 1.0
LOUD, LOUD_RATE, LOUD_FACTOR = 0.3, 0.3, 1.15  # reported: lag [s], bias of a speed [m/s], factor
STANDING, LEAST_STANDING = 0.5, 300  # speed [m/s], samples
# Gap that may be in feet [m]; time gaps of speeds in m/s read as km/h, and of the reverse [s].
FAR_STANDING, FAR_BEHIND, BEHIND = 15.0, 4.0, 0.5
PROVES = 0.1  # largest error of a slope that proves the units
# Speed below which some gaps are shorter than a car [m/s], least records, and length [m].
CREEPING, LEAST_SLOW, SHORT_CAR = 2.0, 5, 4.0
OF_LOGS = "relative_speed"  # key of a log's column from which the leader's speed is computed
RATES = (5, 10, 15, 20, 25, 30, 50, 60)  # frames per second of recordings


def agreement(episodes: pd.DataFrame) -> pd.DataFrame:
    """Return how the gap of each pair depends on its speeds.

    Least squares fit the change of the gap in 2 s by ``leader`` times the leader's distance minus
    ``follower`` times the follower's distance, and a constant for biased speeds. Both coefficients
    are 1 for consistent data, −1 for exchanged cars, and differ for other units. One of the three
    signals may be late by up to 3 s: the lag that explains most, if its residual is below a sixth
    of that without lag.

    Args:
        episodes: consecutive rows of each episode, 0.1 s apart: columns ``OF_PAIRS`` and, if known,
            recording, follower_id and leader_id, which identify a pair.

    Returns:
        A row for each pair and a last one for all, without lag: row (the pair's first), seconds
        (compared), leader, follower, slope (of the gap over the relative distance), fit (share of
        the variance explained), motion, change (root mean squares of relative distance and change
        of the gap [m]), late [s], signal (the late one), ahead, own, grown (distances of leader and
        follower, growth of the gap [m]), rate (growth of the gap beyond that by both speeds
        [m/s]).
    """
    pair = numbers_of_pairs(episodes)
    starts = starts_of(pair)
    number, pairs = episodes["episode"].to_numpy(), int(pair.max(initial=-1)) + 1
    width, every, reach = (round(seconds / FRAME) for seconds in (CHANGE_S, EVERY_S, LONGEST_LAG))
    span = width + 2 * reach
    rows = np.flatnonzero(number[span:] == number[:-span])[::every] + reach
    gap, *speeds = (episodes[name].to_numpy() for name in PAIR_SIGNALS.values())
    series = [gap.astype(float), *((np.cumsum(v, dtype=float) - v / 2) * FRAME for v in speeds)]

    fits = partial(_fits, series, pair, pairs, width)
    lags = [(0, 0), *((i, k) for k in range(-reach, reach + 1) if k for i in range(3))]
    with np.errstate(all="ignore"):  # pairs without a change
        ((*first, sums),) = fits(rows, lags[:1])
        unclear = rows[(first[1] > GAIN * FLOOR)[pair[rows]]]  # elsewhere no lag could be accepted
        lagged = fits(unclear, lags[1:]) if len(unclear) else []
        coefs, rest = (np.array(x) for x in zip(first, *(fit[:2] for fit in lagged), strict=True))
    best = np.where(rest[0] >= GAIN * rest.min(axis=0), rest.argmin(axis=0), 0)
    best[-1] = 0
    index, count = np.arange(pairs + 1), sums[2, 2]
    ahead, own, grown = sums[[0, 1, 3], 2] * [[1], [-1], [1]] * EVERY_S / CHANGE_S
    names = ["leader", "follower", "slope"]
    return pd.DataFrame(coefs[best, :, index], columns=names).assign(
        row=np.append(starts[np.unique(pair[starts], return_index=True)[1]], 0),
        seconds=EVERY_S * count,
        fit=1 - rest[best, index],
        motion=np.sqrt(sums[:2, :2].sum(axis=(0, 1)).clip(0.0) / count.clip(1.0)),
        change=np.sqrt(sums[3, 3] / count.clip(1.0)),
        late=FRAME * np.array(lags)[best, 1],
        signal=np.array([*PAIR_SIGNALS])[np.array(lags)[best, 0]],
        ahead=ahead,
        own=own,
        grown=grown,
        rate=(grown - ahead + own) / (EVERY_S * count).clip(1.0),
    )


def numbers_of_pairs(episodes: pd.DataFrame) -> NDArray[np.int32]:
    """Return the number of the pair of each row, from 0; see :func:`agreement`."""
    keys = [name for name in ("recording", "follower_id", "leader_id") if name in episodes]
    starts, lengths = stretches(episodes["episode"].to_numpy())
    first = episodes[keys or ["episode"]].iloc[starts]
    return np.repeat(first.groupby([*first], sort=False).ngroup().to_numpy(np.int32), lengths)


def _fits(
    series: Sequence[Floats],
    pair: NDArray[Any],
    pairs: int,
    width: int,
    rows: NDArray[np.intp],
    lags: Iterable[tuple[int, int]],
) -> Iterator[tuple[Floats, Floats, Floats]]:
    """Yield coefficients and slope of each pair and of all, residuals and products.

    ``series`` are the gap and the distances of leader and follower; a lag is the place of the one
    that is late, and its samples. Changes over ``width`` samples begin at ``rows``; ``pair`` is the
    number of each row's pair.
    """
    at = pair[rows]
    begins = np.flatnonzero(np.diff(at, prepend=-1))  # of rows of one pair

    def change(signal: int, late: int = 0) -> Floats:
        values = series[signal]
        return values[rows + late + width] - values[rows + late]

    def products(sums: Floats, terms: Sequence[Floats], changed: Iterable[int]) -> Floats:
        """Return sums with those of the changed terms."""
        for i in changed:
            for j, other in enumerate(terms):
                total = np.bincount(at[begins], np.add.reduceat(terms[i] * other, begins), pairs)
                sums[i, j] = sums[j, i] = np.append(total, total.sum())
        return sums

    terms = [change(1), -change(2), np.ones(len(rows)), change(0)]
    sums = products(np.zeros((4, 4, pairs + 1)), terms, range(4))
    for signal, late in lags:
        term = (3, 0, 1)[signal]
        moved = [*terms]
        moved[term] = change(signal, late) * (-1.0 if signal == 2 else 1.0)
        yield _solved(products(sums.copy(), moved, [term]) if late else sums)


def _solved(sums: Floats) -> tuple[Floats, Floats, Floats]:
    """Return coefficients and slope of sums of products, the residuals, and the sums."""
    matrix = np.moveaxis(sums[:3, :3], -1, 0) + RIDGE
    coefs = np.linalg.solve(matrix, sums[:3, 3].T[..., None]).astype(np.float64)[..., 0].T
    rest = sums[3, 3] - (coefs * sums[:3, 3]).sum(axis=0)
    rest /= sums[3, 3] - sums[2, 3] ** 2 / sums[2, 2]
    slope = sums[:2, 3].sum(axis=0) / sums[:2, :2].sum(axis=(0, 1))
    coefs = np.vstack([coefs[:2], slope])
    return coefs, np.nan_to_num(rest, nan=9.0).clip(FLOOR, 9.0), sums


def mistakes(units: Units) -> Iterator[tuple[bool, str, str, float, float]]:
    """Yield possible mistakes in the data of a pair.

    Args:
        units: units in which gap and speeds were read, by their keys in ``data.units``.

    Yields:
        Whether the mistake is a wrong SI unit, the signal at fault, a question to the user, and the
        coefficients of leader and follower in :func:`agreement`.
    """
    if OF_LOGS in units:
        yield True, "leader", "is relative_speed the own speed minus the leader's?", -1.0, -1.0
        yield True, "leader", "is it the leader's speed (data.columns.leader_speed)?", 1.0, 2.0
    else:
        yield True, "follower", "are leader and follower exchanged?", -1.0, -1.0
    for signal, subject, quantity, keys, leader, follower in (
        ("gap", "is the gap", "length", ("gap", "position"), -1, -1),
        ("leader", "is the relative speed", "speed", (OF_LOGS,), 1, 1),
        ("follower", "are both speeds", "speed", ("speed", "follower_speed", "leader_speed"), 1, 1),
        ("leader", "is the leader's speed", "speed", ("leader_speed",), 1, 0),
        ("follower", "is the follower's speed", "speed", ("follower_speed",), 0, 1),
    ):
        if signal != "gap" and (OF_LOGS in keys) != (OF_LOGS in units):
            continue
        named = [key for key in keys if key in units][: 1 if signal == "gap" else None]
        declared = units.get([*named, quantity][0], SI[quantity])
        for unit, size in (UNITS["length"] if signal == "gap" else SPEEDS).items():
            factor = size / UNITS[quantity][declared]
            if factor != 1.0 and len({units[key] for key in named}) < 2:
                option = " ".join(f"data.units.{key}={unit}" for key in named)
                question = f"{subject} in {unit}{option and f' ({option})'}?"
                yield declared == SI[quantity], signal, question, factor**leader, factor**follower
    time = units.get("time", "")
    period = (unit_size("time", time) or 0.0) if time.startswith(FRAMES) else 0.0  # [s]
    for rate in RATES if period else ():
        question = f"is the time in frames/{rate} (data.units.time=frames/{rate})?"
        yield False, "gap", question, 1 / (rate * period), 1 / (rate * period)


def check_pairs(
    episodes: pd.DataFrame, place: Place, units: Units, max_mismatch: float, max_lag: float
) -> tuple[list[str], bool]:
    """Check that the gaps of each pair agree with its speeds.

    Args:
        episodes: see :func:`agreement`.
        place: returns the description of a sample.
        units: see :func:`mistakes`.
        max_mismatch, max_lag: see :class:`lcc_rl.data.plausible.Plausible`.

    Returns:
        Lines on lags, biases, gaps that fit no unit, and medians; and whether any pair agrees.

    Raises:
        DataError: naming the pair and the probable mistake, if one or all contradict their speeds.
    """
    if {"follower_id", "leader_id"} <= {*episodes}:
        itself = (episodes["follower_id"] == episodes["leader_id"]).to_numpy()
        if itself.any():
            raise DataError(f"{place(int(itself.argmax()), 'leader_id')} is the follower itself")
    fits = agreement(episodes)
    pairs, every = fits.iloc[:-1], fits.iloc[-1]
    moves, span = fits["motion"] >= LEAST_MOTION, (1 / max_mismatch, max_mismatch)
    clear = moves[:-1] & (pairs["seconds"] >= LEAST_S) & (pairs["fit"] >= LEAST_FIT)
    right = clear & pairs["leader"].between(*span) & pairs["follower"].between(*span)

    def middle(cases: list[tuple[int, str, str]]) -> Iterator[str]:
        """Yield a line on the middle one of several cases."""
        if cases:
            row, signal, text = cases[len(cases) // 2]
            count = f"; {len(cases):,} of {len(pairs):,} pairs" if len(pairs) > 1 else ""
            of_log = signal == "leader" and OF_LOGS in units
            key = OF_LOGS if of_log else PAIR_SIGNALS[signal]
            yield f"{place(row, key)}: {text}{count}"

    wrong = [
        fit
        for pair in pairs.assign(clear=clear)[~right].to_dict("records")
        for fit in _mistaken(pair, units, max_mismatch)
    ]
    same = pairs[(pairs["motion"] < SAME) & (pairs["change"] > LEAST_MOTION)]
    text = "both speeds are equal, but the gap changes; does one column hold both?"
    wrong += [(row, "leader", text) for row in same["row"]]
    late, too_late = [], []
    for pair in pairs[right & (pairs["late"].abs() > LOUD - FRAME / 2)].to_dict("records"):
        most = " or more" * (abs(pair["late"]) > LONGEST_LAG - FRAME / 2)
        lag = f"{abs(pair['late']):.1f} s{most} {'late' if pair['late'] > 0 else 'early'}"
        late.append((pair["row"], pair["signal"], f"{pair['signal']} {lag}; are clocks apart?"))
        too_late += late[-1:] * (abs(pair["late"]) > max_lag)
    for line in (*middle(wrong), *middle(too_late), *_own_speed(episodes, units, max_mismatch)):
        raise DataError(line)
    odd = pairs[clear & ~right & ~pairs["slope"].between(*span)].to_dict("records")
    sure = right & (pairs["fit"] >= SURE_FIT)  # noise lowers the coefficients
    moving = pairs.assign(sure=sure)[moves[:-1] & (pairs["seconds"] >= LEAST_S)]
    biased = [x for pair in moving.to_dict("records") for x in _biased(pair)]
    text = "the gap changes by {:.2f} m where both speeds give 1 m, and no unit fits"
    strange = [(pair["row"], "gap", text.format(pair["slope"])) for pair in odd]
    enough = every["seconds"] >= LEAST_ALL_S and moves.iloc[-1]
    if (enough or clear.any()) and not (right.any() or span[0] <= every["slope"] <= span[1]):
        for _, _, words in _mistaken(every.to_dict() | {"clear": True}, units, max_mismatch):
            raise DataError(words)  # of noisy pairs
        raise DataError(
            f"{text.format(every['slope'])}: are times in another unit, speeds to be smoothed, or "
            f"biased (the gap changes by {every['rate']:+.1f} m/s against them)?"
        )
    lines = [Concern(line) for cases in (late, biased, strange) for line in middle(cases)]
    return [*lines, medians(episodes, pairs[clear], len(pairs), units)], bool(right.any())


def check_positions(episodes: pd.DataFrame, place: Place) -> None:
    """Raise a DataError if positions contradict speeds, or gaps positions and known lengths."""
    step = episodes["time_s"].diff().where(episodes["episode"].diff() == 0, 0.0)
    for car in ("follower", "leader"):
        way = episodes[f"{car}_position_m"].diff()[step > 0].sum()
        driven = (episodes[f"{car}_speed_mps"] * step).sum()
        if driven >= LEAST_WAY and not AGREE[0] * driven <= way <= AGREE[1] * driven:
            at = place(0, f"{car}_position_m")
            words = f"by their positions {car}s drive {way:.4g} m, by their speeds {driven:.4g} m"
            raise DataError(f"{at}: {words}; check data.units and data.columns of both")
    beyond = episodes["gap_m"] - episodes["leader_position_m"] + episodes["follower_position_m"]
    length = episodes["leader_length_m"]
    if abs(off := float((beyond + length)[length > 0].median())) > POSITIONED:
        at = f"{off:+.3g} m from that of positions and lengths, as at {place(0, 'gap_m')}"
        raise DataError(f"median gap {at}; expected bumper to bumper: name only the right ones")


def _mistaken(
    pair: Mapping[Any, Any], units: Units, max_mismatch: float
) -> list[tuple[int, str, str]]:
    """Return row, signal and words on the mistakes nearest to a pair; nothing if none is near.

    If the gap is not clear, the distances of both cars are compared. The leader's distance may be
    less by the growth of the gap. The nearer value counts, because a gap may jump to another car.
    """
    own, ahead, a, b = (pair[name] for name in ("own", "ahead", "leader", "follower"))
    distances = (max(distance, 1.0) for distance in (ahead, ahead - pair["grown"]))
    apart = min((log(max(own, 1.0) / distance) for distance in distances), key=abs)
    message = (
        f"where the leader drives 1 m, the gap changes by {a:.2f} m, where the follower does, by "
        f"{-b:.2f} m"
    )
    if not pair["clear"]:
        message = f"by their speeds, the follower drives {own:.4g} m, the leader {ahead:.4g} m"
        if own >= LEAST_WAY and abs(ahead - pair["grown"]) < STRAY * own:
            question = "is the leader's speed relative to the follower's? Add the follower's"
            return [(pair["row"], "leader", f"{message}; {question}")]
        if max(own, ahead) < LEAST_WAY or abs(apart) < log(max_mismatch):
            return []
    near = []
    for default, signal, question, leader, follower in mistakes(units):
        ratios = [a / leader, b / follower]
        if not pair["clear"]:
            ratios = [exp(apart) * follower / leader] if leader != follower else [0.0]
        off = max(abs(log(ratio)) for ratio in ratios) if min(ratios) > 0 else inf
        near.append((off, default, signal, question))
    least = min(near)[0]
    if least >= log(NEAR_MISTAKE):  # first by the gap, then by the distances
        return _mistaken({**pair, "clear": False}, units, max_mismatch) if pair["clear"] else []
    near = [x for x in sorted(near, key=lambda x: x[1:2]) if x[0] < least + log(ALIKE)]
    questions = " or ".join(x[3] for x in near)
    return [(pair["row"], near[0][2], f"{message}; {questions}")]


def _own_speed(episodes: pd.DataFrame, units: Units, max_mismatch: float) -> Iterator[str]:
    """Yield words on a log's own speed in too small a unit, with which gaps agree nevertheless.

    Least squares fit the change of the relative speed in 1 s by that of the own speed, and by both
    in the 2 s before. As leaders do not react to followers, the first coefficient is at least −1.
    """
    declared = SPEEDS.get(units.get("follower_speed", ""), 1.0)
    width, number = round(EVERY_S / FRAME), episodes["episode"].to_numpy()
    rows = np.flatnonzero(number[3 * width :] == number[: -3 * width]) + 2 * width
    if OF_LOGS not in units or len(rows) * FRAME < LEAST_ALL_S:
        return
    own, ahead = (episodes[PAIR_SIGNALS[x]].to_numpy(float) for x in ("follower", "leader"))
    terms = [(ahead - own)[rows]]
    for since in (-1, 0, 1):
        terms += [
            (v[rows + since * width] - v[rows + (since - 1) * width]) for v in (ahead - own, own)
        ]
    relative = terms.pop(-2)
    change = float(np.linalg.lstsq(np.stack(terms, axis=1), relative, rcond=None)[0][-1])
    unit, size = min(SPEEDS.items(), key=lambda x: abs(x[1] / declared + change))
    if -change > max_mismatch and size > declared:
        yield (
            f"where the follower's speed changes by 1 m/s, relative_speed changes by {change:.2f} "
            f"m/s; is the follower's speed in {unit} (data.units.follower_speed={unit})?"
        )


def _biased(pair: Mapping[Any, Any]) -> list[tuple[int, str, str]]:
    """Return row, signal and words on a clock or a speed that is slightly off; else nothing."""
    row, a, b, rate = (pair[name] for name in ("row", "leader", "follower", "rate"))
    if pair["sure"] and (min(a, b) > LOUD_FACTOR or max(a, b) < 1 / LOUD_FACTOR):
        message = f"the gap changes by {(a * b) ** 0.5:.2f} m where both speeds give 1 m"
        return [(row, "gap", f"{message}; is a clock too fast or slow by this factor?")]
    if abs(rate) < LOUD_RATE:
        return []
    message = (
        f"the gap changes by {rate:+.1f} m/s against both speeds; is a speed biased? Add "
        f"{rate:.1f} m/s to the leader's, or multiply the follower's by "
        f"{1 - rate * pair['seconds'] / max(pair['own'], 1.0):.3f}"
    )
    return [(row, "leader", message)]


def medians(episodes: pd.DataFrame, clear: pd.DataFrame, pairs: int, units: Units) -> str:
    """Return the line on medians, which shows whether units and clocks are right.

    ``clear`` are the rows of :func:`agreement` with a clear result, out of ``pairs``.
    """
    speed, gap = episodes["follower_speed_mps"], episodes["gap_m"]
    behind = (gap / speed)[speed > 1.0].median()
    slope, late = clear["slope"].median(), clear["late"].median()
    fitted = f"slope of gaps over speeds {slope:.2f}, lag {late:.1f} s of {len(clear):,} pair(s)"
    unchecked = "own speed's clock and unit not checked"
    fitted += f" between gap and relative_speed, {unchecked}" * (OF_LOGS in units)
    few = f"slope and lag unknown for {pairs - len(clear):,}"
    phrases = [fitted] * (len(clear) > 0) + [few] * (len(clear) < pairs)
    line = (
        f"medians: speed {speed.median():.3g} m/s, gap {gap.median():.3g} m, time gap "
        f"{behind:.2g} s above 1 m/s; {', '.join(phrases)}"
    )
    key = "speed" if "speed" in units else "follower_speed"
    own = OF_LOGS in units  # gaps agree with relative speeds whatever the own, else prove its unit
    unit = "m/s" if behind > FAR_BEHIND and (own or not abs(slope - 1.0) < PROVES) else ""
    unit = "km/h" if own and behind < BEHIND else unit
    if unit and unit != units.get(key, SI["speed"]):
        return Concern(f"{line}; is the own speed in {unit} (data.units.{key}={unit})?")
    fastest = episodes[["follower_speed_mps", "leader_speed_mps"]].max(axis=1)
    stand, slow = gap[fastest < STANDING], episodes[fastest < CREEPING]
    far = len(stand) >= LEAST_STANDING and stand.median() >= FAR_STANDING
    if far and "ft" not in units.values():
        return Concern(f"{line}; cars stand {stand.median():.3g} m apart: are all columns in feet?")
    length = slow.get("leader_length_m", 0.0 * slow["gap_m"])
    least = (slow["gap_m"] - length.where(length > 0.0, SHORT_CAR)).quantile(0.01)
    if least <= 0.0 or slow["episode"].nunique() < LEAST_SLOW:
        return line
    text = f"even below {CREEPING:g} m/s no gap is shorter than a car: do gaps include the leader's"
    return Concern(f"{line}; {text} length? Subtract it")
