"""Bootstrap intervals: covered, reproducible, absent where nothing can be resampled; fronts."""

from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from lcc_rl.results.bootstrap import Estimate, Minute, crossed, mean, saving, share_saved
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


def test_windows_are_shared_by_both_sides_and_seeds_are_not() -> None:
    # Every window saves a tenth, however much it takes: nothing is uncertain.
    baseline = np.array([[10.0], [100.0], [1000.0]])
    found = saving(0.9 * baseline, baseline)
    assert (found.low, found.value, found.high) == pytest.approx((0.1, 0.1, 0.1))
    own, other = np.array([[90.0, 80.0, 85.0]]), np.array([[100.0, 95.0, 105.0]])
    known, both = saving(own, [[other.mean()]]), saving(own, other)
    assert both.value == pytest.approx(known.value)
    assert both.low < known.low < known.high < both.high
    assert saving(own, other) == both


def check_interval(found: Estimate, value: float, draw: Callable[[], float]) -> float:
    """Compare with a plain loop of draws; return the width of its interval."""
    low, high = np.quantile([draw() for _ in range(4000)], [0.025, 0.975])
    assert found.value == pytest.approx(value)
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.06 * (high - low))
    return high - low


def test_interval_is_that_of_a_plain_loop() -> None:
    generator = np.random.default_rng(3)
    base = generator.uniform(50, 150, (5, 2, 3))  # windows, seeds, drivers
    own = base[:, :1] * generator.uniform(0.8, 1.0, (5, 4, 3))

    def draw() -> float:
        windows = generator.integers(0, 5, 4)
        mine, theirs = generator.integers(0, 4, 3), generator.integers(0, 2, 1)
        return 1.0 - own[windows][:, mine].mean() / base[windows][:, theirs].mean()

    check_interval(saving(own.mean(2), base.mean(2)), 1 - own.mean() / base.mean(), draw)


def test_equal_seeds_are_resampled_in_pairs() -> None:
    generator = np.random.default_rng(5)
    base = generator.uniform(80, 120, (6, 1)) * generator.uniform(0.9, 1.1, (1, 4))
    own = base * generator.uniform(0.94, 0.96, (6, 4))
    keys = pd.MultiIndex.from_product([range(6), range(4)], names=["profile_id", "training_seed"])
    parts = {"alcc a": own, "alcc b": base}
    rows = pd.concat(
        pd.DataFrame({"strategy": name, "energy": x.ravel()}, keys).reset_index()
        for name, x in parts.items()
    ).sample(frac=1.0, random_state=0)

    def draw() -> float:
        windows, seeds = generator.integers(0, 6, 5), generator.integers(0, 4, 3)
        return 1.0 - own[windows][:, seeds].sum() / base[windows][:, seeds].sum()

    found = savings(rows, "energy", "alcc a", "alcc b")
    width = check_interval(found, 1.0 - own.sum() / base.sum(), draw)
    assert savings(rows, "energy", "alcc b", "alcc b").columns("") == {"": 0, "_low": 0, "_high": 0}
    # Different seeds are independent: the trainings differ more than the saving does.
    shifted = rows.assign(training_seed=rows["training_seed"] + 9 * (rows["strategy"] == "alcc b"))
    apart = savings(shifted, "energy", "alcc a", "alcc b")
    assert apart.high - apart.low > 3.0 * width


def test_energy_and_distance_are_resampled_together() -> None:
    """Who falls back in some windows takes as much less energy there: per km nothing varies."""
    generator = np.random.default_rng(4)
    way = generator.uniform(500, 2000, (12, 1))
    own = way * generator.uniform(0.5, 1.0, (12, 3))
    found = saving(0.18 * own, 0.2 * way, ways=(own, way))
    assert (found.low, found.value, found.high) == pytest.approx((0.1, 0.1, 0.1))
    noise = generator.uniform(0.8, 1.0, (12, 3))

    def draw() -> float:
        windows, seeds = generator.integers(0, 12, 11), generator.integers(0, 3, 2)
        return 1.0 - (own * noise)[windows][:, seeds].sum() / own[windows][:, seeds].sum()

    found = saving(0.2 * own * noise, 0.2 * way, ways=(own, way))
    check_interval(found, 1.0 - (own * noise).sum() / own.sum(), draw)


@pytest.mark.parametrize("seeds", [8, 1])
def test_interval_covers_a_known_saving(seeds) -> None:
    """Windows, seeds and their interaction vary; a human baseline meets the same windows."""
    generator = np.random.default_rng(0)

    def covered() -> bool:
        traffic = generator.gamma(4.0, 25.0, (20, 1))
        gain = 0.05 + generator.normal(0, 0.02, (20, 1)) + generator.normal(0, 0.005, (20, seeds))
        gain = gain + generator.normal(0, 0.01, (1, seeds)) * (seeds > 1)
        found = saving(traffic * (1.0 - gain), traffic)
        return bool(found.low <= 0.05 <= found.high)

    assert 0.90 <= np.mean([covered() for _ in range(200)]) <= 0.99


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
    assert np.isfinite([halves.low, halves.high]).all()
    # Nothing is saved in either window, but less is driven where it costs more.
    two = saving([[2.0], [9.0]], [[18.0], [1.0]], ways=([[1.0], [9.0]], [[9.0], [1.0]]))
    assert (two.low, two.high) == (0.0, two.value)
    assert two.value == pytest.approx(1 - 1.1 / 1.9)
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
    # Drives that the fleet saves unlike are resampled as wholes.
    more = 0.1 * frame.drive.astype(float).where(frame.policy != "rule", 0.0)
    whole, alone = (
        compared(**{NET: frame[NET] * (1.0 + more)}, **x) for x in ({}, {"drive": np.nan})
    )
    assert whole.value == alone.value
    assert whole.high - whole.low > 1.5 * (alone.high - alone.low)


def test_windows_of_one_drive_are_resampled_together() -> None:
    generator = np.random.default_rng(0)
    of_drive = np.repeat(generator.normal(0.0, 0.05, 8), 10)
    traffic = 100.0 + generator.normal(0.0, 1.0, 80)
    own = (traffic * (0.95 + of_drive + generator.normal(0.0, 0.01, 80)))[:, None]
    drives = np.repeat([f"drive {number}" for number in range(8)], 10).tolist()
    alone, whole = saving(own, traffic[:, None]), saving(own, traffic[:, None], drives=drives)
    assert whole.value == alone.value
    assert whole.high - whole.low > 2.0 * (alone.high - alone.low)
    few = saving(own, traffic[:, None], drives=["a"] * 40 + ["b"] * 40)  # too few to tell
    assert (few.low, few.high) == (alone.low, alone.high)
    # With ten windows alike in every drive, drives are all that there is.
    alike = np.repeat(generator.normal(0.0, 1.0, (8, 2)), 10, axis=0)
    found, each = crossed(alike, drives=drives), crossed(alike[::10])
    assert (found.low, found.high) == pytest.approx((each.low, each.high))
    shuffled = generator.permutation(80)
    again = saving(own[shuffled], traffic[shuffled][:, None], drives=[drives[i] for i in shuffled])
    assert again.high - again.low == pytest.approx(whole.high - whole.low, rel=0.1)


def test_windows_of_one_recording_are_resampled_by_the_minute() -> None:
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
    # As of six drives; with five drives these are resampled, with four minutes windows are.
    assert by_minute == pytest.approx(width(rows.assign(drive=rows["start_s"].astype(str))))
    five = rows.assign(drive=rows["profile_id"] % 5)
    assert width(five) == pytest.approx(width(five.drop(columns="start_s")))
    few = rows.assign(start_s=rows["start_s"] % 240.0)
    assert width(few) == pytest.approx(width(few.drop(columns="start_s")))


def test_few_drives_have_a_t_interval_beside_that_over_windows() -> None:
    # Three drives of four windows each; windows of a drive save alike.
    shares = np.array([0.02, 0.05, 0.11])
    baseline = np.full((12, 1), 100.0)
    own = baseline * (1.0 - np.repeat(shares, 4)).reshape(-1, 1)
    drives = np.repeat(list("abc"), 4).tolist()
    found = saving(own, baseline, drives=drives)
    low, high = stats.t.interval(0.95, 2, shares.mean(), shares.std(ddof=1) / 3**0.5)
    assert found.over_drives == pytest.approx((low, high), rel=1e-3)
    assert low < found.low < found.high < high
    minutes = [Minute(drive, at) for at, drive in enumerate(drives)]
    assert saving(own, baseline, drives=minutes).over_drives == found.over_drives
    for many in (["a"] * 12, list("abcdef") * 2):  # nothing to tell from; enough to resample
        assert saving(own, baseline, drives=many).over_drives is None
