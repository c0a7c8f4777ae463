"""Smoothing: exact where it must be, less noisy where it should be, per stretch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from ngsim_text import cells, csv_text, pair

from lcc_rl.data.ngsim import read_ngsim
from lcc_rl.data.smoothing import ExponentialAverage, SavitzkyGolay, Smoothing
from lcc_rl.data.trajectories import Trajectories
from lcc_rl.errors import ConfigError

FOOT = 0.3048
EVERY = [SavitzkyGolay(), SavitzkyGolay(window_s=0.8, order=2), ExponentialAverage()]


def drive(folder: Path, position_ft: np.ndarray) -> Trajectories:
    rows = [cells(7, k, Local_Y=y, v_Vel=0, v_Acc=0) for k, y in enumerate(position_ft)]
    (folder / "file.csv").write_text(csv_text(rows))
    return read_ngsim(folder / "file.csv")


@pytest.mark.parametrize("smoothing", EVERY, ids=str)
def test_even_motion_is_kept_and_gives_its_speed(tmp_path: Path, smoothing: Smoothing) -> None:
    samples = smoothing(drive(tmp_path, 5.0 * np.arange(60))).samples
    np.testing.assert_allclose(samples["position_m"], 5 * FOOT * np.arange(60), atol=1e-4)
    np.testing.assert_allclose(samples["speed_mps"], 50 * FOOT, rtol=1e-4)
    np.testing.assert_allclose(samples["acceleration_mps2"], 0, atol=5e-3)


def test_a_polynomial_passes_savitzky_golay_unchanged(tmp_path: Path) -> None:
    time = 0.1 * np.arange(80)
    cubic = 40 * time + 3 * time**2 - 0.2 * time**3
    samples = SavitzkyGolay(window_s=2.1, order=3)(drive(tmp_path, np.round(cubic, 6))).samples
    np.testing.assert_allclose(samples["position_m"], FOOT * cubic, atol=1e-4)
    np.testing.assert_allclose(
        samples["speed_mps"], FOOT * (40 + 6 * time - 0.6 * time**2), atol=1e-3
    )
    np.testing.assert_allclose(samples["acceleration_mps2"], FOOT * (6 - 1.2 * time), atol=2e-2)


def test_exponential_average_against_a_hand_computed_value(tmp_path: Path) -> None:
    position = np.zeros(9)
    position[4] = 10.0
    samples = ExponentialAverage(width_s=0.1)(drive(tmp_path, position)).samples
    side = np.exp([-1.0, -2.0, -3.0])
    full = 1 + 2 * side.sum()
    expected = np.zeros(9)
    expected[4] = 1 / full
    expected[[3, 5]] = side[0] / full
    expected[[2, 6]] = side[1] / (1 + 2 * side[:2].sum())  # two frames from the end
    np.testing.assert_allclose(samples["position_m"] / (10 * FOOT), expected, atol=1e-6)
    rise = (expected[4] - expected[2]) * 10 * FOOT / 0.2
    assert samples["speed_mps"].iloc[3] == pytest.approx(rise, rel=1e-5)


@pytest.mark.parametrize("smoothing", EVERY, ids=str)
def test_noise_shrinks_and_speeds_agree_with_positions(
    tmp_path: Path, smoothing: Smoothing
) -> None:
    time = 0.1 * np.arange(600)
    true = 30 * time + 20 * np.sin(0.3 * time)
    noise = np.random.default_rng(3).normal(0, 0.3, 600)
    raw = drive(tmp_path, np.round(true + noise, 3))
    samples = smoothing(raw).samples
    left = samples["position_m"] / FOOT - true
    assert left[30:-30].std() < 0.8 * 0.3
    implied = np.gradient(samples["position_m"].to_numpy(dtype=float), 0.1)
    rough = np.abs(implied - samples["speed_mps"])[2:-2]
    assert rough.mean() < 0.5
    assert (samples["speed_mps"] >= 0).all()
    assert raw.samples["speed_mps"].eq(0).all()  # the given trajectories stay as they are


@pytest.mark.parametrize("smoothing", EVERY, ids=str)
def test_stretches_do_not_mix(tmp_path: Path, smoothing: Smoothing) -> None:
    rows = [cells(7, k, Local_Y=10.0 * k) for k in range(30)]
    far = [cells(7, k, Local_Y=10.0 * k + 5000) for k in range(31, 60)]
    (tmp_path / "file.csv").write_text(csv_text(rows + far + [cells(8, 59, Local_Y=1.0)]))
    smoothed = smoothing(read_ngsim(tmp_path / "file.csv"))
    alone = smoothing(drive(tmp_path, 10.0 * np.arange(30))).samples
    names = ["position_m", "speed_mps", "acceleration_mps2"]
    pd.testing.assert_frame_equal(smoothed.samples[names].iloc[:30], alone[names])
    assert smoothed.samples["speed_mps"].iloc[-1] == pytest.approx(100 * FOOT)  # as published
    assert "1 stretches were too short" in str(smoothed.report)


@pytest.mark.parametrize("length", range(1, 20))
def test_short_stretches(tmp_path: Path, length: int) -> None:
    samples = SavitzkyGolay(window_s=1.5, order=3)(drive(tmp_path, 5.0 * np.arange(length))).samples
    published = length < 5
    np.testing.assert_allclose(
        samples["speed_mps"], 0 if published else 50 * FOOT, rtol=1e-4, atol=1e-6
    )


def test_headways_follow_the_smoothed_positions(tmp_path: Path) -> None:
    rows = pair(range(40))
    rows[50][5] = str(float(rows[50][5]) + 20)  # the leader jumps once
    (tmp_path / "file.csv").write_text(csv_text(rows))
    samples = ExponentialAverage()(read_ngsim(tmp_path / "file.csv")).samples
    follower, leader = samples.iloc[:40], samples.iloc[40:]
    np.testing.assert_allclose(
        follower["space_headway_m"],
        leader["position_m"].to_numpy() - follower["position_m"].to_numpy(),
        atol=1e-5,
    )
    assert 60 * FOOT < follower["space_headway_m"].iloc[10] < 65 * FOOT
    assert leader["space_headway_m"].isna().all()


def test_ripple_at_standstill_becomes_zero_and_is_counted(tmp_path: Path) -> None:
    position = 100 - 0.01 * np.arange(50)
    smoothed = SavitzkyGolay()(drive(tmp_path, position))
    assert smoothed.samples["speed_mps"].eq(0).all()
    assert "50 speeds below zero became zero" in str(smoothed.report)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SavitzkyGolay(window_s=0.3, order=3), "'window_s' must be 0.4 to 600"),
        (lambda: SavitzkyGolay(window_s=float("nan")), "'window_s'"),
        (lambda: SavitzkyGolay(order=1), "'order' must be at least 2"),
        (lambda: ExponentialAverage(width_s=0.0), "'width_s' must be 0 to 100"),
    ],
)
def test_impossible_settings(make: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make()  # type: ignore[operator]
