"""Smoothing: exact where it must be, less noisy where it should be, per stretch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from ngsim_text import cells, csv_text, pair

from lcc_rl.data.ngsim import read_ngsim
from lcc_rl.data.smoothing import SavitzkyGolay, averaged
from lcc_rl.data.sources import EpisodesSource
from lcc_rl.data.trajectories import Trajectories
from lcc_rl.errors import DataError

FOOT = 0.3048
EVERY = [SavitzkyGolay(), SavitzkyGolay(window_s=0.8, order=2)]


def drive(folder: Path, position_ft: np.ndarray) -> Trajectories:
    rows = [cells(7, k, Local_Y=y, v_Vel=0, v_Acc=0) for k, y in enumerate(position_ft)]
    (folder / "file.csv").write_text(csv_text(rows))
    return read_ngsim(folder / "file.csv")


@pytest.mark.parametrize("smoothing", EVERY, ids=str)
def test_even_motion_is_kept_and_gives_its_speed(tmp_path: Path, smoothing: SavitzkyGolay) -> None:
    samples = smoothing(drive(tmp_path, 5.0 * np.arange(60))).samples
    inner = np.arange(60)[smoothing.margin : 60 - smoothing.margin]
    assert samples["frame"].tolist() == inner.tolist()
    np.testing.assert_allclose(samples["position_m"], 5 * FOOT * inner, atol=1e-4)
    np.testing.assert_allclose(samples["speed_mps"], 50 * FOOT, rtol=1e-4)
    np.testing.assert_allclose(samples["acceleration_mps2"], 0, atol=5e-3)


def test_a_polynomial_passes_savitzky_golay_unchanged(tmp_path: Path) -> None:
    time = 0.1 * np.arange(80)
    cubic = 40 * time + 3 * time**2 - 0.2 * time**3
    samples = SavitzkyGolay(window_s=2.1, order=3)(drive(tmp_path, np.round(cubic, 6))).samples
    time, cubic = time[10:-10], cubic[10:-10]
    np.testing.assert_allclose(samples["position_m"], FOOT * cubic, atol=1e-4)
    np.testing.assert_allclose(
        samples["speed_mps"], FOOT * (40 + 6 * time - 0.6 * time**2), atol=1e-3
    )
    np.testing.assert_allclose(samples["acceleration_mps2"], FOOT * (6 - 1.2 * time), atol=2e-2)


def noisy_drives(folder: Path) -> tuple[Trajectories, np.ndarray, np.ndarray]:
    """Stop-and-go of known motion, measured with noise and outliers; speed and acceleration."""
    random, frames, vehicles = np.random.default_rng(1), 80, 60
    time = 0.1 * np.arange(frames)
    rate = random.uniform(0.2, 0.7, (vehicles, 1))  # rad/s
    phase, swing = random.uniform(0, 6, (vehicles, 1)), random.uniform(1, 4, (vehicles, 1))
    speed = 9 + swing * np.sin(rate * time + phase)
    position = 9 * time - swing / rate * np.cos(rate * time + phase) + 50
    measured = position + random.normal(0, 0.15, position.shape)
    measured += np.where(random.random(position.shape) < 0.02, 1.0, 0.0)
    rows = [
        cells(vehicle + 1, k, Local_Y=measured[vehicle, k] / FOOT)
        for vehicle in range(vehicles)
        for k in range(frames)
    ]
    (folder / "file.csv").write_text(csv_text(rows))
    acceleration = swing * rate * np.cos(rate * time + phase)
    return read_ngsim(folder / "file.csv"), speed, acceleration


@pytest.mark.parametrize("smoothing", EVERY, ids=str)
def test_the_ends_are_as_good_as_the_interior(tmp_path: Path, smoothing: SavitzkyGolay) -> None:
    raw, speed, acceleration = noisy_drives(tmp_path)
    samples = smoothing(raw).samples
    vehicle, frame = samples["vehicle"].to_numpy() - 1, samples["frame"].to_numpy()
    place = np.minimum(frame, 79 - frame) - smoothing.margin
    for name, true in (("speed_mps", speed), ("acceleration_mps2", acceleration)):
        error = np.abs(samples[name].to_numpy() - true[vehicle, frame])
        ends, interior = error[place < 3], error[place >= 3]
        assert len(ends) == 60 * 6
        assert np.sqrt((ends**2).mean()) < 1.25 * np.sqrt((interior**2).mean())
        assert ends.max() < 1.5 * interior.max()


def test_headways_follow_the_smoothed_positions(tmp_path: Path) -> None:
    rows = pair(range(60))
    rows[90][5] = str(float(rows[90][5]) + 20)  # the leader jumps once
    (tmp_path / "file.csv").write_text(csv_text(rows))
    samples = SavitzkyGolay()(read_ngsim(tmp_path / "file.csv")).samples
    follower, leader = samples.iloc[:46], samples.iloc[46:]
    np.testing.assert_allclose(
        follower["space_headway_m"],
        leader["position_m"].to_numpy() - follower["position_m"].to_numpy(),
        atol=1e-5,
    )
    assert 60 * FOOT < follower["space_headway_m"].iloc[23] < 65 * FOOT
    assert leader["space_headway_m"].isna().all()


def test_ripple_at_standstill_becomes_zero_and_is_counted(tmp_path: Path) -> None:
    position = 100 - 0.01 * np.arange(50)
    smoothed = SavitzkyGolay()(drive(tmp_path, position))
    assert smoothed.samples["speed_mps"].eq(0).all()
    assert "36 speeds below zero became zero" in str(smoothed.report)


def noisy_pairs() -> pd.DataFrame:
    """Two pairs of 20 s whose leader's speed is measured with noise."""
    generator, time = np.random.default_rng(0), np.round(0.1 * np.arange(200), 1)
    parts = []
    for number in (0, 1):
        noise = generator.normal(0.0, 0.1, len(time))
        speed = {"leader_speed_mps": 10.0 + number + noise, "follower_speed_mps": 10.0 + number}
        gap = 20.0 + np.cumsum(np.append(0.0, 0.1 * noise[:-1]))
        parts.append(pd.DataFrame({"episode": number, "time_s": time, "gap_m": gap, **speed}))
    return pd.concat(parts, ignore_index=True)


def test_an_average_takes_noise_and_keeps_gaps_consistent(tmp_path: Path) -> None:
    noisy_pairs().to_parquet(tmp_path / "pairs.parquet")
    source = {"path": str(tmp_path / "pairs.parquet")}
    raw, loaded = (EpisodesSource(**source, **x).load() for x in ({}, {"average_s": 1.1}))
    assert "averaged over 1.1 s: left out 20 rows" in loaded.report[-1]
    for number, episode in loaded.episodes.groupby("episode"):
        whole = raw.episodes[raw.episodes["episode"] == number]
        assert episode["time_s"].tolist() == whole["time_s"].tolist()[5:-5]
        for name in ("leader_speed_mps", "gap_m"):
            means = whole[name].rolling(11, center=True).mean().iloc[5:-5]
            np.testing.assert_allclose(episode[name], means, rtol=1e-5)
        apart = episode["leader_speed_mps"] - episode["follower_speed_mps"]
        np.testing.assert_allclose(episode["gap_m"].diff()[1:], 0.1 * apart[:-1], atol=1e-4)


def test_an_average_longer_than_all_episodes_is_refused() -> None:
    columns = {"follower_position_m": 0.0, "leader_position_m": 0.0}
    with pytest.raises(
        DataError, match=r"mine\.csv: the longest episode has 20\.0 s, data\.average_s"
    ):
        averaged(noisy_pairs().assign(**columns), 30.0, "mine.csv")
