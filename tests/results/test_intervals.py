"""Bootstrap intervals: covered, reproducible, absent where there is one seed."""

import numpy as np
import pytest

from lcc_rl.results.intervals import band, mean, saving, share_saved


def test_one_seed_has_no_interval() -> None:
    found = mean([3.0])
    assert found.value == 3.0
    assert np.isnan([found.low, found.high]).all()
    assert np.isnan(saving([1.0], [2.0], exact=True).low)
    # Several seeds against a reference that was trained once: still unknown.
    assert np.isnan(saving([1.0, 2.0], [2.0]).low)


def test_mean_of_two_seeds_lies_between_them() -> None:
    found = mean([1.0, 3.0])
    assert (found.low, found.value, found.high) == (1.0, 2.0, 3.0)


def test_saving_against_a_known_baseline() -> None:
    found = saving([90.0, 80.0], [100.0], exact=True)
    assert found.value == pytest.approx(0.15)
    assert (found.low, found.high) == pytest.approx((0.1, 0.2))


def test_both_sides_of_a_comparison_of_trainings_are_resampled() -> None:
    own, other = [90.0, 80.0, 85.0], [100.0, 95.0, 105.0]
    known = saving(own, [np.mean(other)], exact=True)
    both = saving(own, other)
    assert both.value == pytest.approx(known.value)
    assert both.low < known.low < known.high < both.high


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
    assert saving([-110.0], [-100.0]).value == pytest.approx(0.1)
