"""Intervals of calibrated parameters cover those of known drivers as often as they should."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import slow_but

from lcc_rl.drivers.calibrator import Calibrator
from lcc_rl.drivers.observed import Observed, observe
from lcc_rl.drivers.parameters import fitted
from lcc_rl.functional.driver_models import NoiseStep, follow
from lcc_rl.functional.laws import LAWS

DRIVERS = 80
CASES = [
    ("local", "speed_rmspe", "acceleration"),
    ("global", "both", "acceleration"),
    ("local", "both", "acceleration"),
    ("local", "speed_rmspe", "record"),
]


@pytest.fixture(scope="module")
def known(make_episodes) -> tuple[Observed, torch.Tensor]:
    """Records without noise, and all parameters of their drivers ``[drivers, names]``."""
    generator = np.random.default_rng(5)
    own = generator.uniform([15.0, 0.7], [30.0, 2.2], (DRIVERS, 2))
    law = LAWS["idm"]()
    rest = [[getattr(law, name) for name in law.shared()]] * DRIVERS
    return observe(make_episodes(*own.T.tolist())), torch.tensor(np.hstack([own, rest]))


def noisy(observed: Observed, own: torch.Tensor, where: str) -> Observed:
    """Drive again with noise of the acceleration, or add AR(1) noise to the record."""
    generator, form = torch.Generator().manual_seed(1), NoiseStep.of(observed.time_step)

    def draw() -> torch.Tensor:
        return torch.randn(DRIVERS, generator=generator, dtype=torch.float64)

    noise = list(form.start(draw(), draw()))

    def strayed(_: int, command: torch.Tensor) -> torch.Tensor:
        noise[:] = form.next(*noise, draw()), noise[0]
        return command + 0.2 * noise[1]

    if where == "acceleration":
        start = observed.follower_speed[0], observed.gaps[0]
        pair = own[:, 0], own[:, 1]
        law, time_step = LAWS["idm"](), observed.time_step
        motion = follow(law, observed.leader_speed, *start, pair, time_step, disturbed=strayed)
        speed, gap = zip(start, *(state[:2] for state in motion), strict=True)
        return replace(observed, follower_speed=torch.stack(speed), gaps=torch.stack(gap))
    kept, series = math.exp(-observed.time_step / 3.0), []
    for level, values in ((0.3, observed.follower_speed), (0.6, observed.gaps)):
        walk = [draw()]
        while len(walk) < len(values):
            walk.append(kept * walk[-1] + math.sqrt(1.0 - kept**2) * draw())
        series.append((values + level * torch.stack(walk)).clamp(min=0.0))
    return replace(observed, follower_speed=series[0], gaps=series[1])


@pytest.mark.parametrize(("mode", "objective", "where"), slow_but(CASES[:2], CASES))
def test_intervals_cover_known_parameters(known, mode, objective, where):
    observed, truth = known
    records = noisy(observed, truth, where)
    found = Calibrator(modes=[mode], objective=objective)(records).drivers
    for place, name in enumerate(fitted(mode)):
        column = LAWS["idm"].table()[name].column
        low, high = found[f"{column}_low"], found[f"{column}_high"]
        real = truth[:, place].numpy()
        assert (~(low > real) & ~(high < real)).mean() >= 0.85, name
        if mode == "local":
            assert (high - low).isna().mean() < 0.3, name
        if mode == "local" and where == "acceleration":  # not much wider than 4 σ
            assert (high - low).median() < 8.0 * (found[column] - real).std(), name


def test_without_noise_drivers_are_found_exactly(known, monkeypatch):
    observed, truth = known
    for objective in ("speed_rmspe", "both"):
        found = Calibrator(modes=["global"], objective=objective)(observed).drivers
        for name, real in zip(fitted("global"), truth.T.numpy(), strict=True):
            column = LAWS["idm"].table()[name].column
            low, high = found[f"{column}_low"], found[f"{column}_high"]
            assert (~(low > real) & ~(high < real)).mean() >= 0.95, name
    assert (found["time_gap_s"] - truth[:, 1].numpy()).abs().median() < 1e-3
    monkeypatch.setattr("lcc_rl.drivers.genetic.ROUNDS", 1)
    stopped = Calibrator(modes=["global"])(observed)
    rows = stopped.drivers["time_gap_s_low"].isna() & stopped.drivers["time_gap_s_high"].isna()
    words = (
        " of 80 records have not converged and have no intervals: more generations? (calibration"
    )
    assert rows.any()
    [line] = [line for line in stopped.report if words in line]
    assert line.startswith(f"global: {rows.sum()} of 80")
    assert line.endswith("global_genetic.generations=180)")


def test_what_a_record_does_not_determine_has_no_end(make_episodes):
    episodes = make_episodes([35.0, 20.0], [1.2, 1.2])
    calibrated = Calibrator(bounds={"desired_speed": [5.0, 30.0]})(episodes)
    drivers = calibrated.drivers
    assert drivers["desired_speed_mps_high"].isna().tolist() == [True, False]
    for column in ("desired_speed_mps", "time_gap_s"):
        assert (drivers[f"{column}_low"] <= drivers[column]).iloc[1]
        assert (drivers[f"{column}_high"] >= drivers[column]).iloc[1]
    line = "local: 95 % intervals: v0 is not identified for 50 % of the records (an end is not"
    assert any(text.startswith(line) for text in calibrated.report)
    still = episodes.assign(leader_speed_mps=0.0, follower_speed_mps=1.0, gap_m=500.0)
    slow = Calibrator(bounds={"time_gap": [3.9, 4.0]})(still)
    assert slow.drivers[["time_gap_s_low", "time_gap_s_high"]].isna().all(axis=None)
    assert not any("nan" in text for text in slow.report)


def test_draws_in_groups_give_intervals_of_the_same_width(known, monkeypatch):
    records = noisy(*known, "acceleration")
    widths = []
    for samples in (2**23, 1):
        monkeypatch.setattr("lcc_rl.drivers.fit_error.SAMPLES_AT_ONCE", samples)
        found = Calibrator()(records).drivers
        widths.append(found["time_gap_s_high"] - found["time_gap_s_low"])
    assert 0.6 < (widths[1] / widths[0]).median() < 1.6
    assert len(widths[0]) == DRIVERS
