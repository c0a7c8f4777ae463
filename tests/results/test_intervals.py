"""Bootstrap intervals: covered, reproducible, absent where nothing can be resampled."""

import time

import numpy as np
import pandas as pd
import pytest

from lcc_rl.results.intervals import band, mean, saving, share_saved
from lcc_rl.results.savings import per_window, savings


def test_one_seed_has_no_interval() -> None:
    found = mean([3.0])
    assert found.value == 3.0
    assert np.isnan([found.low, found.high]).all()
    assert np.isnan(saving([[1.0]], [[2.0]]).low)


def test_mean_of_two_seeds_lies_between_them() -> None:
    found = mean([1.0, 3.0])
    assert (found.low, found.value, found.high) == (1.0, 2.0, 3.0)


def test_windows_are_shared_by_both_sides() -> None:
    # Every window saves a tenth, however much it takes: nothing is uncertain.
    baseline = np.array([[10.0], [100.0], [1000.0]])
    found = saving(0.9 * baseline, baseline)
    assert (found.low, found.value, found.high) == pytest.approx((0.1, 0.1, 0.1))


def test_seeds_of_two_trainings_are_resampled_independently() -> None:
    own, other = np.array([[90.0, 80.0, 85.0]]), np.array([[100.0, 95.0, 105.0]])
    known, both = saving(own, [[other.mean()]]), saving(own, other)
    assert both.value == pytest.approx(known.value)
    assert both.low < known.low < known.high < both.high


def test_interval_is_that_of_a_plain_loop() -> None:
    generator = np.random.default_rng(3)
    base = generator.uniform(50, 150, (5, 2, 3))  # windows, seeds, drivers
    own = base[:, :1] * generator.uniform(0.8, 1.0, (5, 4, 3))
    found = saving(own.mean(2), base.mean(2))
    draws = []
    for _ in range(4000):
        windows = generator.integers(0, 5, 4)
        mine, theirs = generator.integers(0, 4, 3), generator.integers(0, 2, 1)
        sums = [0.0, 0.0]
        for window in windows:
            sums[0] += np.mean([own[window, seed].mean() for seed in mine])
            sums[1] += np.mean([base[window, seed].mean() for seed in theirs])
        draws.append(1.0 - sums[0] / sums[1])
    low, high = np.quantile(draws, [0.025, 0.975])
    assert found.value == pytest.approx(1 - own.mean() / base.mean())
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.06 * (high - low))


@pytest.mark.parametrize(("seeds", "at_least"), [(8, 0.90), (1, 0.90)])
def test_interval_covers_a_known_saving(seeds, at_least) -> None:
    """Windows, seeds and their interaction vary; a human baseline meets the same windows."""
    generator = np.random.default_rng(0)

    def covered() -> bool:
        traffic = generator.gamma(4.0, 25.0, (20, 1))
        gain = 0.05 + generator.normal(0, 0.02, (20, 1)) + generator.normal(0, 0.005, (20, seeds))
        gain = gain + generator.normal(0, 0.01, (1, seeds)) * (seeds > 1)
        found = saving(traffic * (1.0 - gain), traffic)
        return bool(found.low <= 0.05 <= found.high)

    shares = np.mean([covered() for _ in range(200)])
    assert at_least <= shares <= 0.99


def test_a_page_is_a_matter_of_seconds() -> None:
    count = 20 * 249 * 8
    one = pd.DataFrame(
        {
            "profile_id": np.arange(count) % 20,
            "driver_id": np.arange(count) // 20 % 249,
            "training_seed": np.arange(count) // (20 * 249),
            "energy": np.random.default_rng(0).uniform(1.0, 2.0, count),
        }
    )
    frame = pd.concat([one.assign(strategy=name) for name in ("alcc", "reference", "own_energy")])
    began = time.perf_counter()
    windows = per_window(frame, "energy")
    for strategy in ("alcc", "own_energy"):
        assert np.isfinite(savings(windows, "energy", strategy, "reference").low)
    assert time.perf_counter() - began < 2.0
    whole = savings(frame, "energy", "alcc", "reference")
    assert whole == savings(windows, "energy", "alcc", "reference")


def test_the_same_numbers_give_the_same_interval() -> None:
    numbers = np.random.default_rng(1).normal(size=8)
    assert mean(numbers) == mean(numbers)


def test_interval_covers_the_truth_about_as_often_as_it_says() -> None:
    generator = np.random.default_rng(0)
    hits = [
        found.low <= 0.0 <= found.high
        for found in (mean(generator.normal(size=20)) for _ in range(100))
    ]
    assert 0.85 <= np.mean(hits) <= 1.0


def test_band_holds_the_mean_of_every_point() -> None:
    curves = np.random.default_rng(0).normal(size=(7, 5)) + np.arange(7)[:, None]
    low, high = band(curves)
    assert low.shape == high.shape == (7,)
    assert (low < curves.mean(1)).all()
    assert (curves.mean(1) < high).all()
    assert (curves.min(1) <= low).all()


def test_columns_are_scaled_and_named() -> None:
    columns = mean([1.0, 3.0]).columns("x_pct", 100.0)
    assert columns == {"x_pct": 200.0, "x_pct_low": 100.0, "x_pct_high": 300.0}


def test_less_drawn_is_saved_also_where_the_baseline_gains() -> None:
    assert share_saved(90.0, 100.0) == pytest.approx(0.1)
    assert share_saved(-110.0, -100.0) == pytest.approx(0.1)  # recuperates more
    assert share_saved(-90.0, -100.0) == pytest.approx(-0.1)
    assert saving([[-110.0]], [[-100.0]]).value == pytest.approx(0.1)
