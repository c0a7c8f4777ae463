"""The synthetic stream: its drivers are who it says, it is repeatable, and it resembles I-80."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from helpers import check_refused, slow_but

from benchmarks.read import write_ngsim
from lcc_rl.data.ngsim import read_ngsim
from lcc_rl.drivers.calibrator import Calibrator
from lcc_rl.drivers.population import bootstrap
from lcc_rl.errors import ConfigError
from lcc_rl.functional.driver_models import simulate_follower
from lcc_rl.functional.idm import IDMConstants
from lcc_rl.functional.power import motor_power
from lcc_rl.synthetic.stream import Stream, StreamSource, as_recorded, draw_drivers

SMALL: dict[str, Any] = {"recordings": 2, "platoons": 4, "vehicles": 3, "duration_s": (35.0, 50.0)}
QUANTILES = [0.05, 0.25, 0.5, 0.75, 0.95]
MATCH = 0.15  # the accepted deviation of every compared number


@pytest.fixture(scope="module")
def stream() -> Stream:
    return StreamSource(**SMALL, noise=0.0, seed=5).generate()


def vehicle(stream: Stream, recording: str, number: int) -> pd.DataFrame:
    samples = stream.samples
    return samples[(samples["recording"] == recording) & (samples["vehicle"] == number)]


def statistics(episodes: pd.DataFrame) -> pd.DataFrame:
    """Mean, deviation and quantiles of the leaders' motion.

    Speed of every sample [m/s], acceleration by forward differences within an episode [m/s²], and
    energy by A2 over consecutive 30 s from the start of each episode [kJ]; rests are left out.
    """
    found: dict[str, list[np.ndarray]] = {"speed": [], "acceleration": [], "energy": []}
    for _, part in episodes.sort_values("time_s").groupby("episode"):
        speed = part["leader_speed_mps"].to_numpy(np.float64)
        acceleration = np.diff(speed) / 0.1
        power = motor_power(torch.from_numpy(speed[:-1]), torch.from_numpy(acceleration)).numpy()
        whole = len(power) // 300 * 300
        found["energy"].append(power[:whole].reshape(-1, 300).sum(1) * 0.1 / 1e3)
        found["speed"].append(speed)
        found["acceleration"].append(acceleration)
    series = {name: pd.Series(np.concatenate(parts)) for name, parts in found.items()}
    table = pd.DataFrame({name: x.quantile(QUANTILES) for name, x in series.items()})
    table.loc["mean"] = {name: x.mean() for name, x in series.items()}
    table.loc["std"] = {name: x.std(ddof=0) for name, x in series.items()}
    return table


@pytest.mark.parametrize("seed", slow_but([0], [0, 1]))
def test_leaders_match_i80(shared_data: Path, seed: int) -> None:
    pairs = pd.read_parquet(shared_data / "i80_pairs.parquet")
    real = statistics(pairs.rename(columns={"event": "episode"}))
    episodes = StreamSource(seed=seed).load().episodes
    assert 200 <= episodes["episode"].nunique() <= 300
    off = statistics(episodes) - real
    # Quantiles by the span of 90 %, levels by themselves; a mean acceleration is close to zero.
    shares = (off.loc[QUANTILES] / (real.loc[0.95] - real.loc[0.05])).abs()
    assert (shares < MATCH).all(axis=None), shares.to_string()
    for name, level in (("speed", "mean"), ("acceleration", "std"), ("energy", "mean")):
        assert abs(off.loc[level, name]) < MATCH * real.loc[level, name], name


def test_followers_are_idm_with_the_stated_parameters(stream: Stream) -> None:
    assert len(stream.truth) == 2 * 4 * 2
    for driver in stream.truth.itertuples():
        own = vehicle(stream, driver.recording, driver.vehicle)
        ahead = vehicle(stream, driver.recording, driver.preceding)
        length = ahead["length_m"].iloc[0]
        gap = ahead["position_m"].to_numpy() - length - own["position_m"].to_numpy()
        speeds, gaps, accelerations = simulate_follower(
            torch.tensor(ahead["speed_mps"].to_numpy())[:, None],
            torch.tensor(own["speed_mps"].to_numpy()[:1]),
            torch.tensor(gap[:1]),
            torch.tensor([driver.desired_speed_mps]),
            torch.tensor([driver.time_gap_s]),
            IDMConstants(driver.acceleration_mps2, driver.deceleration_mps2, driver.min_gap_m),
            0.1,
        )
        assert own["speed_mps"].to_numpy() == pytest.approx(speeds[:, 0].numpy(), abs=1e-9)
        assert gap == pytest.approx(gaps[:, 0].numpy(), abs=1e-9)
        executed = own["acceleration_mps2"].to_numpy()[1:]
        assert executed == pytest.approx(accelerations[:, 0].numpy(), abs=1e-8)


def test_calibration_recovers_the_time_gaps() -> None:
    source = StreamSource(**SMALL, noise=0.0, seed=5)
    found = Calibrator()(source.load().episodes).drivers
    keys = ["recording", "vehicle"]
    both = found.rename(columns={"follower_id": "vehicle"}).merge(
        source.generate().truth, on=keys, suffixes=("", "_true")
    )
    assert len(both) == len(found) >= 12
    error = (both["time_gap_s"] - both["time_gap_s_true"]).abs()
    assert error.median() < 0.02
    assert error.max() < 0.3
    assert found["rmspe"].median() < 0.005


def test_nobody_reverses_or_collides() -> None:
    samples = StreamSource(recordings=1, vehicles=8, seed=3).generate().samples
    assert (samples["speed_mps"] >= 0.0).all()
    assert (samples["position_m"] > 0.0).all()
    ahead = samples[["vehicle", "frame", "position_m", "length_m"]]
    pairs = samples.merge(
        ahead, left_on=["preceding", "frame"], right_on=["vehicle", "frame"], suffixes=("", "_0")
    )
    assert len(pairs) == (samples["preceding"] > 0).sum()
    assert (pairs["position_m_0"] - pairs["length_m_0"] - pairs["position_m"] > 0.5).all()


def test_a_stream_is_its_seed_and_holds_the_pairs_of_its_drivers() -> None:
    loaded, again, other = (StreamSource(**SMALL, seed=seed).load() for seed in (5, 5, 6))
    pd.testing.assert_frame_equal(loaded.episodes, again.episodes, check_exact=True)
    assert not loaded.episodes.equals(other.episodes)
    truth = StreamSource(**SMALL, seed=5).generate().truth
    pairs = loaded.episodes[["recording", "follower_id", "leader_id"]].drop_duplicates()
    assert pairs.to_numpy().tolist() == truth[["recording", "vehicle", "preceding"]].values.tolist()
    assert "seed 5" in loaded.report[0]


def test_the_stream_has_the_samples_of_an_ngsim_file(stream: Stream, tmp_path: Path) -> None:
    write_ngsim(stream.samples, tmp_path / "stream.csv")
    file, own = read_ngsim(tmp_path / "stream.csv"), as_recorded(stream.samples)
    for name in own.samples:  # but headways, which the file leaves to be derived
        at = {"rtol": 0.0, "atol": 5e-4} if name == "space_headway_m" else {}
        compare = np.testing.assert_allclose if at else np.testing.assert_array_equal
        compare(file.samples[name].to_numpy(), own.samples[name].to_numpy(), **at)
    for name in ("rows_kept", "recordings", "vehicles", "segments", "headways_unknown"):
        assert getattr(file.report, name) == getattr(own.report, name), name


def test_drivers_can_keep_up() -> None:
    generator = np.random.default_rng(0)
    drivers = bootstrap()
    level = np.array([2.0, 8.0, 60.0])
    chosen = drivers.desired_speed[draw_drivers(drivers, level, (500, 3), generator)]
    assert (chosen[:, 1] >= 1.2 * 8.0).all()
    assert (chosen[:, 2] == drivers.desired_speed.max()).all()  # nobody is that fast
    assert len(chosen[:, 0].unique()) > 50


def test_bad_settings_are_named() -> None:
    bad = [("recordings", 0), ("vehicles", 1), ("noise", float("nan"))]
    bad += [("duration_s", (60.0, 30.0)), ("duration_s", 60.0), ("leader", {"wave_s": -1.0})]
    cases = [(name, value, name) for name, value in bad]
    check_refused(lambda name, value: StreamSource(**{name: value}), cases, ConfigError)
