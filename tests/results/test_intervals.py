"""Intervals: covered, absent where nothing varies, of whole drives; fronts."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from lcc_rl.results.fronts import (
    DISTANCE,
    ENERGY,
    FLEET,
    FLOW,
    LONG_SHARE,
    NET,
    compare_fronts,
    energy_at,
    points,
    saved_at_flow,
)
from lcc_rl.results.intervals import crossed, mean, saving, share_saved
from lcc_rl.results.measures import MEASURES
from lcc_rl.results.windows import savings, windows_of, with_bounds

NETWORK, RULE = ("alcc", "network"), ("alcc", "idm")


def test_one_seed_has_no_interval_and_several_have_students() -> None:
    found = mean([3.0])
    assert found.value == 3.0
    assert np.isnan([found.low, found.high, saving([[1.0]], [[2.0]]).low]).all()
    for values in ([1.0, 3.0], [0.2, 0.3, 0.7, 0.9]):
        found = mean(values).columns("x_pct", 100.0)
        ends = stats.t.interval(0.95, len(values) - 1, np.mean(values), stats.sem(values))
        assert [*found] == ["x_pct", "x_pct_low", "x_pct_high"]
        assert [*found.values()] == pytest.approx([100 * x for x in (np.mean(values), *ends)])


def test_episodes_without_a_value_have_no_weight() -> None:
    keys = {
        "training_seed": np.nan,
        "profile_id": [0] * 10 + [1] * 10,
        "driver_id": [*range(10)] * 2,
    }
    value = np.array([2.0, *[np.nan] * 9, *[10.0] * 10])  # one of ten stops in the first window
    names = {"human": value, "alcc": 0.5 * value}
    rows = [pd.DataFrame(keys | {"strategy": x, "standstill_s": y}) for x, y in names.items()]
    windows = windows_of(pd.concat(rows))
    (measure,) = (one for one in MEASURES if one.key == "standstill_s")
    human = windows[windows["strategy"] == "human"]
    assert measure.value(human) == pytest.approx(np.nanmean(value))
    assert with_bounds(human, [measure])["standstill_s"].value == pytest.approx(np.nanmean(value))
    assert savings(windows, "standstill_s", "alcc", "human").value == pytest.approx(0.5)


def test_intervals_of_what_cannot_be_negative_end_at_zero() -> None:
    keys = {"strategy": "alcc", "training_seed": np.nan, "profile_id": [*range(4)]}
    few = {"brakings_below_2": [0.0, 0, 0, 9], "share_ttc_unsafe": [0.0, 0, 0, 1]}
    signed = ("energy_kj", "path_energy_kj", "fuel_l", "co2_g")  # fuel is that of path energy
    energies = {f"all_{name}": [-1.0, 1, 1, 1] for name in signed}
    rows = windows_of(pd.DataFrame(keys | few | energies | {"distance_m": 1e3, "delay_s": -1.0}))
    found = with_bounds(rows, [measure for measure in MEASURES if measure.interval])
    assert found["brakings_below_2_per_100km"].low == found["share_ttc_unsafe"].low == 0.0
    assert found["share_ttc_unsafe"].high == 1.0
    for key in ("kj_per_km", "path_energy_kj_per_km", "fuel_l_per_100km", "co2_g_per_km"):
        assert found[key].low < 0.0, key
    assert found["delay_s_per_km"].low == pytest.approx(-1e-3)


def test_windows_are_shared_by_both_sides_and_seeds_are_not() -> None:
    # Every window saves a tenth, however much it takes: nothing is uncertain.
    baseline = np.array([[10.0], [100.0], [1000.0]])
    found = saving(0.9 * baseline, baseline)
    assert (found.low, found.value, found.high) == pytest.approx((0.1, 0.1, 0.1))
    own, other = np.array([[90.0, 80.0, 85.0]]), np.array([[100.0, 85.0, 115.0]])
    known, both = saving(own, [[other.mean()]]), saving(own, other)
    assert both.value == pytest.approx(known.value)
    assert both.low < known.low < known.high < both.high
    assert saving(own, other) == both


def by_hand(table: np.ndarray, base: np.ndarray, windows, *seeds) -> tuple[float, float]:
    """Return the interval of 1 − Σ table / Σ base; ``seeds``: seeds of both, or of each."""

    def saved(left: list[int], mine: list[int], theirs: list[int]) -> float:
        return 1.0 - table[np.ix_(left, mine)].mean() / base[np.ix_(left, theirs)].mean()

    every = [range(table.shape[0]), range(table.shape[1]), range(base.shape[1])]
    total, free = 0.0, 0.0
    for axes, groups in ((0,), windows), *seeds:
        values = [
            saved(
                *(
                    [i for i in x if axis not in axes or i not in group]
                    for axis, x in enumerate(every)
                )
            )
            for group in groups
        ]
        part = (len(groups) - 1) / len(groups) * sum((x - np.mean(values)) ** 2 for x in values)
        total, free = total + part, free + part**2 / (len(groups) - 1)
    half = stats.t.ppf(0.975, total**2 / free) * total**0.5
    value = 1.0 - table.mean() / base.mean()
    return value - half, value + half


def singles(count: int) -> list[list[int]]:
    """Return each of some places by itself."""
    return [[place] for place in range(count)]


def test_interval_leaves_out_each_window_and_seed_in_turn() -> None:
    generator = np.random.default_rng(3)
    base = generator.uniform(50, 150, (5, 2))
    own = base[:, :1] * generator.uniform(0.8, 1.0, (5, 4))
    found = saving(own, base)
    assert found.value == pytest.approx(1 - own.mean() / base.mean())
    ends = by_hand(own, base, singles(5), ((1,), singles(4)), ((2,), singles(2)))
    assert (found.low, found.high) == pytest.approx(ends)
    # Of one drive, that of the first two windows, less is known.
    ends = by_hand(own[:, :1], base[:, :1], [[0, 1], [2], [3], [4]])
    found = saving(own[:, :1], base[:, :1], drives=["a", "a", "b", "c", "d"])
    assert (found.low, found.high) == pytest.approx(ends)


def test_equal_seeds_are_left_out_in_pairs() -> None:
    generator = np.random.default_rng(5)
    base = generator.uniform(80, 120, (6, 1)) * generator.uniform(0.9, 1.1, (1, 4))
    own = base * generator.uniform(0.94, 0.96, (6, 4))
    keys = pd.MultiIndex.from_product([range(6), range(4)], names=["profile_id", "training_seed"])
    parts = {"alcc a": own, "alcc b": base}
    rows = pd.concat(
        pd.DataFrame({"strategy": name, "energy": x.ravel()}, keys).reset_index()
        for name, x in parts.items()
    ).sample(frac=1.0, random_state=0)
    found = savings(rows, "energy", "alcc a", "alcc b")
    ends = by_hand(own, base, singles(6), ((1, 2), singles(4)))
    assert (found.low, found.high) == pytest.approx(ends)
    assert savings(rows, "energy", "alcc b", "alcc b").columns("") == {"": 0, "_low": 0, "_high": 0}
    # Different seeds are independent: the trainings differ more than the saving does.
    shifted = rows.assign(training_seed=rows["training_seed"] + 9 * (rows["strategy"] == "alcc b"))
    apart = savings(shifted, "energy", "alcc a", "alcc b")
    assert apart.high - apart.low > 3.0 * (found.high - found.low)


def test_energy_and_distance_vary_together() -> None:
    """Who falls back in some windows takes as much less energy there: per km nothing varies."""
    generator = np.random.default_rng(4)
    way = generator.uniform(500, 2000, (12, 1))
    own = way * generator.uniform(0.5, 1.0, (12, 3))
    found = saving(0.18 * own, 0.2 * way, ways=(own, way))
    assert (found.low, found.value, found.high) == pytest.approx((0.1, 0.1, 0.1))
    used = own * generator.uniform(0.8, 1.0, (12, 3))
    found = saving(0.2 * used, 0.2 * own, ways=(own, own), paired=True)
    ends = by_hand(used, own, singles(12), ((1, 2), singles(3)))
    assert (found.low, found.high) == pytest.approx(ends)


@pytest.mark.parametrize(("drives", "seeds"), [(20, 8), (20, 1), (5, 3), (3, 1), (2, 2)])
def test_interval_covers_a_known_saving(drives, seeds) -> None:
    """Drives, seeds and their interaction vary; a human baseline meets the same windows."""
    generator = np.random.default_rng(0)
    names = np.repeat(range(drives), 3).tolist()

    def covered() -> bool:
        traffic = generator.gamma(4.0, 25.0, (drives, 1)).repeat(3, 0)
        gain = 0.05 + generator.normal(0, 0.02, (drives, 1)).repeat(3, 0)
        gain = gain + generator.normal(0, 0.01, (1, seeds)) * (seeds > 1)
        gain = gain + generator.normal(0, 0.005, (3 * drives, seeds))
        found = saving(traffic * (1.0 - gain), traffic, drives=names)
        return bool(found.low <= 0.05 <= found.high)

    assert 0.90 <= np.mean([covered() for _ in range(300)]) <= 0.99


def test_rows_and_their_means_by_window_save_alike() -> None:
    places = np.arange(20 * 9 * 4)
    table = {
        "profile_id": places % 20,
        "driver_id": places // 20 % 9,
        "training_seed": places // 180,
    }
    one = pd.DataFrame(table | {"energy": np.random.default_rng(0).uniform(1.0, 2.0, len(places))})
    frame = pd.concat([one.assign(strategy="alcc"), one.assign(strategy="idm", energy=2.0)])
    whole, windows = (savings(x, "energy", "alcc", "idm") for x in (frame, windows_of(frame)))
    assert whole == windows
    assert np.isfinite(whole.low)


def test_less_drawn_is_saved_also_where_the_baseline_gains() -> None:
    assert share_saved(90.0, 100.0) == pytest.approx(0.1)
    assert share_saved(-110.0, -100.0) == pytest.approx(0.1)  # recuperates more
    assert saving([[-110.0]], [[-100.0]]).value == pytest.approx(0.1)
    # A share of something that may be more or less than nothing has no interval.
    mixed, gained = np.array([[-3.0], [1.0], [-2.0]]), np.array([[-3.0], [-1.0], [-2.0]])
    still, ways = np.zeros((3, 1)), np.ones((3, 1))
    assert np.isnan(saving(mixed - 1.0, mixed).low)
    assert np.isnan(saving(mixed, np.zeros((3, 1))).value)
    # A strategy, or a baseline, that does not move has no energy per distance.
    for ours, theirs in ((still, ways), (ways, still), (still, still)):
        assert np.isnan(saving(gained, gained, ways=(ours, theirs)).value)
    halves = saving(-gained, -gained, ways=([[0.0], [1.0], [0.0]], ways))
    assert halves.value == pytest.approx(-2.0)
    assert np.isnan(halves.low)  # all hangs on one window
    found = saving(gained - 1.0, gained)
    assert found.low < found.value < found.high


def fronts(saved: float = 0.05, noise: float = 0.0) -> pd.DataFrame:
    """Two fronts, energy = level − 1000 · share; the network's level is lower by ``saved``."""
    generator = np.random.default_rng(0)
    level = 100.0 + 20.0 * generator.standard_normal(12)
    rows = []
    for kind, factor in ((NETWORK, 1.0 - saved), (RULE, 1.0)):
        for limit in (0.01, 0.02, 0.03):
            share = limit * (0.5 if kind == RULE else 0.8)  # missed less than allowed
            for seed in range(3):
                energy = factor * (level - 1000.0 * share) + noise * generator.standard_normal(12)
                rows += [(*kind, limit, seed, w, x, share) for w, x in enumerate(energy)]
    names = ["variant", "policy", "limit", "training_seed", "profile_id", ENERGY, LONG_SHARE]
    return pd.DataFrame(rows, columns=names)


def saving_at(windows, one, other, at: float):
    """Energy saved where both violate the limit for at most this share of the time."""

    def measure(*curves):
        return share_saved(*(energy_at(x[ENERGY], x[LONG_SHARE], at, None) for x in curves))

    return compare_fronts(windows, one, other, columns=(ENERGY, LONG_SHARE), measure=measure)


def test_fronts_are_read_at_the_same_share_not_at_the_same_limit() -> None:
    energy, share = np.array([90.0, 100.0]), np.array([0.02, 0.01])
    assert energy_at(energy, share, 0.0125, None) == pytest.approx(97.5)
    assert np.isnan(energy_at(energy, share, 0.005, None))
    assert energy_at(energy, share, 0.03, None) == 90.0  # a limit that is always kept
    found = saving_at(fronts(), NETWORK, RULE, 0.012)
    # Every window saves as much: nothing is left to chance.
    assert (found.low, found.value, found.high) == pytest.approx((0.05, 0.05, 0.05))
    table = points(fronts()).set_index(["policy", "limit"])
    assert table.loc[("idm", 0.02), LONG_SHARE] == pytest.approx(0.01)
    # Without some windows a front just misses a share that it reaches with all of them.
    table = fronts(0.05, 2.0)
    table[LONG_SHARE] += 1e-4 * (table["profile_id"] - 5.5)
    least = table.groupby(["policy", "limit"])[LONG_SHARE].mean().groupby("policy").min().max()
    found = saving_at(table, NETWORK, RULE, least)
    assert found.low < found.value < found.high
    assert np.isnan(saving_at(table, NETWORK, RULE, least - 1e-6).value)
    nothing = saving_at(fronts(0.0, 2.0), NETWORK, RULE, 0.012)
    assert -0.03 < nothing.low < 0.0 < nothing.high < 0.03


def test_fleets_are_compared_at_equal_flow() -> None:
    """A rule needs 10 − (2000 − flow) / 100 kJ/m, and the fleet 1 kJ/m less at a flow of 1,900."""
    generator = np.random.default_rng(0)
    rows = []
    for window, drive in enumerate(generator.normal(0.0, 0.3, 8).repeat(5)):
        own = {"profile_id": window, "drive": f"{drive}", DISTANCE: 50.0, "training_seed": 0}
        for gap in (1.0, 1.5, 2.0):
            flow = 2000.0 - 200.0 * (gap - 1.0)
            energy = 50.0 * (10.0 - (2000.0 - flow) / 100.0 + drive)
            rows.append({**own, "policy": "rule", "limit": gap, NET: energy, FLOW: flow})
        energy = 50.0 * (8.0 + drive)
        rows.append({**own, "policy": "learned", "limit": 0.0, NET: energy, FLOW: 1900.0})
    frame = pd.DataFrame(rows).assign(variant="fleet")

    def compared(**changes):
        sides = ("fleet", "learned"), ("fleet", "rule")
        changed = frame.assign(**changes).dropna(axis=1)
        return compare_fronts(changed, *sides, columns=FLEET, measure=saved_at_flow)

    saved = compared()
    learned = frame[frame.policy == "learned"][NET].mean() / 50.0
    assert saved.value == pytest.approx(1.0 / (9.0 + learned - 8.0))
    assert saved.high - saved.low < 0.03  # what drives differ by is on both sides
    # At a flow that the rule does not reach there is nothing to compare with.
    fast = frame[FLOW].where(frame.policy == "rule", 3000.0)
    none = compared(**{FLOW: fast})
    assert np.isnan([none.value, none.low, none.high]).all()
    # Drives that the fleet saves unlike are left out as wholes.
    more = 0.1 * frame.drive.astype(float).where(frame.policy != "rule", 0.0)
    whole, alone = (
        compared(**{NET: frame[NET] * (1.0 + more)}, **x) for x in ({}, {"drive": np.nan})
    )
    assert whole.value == alone.value
    assert whole.high - whole.low > 1.5 * (alone.high - alone.low)


def test_windows_of_one_drive_count_together() -> None:
    generator = np.random.default_rng(0)
    of_drive = np.repeat(generator.normal(0.0, 0.05, 8), 10)
    traffic = 100.0 + generator.normal(0.0, 1.0, 80)
    own = (traffic * (0.95 + of_drive + generator.normal(0.0, 0.01, 80)))[:, None]
    drives = np.repeat([f"drive {number}" for number in range(8)], 10).tolist()
    alone, whole = saving(own, traffic[:, None]), saving(own, traffic[:, None], drives=drives)
    assert whole.value == alone.value
    assert whole.high - whole.low > 2.0 * (alone.high - alone.low)
    one = saving(own, traffic[:, None], drives=["a"] * 80)  # tells nothing
    assert (one.low, one.high) == (alone.low, alone.high)
    # With ten windows alike in every drive, drives are all that there is.
    alike = np.repeat(generator.normal(0.0, 1.0, (8, 2)), 10, axis=0)
    found, each = crossed(alike, drives=drives), crossed(alike[::10])
    assert (found.low, found.high) == pytest.approx((each.low, each.high))
    shuffled = generator.permutation(80)
    again = saving(own[shuffled], traffic[shuffled][:, None], drives=[drives[i] for i in shuffled])
    assert again.high - again.low == pytest.approx(whole.high - whole.low)


def test_windows_of_one_recording_count_by_the_minute() -> None:
    """Thirty windows start in six minutes, whose waves save alike."""
    generator = np.random.default_rng(0)
    minute = np.repeat(np.arange(6), 5)
    saved = np.repeat(generator.normal(0.05, 0.02, 6), 5) + generator.normal(0.0, 0.002, 30)
    own = pd.DataFrame({"profile_id": range(30), "drive": "one", "start_s": 60.0 * minute + 7.0})
    rows = pd.concat(
        own.assign(strategy=name, training_seed=np.nan, energy=energy)
        for name, energy in (("mine", 100.0 * (1.0 - saved)), ("base", 100.0))
    )
    rows = rows.sample(frac=1.0, random_state=0)  # in any order

    def width(rows: pd.DataFrame) -> float:
        found = savings(rows, "energy", "mine", "base")
        assert found.value == pytest.approx(saved.mean())
        return found.high - found.low

    by_minute = width(rows)
    assert by_minute > 1.5 * width(rows.drop(columns="start_s"))
    # As of six drives; with two drives these count.
    assert by_minute == pytest.approx(width(rows.assign(drive=rows["start_s"].astype(str))))
    two = rows.assign(drive=rows["profile_id"] % 2)
    assert width(two) == pytest.approx(width(two.drop(columns="start_s")))
    alike = rows.assign(start_s=rows["start_s"] % 60.0)
    assert width(alike) == pytest.approx(width(alike.drop(columns="start_s")))
