"""Twins: what is measured of them, and which reaction is found in drivers that have one."""

from __future__ import annotations

import logging
import math
import re

import numpy as np
import pandas as pd
import pytest
import torch

from lcc_rl.drivers import twins
from lcc_rl.drivers.calibrator import Calibrator
from lcc_rl.drivers.observed import observe
from lcc_rl.drivers.twins import (
    REACTING,
    RECORDED_DRIVERS,
    TWINS,
    Reaction,
    choose_reaction,
    densities,
    drive_twins,
    measure_motion,
    measure_recorded,
    one_step_error,
    ratios,
    tried,
)
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.functional.driver_models import PARAMETERS
from lcc_rl.functional.idm import IDMConstants
from lcc_rl.functional.power import acceleration_loss
from lcc_rl.runs.output import log_report

STEP, SAMPLES = 0.1, 601


def followed(delay: float, noise: float, drivers: int = 40) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Drive late and straying IDM drivers; return their episodes and their parameters.

    A plain loop by the equations (A3, A4), in numpy.
    """
    chance, late = np.random.default_rng(3), round(delay / STEP)
    v0, headway = chance.uniform(15, 30, drivers), chance.uniform(0.8, 2.0, drivers)
    time = np.arange(SAMPLES)[:, None] * STEP
    waves = 2.0 * np.pi * time / chance.uniform(15, 40, drivers) + chance.uniform(0, 6, drivers)
    leader = 9.0 + 2.0 * np.sin(waves) + 1.0 * np.sin(2.3 * waves)
    speed, gap = np.empty((2, SAMPLES, drivers))
    speed[0], gap[0] = leader[0], 3.0 + headway * leader[0]
    low, x = np.zeros((2, drivers))  # white noise behind two low-passes of 0.7 s, settled
    kept = math.exp(-STEP / 0.7)
    loud = math.sqrt((1 - kept**2) ** 3 / (1 + kept**2)) / (1 - kept) * noise

    def strayed():
        low[:] = kept * low + (1 - kept) * chance.standard_normal(drivers)
        x[:] = kept * x + loud * low

    for _ in range(100):
        strayed()
    for k in range(SAMPLES - 1):
        seen = max(k - late, 0)
        v, s = speed[seen], gap[seen]
        wish = 2.0 + np.maximum(0.0, v * headway + v * (v - leader[seen]) / (2 * math.sqrt(1.5)))
        command = 1.0 - (v / v0) ** 4 - (wish / s) ** 2 + x
        speed[k + 1] = np.maximum(0.0, speed[k] + STEP * command)
        gap[k + 1] = gap[k] + 0.5 * STEP * (leader[k] + leader[k + 1] - speed[k] - speed[k + 1])
        strayed()
    number = np.repeat(np.arange(drivers), SAMPLES)
    table = pd.DataFrame({"episode": number, "time_s": np.tile(time[:, 0], drivers)})
    series = {"leader_speed_mps": leader, "follower_speed_mps": speed, "gap_m": gap}
    table = table.assign(**{name: values.T.ravel() for name, values in series.items()})
    own = IDMConstants()
    known = pd.DataFrame({"episode": range(drivers), "model": "idm"}).assign(
        **{PARAMETERS["desired_speed"].column: v0, PARAMETERS["time_gap"].column: headway},
        **{
            PARAMETERS[x].column: getattr(own, x)
            for x in ("acceleration", "deceleration", "min_gap")
        },
    )
    return table, known


@pytest.mark.slow
@pytest.mark.parametrize(("delay", "noise"), [(0.0, 0.0), (0.6, 0.25)])
def test_the_reaction_of_drivers_is_found(delay, noise) -> None:
    episodes, known = followed(delay, noise)
    observed = observe(episodes)
    records, twins = measure_recorded(observed), tried(observed, known)
    found = choose_reaction(twins, records, np.ones(len(records), bool))
    assert found.delay == pytest.approx(delay, abs=0.11)
    assert found.noise == pytest.approx(noise, abs=0.08)
    near = ratios(twins[found].twins, records)
    assert near["lost"] == pytest.approx(1.0, abs=0.08)
    assert near["energy"] == pytest.approx(1.0, abs=0.02)
    # What the late law leaves open of an acceleration is the noise.
    assert one_step_error(observed, known, delay) == pytest.approx(noise, abs=0.03)


@pytest.mark.slow
def test_calibration_smooths_drivers_and_the_reaction_restores_them() -> None:
    episodes, _ = followed(0.6, 0.25)
    result = Calibrator(reaction=True)(episodes)
    found = dict(list(result.twins.groupby("driver")))
    plain, reacting = (ratios(found[who], found[RECORDED_DRIVERS]) for who in (TWINS, REACTING))
    assert plain["lost"] < 0.9
    assert abs(reacting["lost"] - 1.0) < 0.5 * abs(plain["lost"] - 1.0)
    assert reacting["spectrum"] < 0.5 * plain["spectrum"]
    columns = result.drivers[["reaction_delay_s", "acceleration_noise_mps2"]]
    assert (columns.nunique() == 1).all()
    assert (columns.iloc[0] > 0.0).all()
    assert any("no estimate of a reaction time" in line for line in result.report)


def test_forgotten_units_and_bounds_are_said(caplog) -> None:
    episodes, _ = followed(0.0, 0.0, drivers=6)
    assert not any("IMPLAUSIBLE" in line for line in Calibrator()(episodes).report)
    speeds = episodes.filter(like="speed").columns
    wrong = episodes.assign(**{name: 3.6 * episodes[name] for name in speeds})  # km/h
    result = Calibrator()(wrong)
    log_report(result.report)
    loud = "\n".join(x.message for x in caplog.records if x.levelno >= logging.WARNING)
    assert re.search(r"lie on a bound: \d+ % on 5, \d+ % on \d+ \(calibration.bounds", loud)
    assert "IMPLAUSIBLE FIT: the gap of the median driver is off by" in loud
    assert "RMSPE" not in loud
    mean = result.twins.groupby("driver")["gap_m"].mean()
    gaps = f"gap {mean[TWINS]:.1f} m against {mean[RECORDED_DRIVERS]:.1f} m"
    assert any(gaps in line for line in result.report)


def test_measures_by_hand() -> None:
    # 10 + sin(2π 0.1 t) m/s, six periods after smoothing: a² has the mean (0.2π)²/2; an
    # average over 3.1 s damps it by sin(0.31π)/(0.31π), twice. Its density lies at 0.1 Hz.
    samples = np.array([631])
    time = np.arange(631) * STEP
    speed = (10.0 + np.sin(0.2 * np.pi * time))[:, None, None]
    found = measure_motion(speed, 30.0 + 0.0 * speed, samples, STEP)
    row, seconds = found.iloc[0], 60.0
    damped = np.sinc(0.31)
    assert row["distance_3.1s_m"] == pytest.approx(10.0 * seconds, rel=0.01)
    assert row["gap_m"] == pytest.approx(30.0)
    assert row["long_gap_share"] == pytest.approx(np.mean(2.5 * speed < 30.0))
    squares = (0.2 * np.pi * damped) ** 2 / 2.0 * seconds
    per_square = acceleration_loss(torch.tensor(10.0), torch.tensor(1.0)).item()
    assert row["lost_3.1s_j"] == pytest.approx(per_square * squares, rel=0.01)
    assert densities(found).iloc[0].idxmax() == pytest.approx(0.1)


def test_twins_of_one_delay_meet_the_same_noise() -> None:
    episodes, known = followed(0.0, 0.0, drivers=3)
    observed = observe(episodes)
    quiet, loud = drive_twins(observed, known, [Reaction(), Reaction(0.0, 0.3)])
    alone = drive_twins(observed, known, [Reaction(0.0, 0.3)])[0]
    pd.testing.assert_frame_equal(loud, alone)
    # Without reaction they are the drivers themselves.
    assert (quiet.pop("rmspe") < 1e-9).all()
    records = measure_recorded(observed)
    pd.testing.assert_frame_equal(quiet, records[quiet.columns], rtol=1e-9)
    same = ratios(quiet, records)
    assert [same[f"lost_{third}"] for third in (1, 2, 3)] == pytest.approx([1.0] * 3)
    assert same["slope"] == pytest.approx(0.0, abs=1e-6)
    seen = drive_twins(observed, known, [Reaction(0.0, 0.0, 0.3)])[0]
    near = ratios(seen, records)
    assert near["lost_1"] > 1.0
    assert near["slope"] > same["slope"]
    assert (loud["lost_1.1s_j"] > quiet["lost_1.1s_j"]).all()


def test_the_search_for_a_reaction_reports_its_progress(monkeypatch) -> None:
    monkeypatch.setattr(twins, "DELAYS", (0.0, 0.1))
    episodes, known = followed(0.0, 0.0, drivers=2)
    seen = []
    tried(observe(episodes), known, lambda *state: seen.append(state))
    assert seen == [(13, 26, "reactions tried"), (26, 26, "reactions tried")]
    monkeypatch.setattr(twins, "DELAYS", (0.0, 0.2, 0.3, 0.9))
    every = tried(observe(episodes.iloc[::5]), known)  # two samples a second
    assert {reaction.delay for reaction in every} == {0.0, 0.5, 1.0}  # what is driven


def test_noises_of_the_gap_are_tried_and_weigh_rough_leaders_only_where_asked(monkeypatch) -> None:
    for name, values in (("DELAYS", (0.0,)), ("NOISES", (0.0, 0.2)), ("GAP_NOISES", (0.3,))):
        monkeypatch.setattr(twins, name, values)
    episodes, known = followed(0.0, 0.2, drivers=6)
    observed = observe(episodes)
    every = tried(observed, known, perception=True)
    assert set(every) == {Reaction(), Reaction(0.0, 0.2), Reaction(0.0, 0.0, 0.3)}
    rows = np.ones(6, bool)
    records = measure_recorded(observed)
    assert choose_reaction(every, records, rows) == Reaction(0.0, 0.2)
    result = Calibrator(reaction=True, perception=True)(observed)
    assert "gap_noise" in result.drivers
    assert any(
        "of this loss behind the calmest, middle and roughest" in line for line in result.report
    )
    with pytest.raises(ConfigError, match="perception chooses a part of the reaction"):
        Calibrator(perception=True)


def test_drivers_that_hold_their_speeds_tell_nothing() -> None:
    time = np.arange(300) * STEP
    motion = {"leader_speed_mps": 15.0, "follower_speed_mps": 15.0, "gap_m": 20.0}
    episodes = pd.DataFrame({"episode": 0, "time_s": time}).assign(**motion)
    with pytest.raises(DataError, match=r"hold their speeds: too little .* use calibration=local"):
        Calibrator(modes=["local"], reaction=True)(episodes)
    report = "\n".join(Calibrator(modes=["local"])(episodes).report)
    assert "hold their speeds: too little to compare" in report
    assert "inf" not in report
