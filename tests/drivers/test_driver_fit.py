"""Calibration: the right error, known drivers recovered, real drivers fitted, bad input refused."""

import time

import numpy as np
import pandas as pd
import pytest
import torch

from lcc_rl.drivers import fit_error
from lcc_rl.drivers.calibrator import Calibrator
from lcc_rl.drivers.fit import fit
from lcc_rl.drivers.fit_error import FitError
from lcc_rl.drivers.genetic import GeneticSettings
from lcc_rl.drivers.observed import Selection, observe
from lcc_rl.drivers.parameters import COLUMNS, DEFAULT_BOUNDS, MODES, fitted
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.functional.idm import IDMConstants, simulate_follower

QUICK = GeneticSettings(population=8, generations=2, founders=1)


@pytest.fixture
def numba():
    """Calibrations simulate with numba."""
    pytest.importorskip("numba")


@pytest.fixture
def torch_only(monkeypatch):
    """Calibrations simulate with torch."""
    monkeypatch.setattr(fit_error, "kernel_of", lambda name: None)


def random_candidates(names, *shape):
    """Parameters within the bounds, ``[*shape, names]``."""
    low, high = torch.tensor([DEFAULT_BOUNDS[name] for name in names]).double().unbind(-1)
    share = torch.rand(*shape, len(names), generator=torch.Generator().manual_seed(1)).double()
    return low + share * (high - low)


def reference_error(observed, candidates, constants, names):
    """The definition of A6, episode by episode, with the plain simulation."""
    result = torch.zeros(candidates.shape[:2], dtype=torch.float64)
    for row, samples in enumerate(observed.samples):
        truth = observed.follower_speed[:samples, row]
        for column, values in enumerate(candidates[row]):
            own = dict(zip(names, values, strict=True))
            speed, _, _ = simulate_follower(
                observed.leader_speed[:samples, row],
                truth[0],
                observed.gap[row],
                own.pop("desired_speed"),
                own.pop("time_gap"),
                constants.with_(**own),
                observed.time_step,
            )
            result[row, column] = ((speed - truth).square().sum() / truth.square().sum()).sqrt()
    return result


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("way", ["numba", "torch_only"])
@pytest.mark.parametrize("exponent", [4.0, 2.5])
def test_error_is_that_of_the_plain_simulation(mode, way, exponent, request, uneven_lengths):
    request.getfixturevalue(way)
    observed, names = observe(uneven_lengths), fitted(mode)
    constants = IDMConstants(exponent=exponent)
    candidates = random_candidates(names, 3, 6)
    error = FitError(observed, constants, names)(candidates)
    expected = reference_error(observed, candidates, constants, names)
    torch.testing.assert_close(error, expected, rtol=1e-9, atol=1e-12)


def test_numba_and_torch_give_the_same_errors(numba, uneven_lengths, monkeypatch):
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-4)):
        observed = observe(uneven_lengths).to("cpu", dtype)
        for names in map(fitted, MODES):
            candidates = random_candidates(names, 3, 500)
            by_numba = FitError(observed, IDMConstants(), names)(candidates.to(dtype))
            with monkeypatch.context() as patch:
                patch.setattr(fit_error, "kernel_of", lambda name: None)
                by_torch = FitError(observed, IDMConstants(), names)(candidates.to(dtype))
            assert by_numba.dtype == dtype
            torch.testing.assert_close(by_numba, by_torch, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("way", ["numba", "torch_only"])
def test_the_log_says_which_package_simulates(way, request, uneven_lengths, caplog):
    request.getfixturevalue(way)
    for _ in range(2):
        caplog.clear()
        with caplog.at_level("INFO", logger="lcc_rl"):
            fit(uneven_lengths, genetic=QUICK)
        assert caplog.messages[-1] == f"drivers are simulated with {way.removesuffix('_only')}"


@pytest.mark.slow
def test_numba_and_torch_find_the_same_drivers(numba, known_episodes, monkeypatch):
    # The same draws; roundings may let another of two equally good individuals survive.
    found = {mode: fit(known_episodes, mode, seed=2).drivers for mode in MODES}
    monkeypatch.setattr(fit_error, "kernel_of", lambda name: None)
    for mode, drivers in found.items():
        expected = fit(known_episodes, mode, seed=2).drivers
        columns = [COLUMNS[name] for name in ("desired_speed", "time_gap")]
        off = (drivers[columns] / expected[columns] - 1.0).abs()
        assert off.median().max() < (1e-3 if mode == "local" else 2e-2)
        assert (drivers["rmspe"] - expected["rmspe"]).abs().max() < 1e-3


@pytest.mark.parametrize("way", ["numba", "torch_only"])
def test_what_is_no_number_stays_so_and_harms_no_other(way, request, uneven_lengths):
    request.getfixturevalue(way)
    candidates = random_candidates(fitted("global"), 3, 8)
    for at in range(5):
        candidates[1, at, at] = np.nan
    error = FitError(observe(uneven_lengths), IDMConstants(), fitted("global"))(candidates)
    assert error[1, :5].isnan().all()
    assert error[1, 5:].isfinite().all()
    assert error[[0, 2]].isfinite().all()


def test_known_drivers_are_recovered(known_drivers, known_episodes):
    drivers = fit(known_episodes).drivers
    speed_error = (drivers["desired_speed_mps"] / known_drivers["desired_speed"] - 1.0).abs()
    gap_error = (drivers["time_gap_s"] / known_drivers["time_gap"] - 1.0).abs()
    assert speed_error.median() < 0.01
    assert gap_error.median() < 0.01
    assert speed_error.max() < 0.1
    assert gap_error.max() < 0.05
    assert drivers["rmspe"].max() < 0.005
    assert not drivers["desired_speed_at_bound"].any()


def test_global_mode_fits_better_where_the_constants_are_others(known_drivers, make_episodes):
    own = IDMConstants(acceleration=1.8, deceleration=2.5, min_gap=3.0)
    episodes = make_episodes(*(known_drivers[c].tolist()[:10] for c in known_drivers), own)
    local, free = fit(episodes).drivers, fit(episodes, "global").drivers
    assert (free["rmspe"] <= local["rmspe"] + 1e-6).all()
    assert free["rmspe"].mean() < 0.3 * local["rmspe"].mean()
    assert (free["time_gap_s"] / known_drivers["time_gap"][:10] - 1.0).abs().median() < 0.05


def test_constants_are_chosen_by_the_same_objective(make_episodes):
    own = IDMConstants(acceleration=1.8, deceleration=2.5, min_gap=3.0)
    episodes = make_episodes([20.0, 25.0, 30.0], [1.0, 1.4, 1.8], own, [20.0] * 3)
    given = fit(episodes)
    chosen = fit(episodes, choose_constants=True)
    assert chosen.drivers["rmspe"].mean() < 0.5 * given.drivers["rmspe"].mean()
    assert chosen.drivers["acceleration_mps2"].nunique() == 1
    assert any("constants chosen" in line for line in chosen.report)


def test_rows_keep_the_order_and_identity_of_the_input(uneven_lengths):
    drivers = fit(uneven_lengths, genetic=QUICK).drivers
    assert drivers["episode"].tolist() == [0, 1, 2]
    assert drivers["follower_id"].tolist() == [100, 101, 102]
    assert drivers["samples"].tolist() == [238, 401, 315]
    assert drivers.columns.tolist() == [
        *("episode", "recording", "follower_id", "leader_id"),
        *(COLUMNS[name] for name in fitted("global")),
        *("rmspe", "gap_rmse_m", "gap_nrmse", "samples"),
        *(f"{name}_at_bound" for name in fitted("global")),
        *("mode", "model"),
    ]


def test_equal_seeds_give_equal_drivers_and_none_depends_on_the_others(uneven_lengths):
    episodes = uneven_lengths
    first = fit(episodes, seed=3, genetic=QUICK).drivers
    pd.testing.assert_frame_equal(first, fit(episodes, seed=3, genetic=QUICK).drivers)
    assert not first.equals(fit(episodes, seed=4, genetic=QUICK).drivers)
    alone = fit(episodes[episodes["episode"] == 2], seed=3, genetic=QUICK).drivers
    pd.testing.assert_series_equal(alone.iloc[0], first.iloc[2], check_names=False)


def test_a_driver_who_never_drives_freely_is_flagged(make_episodes):
    episodes = make_episodes([35.0, 20.0], [1.2, 1.2])
    drivers = fit(episodes, bounds={"desired_speed": [5.0, 30.0]}).drivers
    assert drivers["desired_speed_at_bound"].tolist() == [True, False]
    assert not drivers[["acceleration_at_bound", "min_gap_at_bound"]].any(axis=None)


def test_columns_of_other_names_are_understood(uneven_lengths):
    episodes = uneven_lengths
    renamed = episodes.rename(columns={"episode": "event", "recording": "period"})
    expected = fit(episodes, genetic=QUICK).drivers
    pd.testing.assert_frame_equal(fit(renamed, genetic=QUICK).drivers, expected)


def test_unfit_episodes_are_dropped_and_counted(make_episodes):
    speeds, gaps = [20.0] * 6, [1.0] * 6
    episodes = make_episodes(speeds, gaps, seconds=[20.0] * 5 + [5.0])
    at = {number: episodes.index[episodes["episode"] == number] for number in range(6)}
    episodes.loc[at[1][50], "gap_m"] = 0.5
    episodes.loc[at[2][50], "follower_speed_mps"] = np.nan
    episodes.loc[at[3], ["follower_speed_mps", "leader_speed_mps"]] = 0.0
    episodes = episodes.drop(at[4][50:60])
    result = fit(episodes, genetic=QUICK)
    assert result.drivers["episode"].tolist() == [0]
    assert result.report[:6] == [
        "1 of 6 episodes dropped: missing, infinite or negative values",
        "1 of 6 episodes dropped: uneven sampling",
        "1 of 6 episodes dropped: shorter than 10 s",
        "1 of 6 episodes dropped: gap below 1 m",
        "1 of 6 episodes dropped: mean speed below 0.5 m/s",
        "1 of 6 episodes used for calibration",
    ]


def test_only_the_first_seconds_are_used(uneven_lengths):
    selection = Selection(max_duration_s=15.0)
    drivers = fit(observe(uneven_lengths, selection), genetic=QUICK).drivers
    assert drivers["samples"].tolist() == [151, 151, 151]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda table: table.drop(columns="gap_m"), "gap_m"),
        (lambda table: table.iloc[:0], "no rows"),
        (lambda table: table.assign(gap_m="x"), "'gap_m' is not numeric"),
        (lambda table: table.assign(time_s=1.0), "does not advance"),
        (lambda table: table.assign(gap_m=0.2), "gap below 1 m"),
        (lambda table: table.assign(gap_m=np.nan), "missing"),
    ],
)
def test_bad_tables_end_in_one_clear_error(change, message, uneven_lengths):
    with pytest.raises(DataError, match=message):
        fit(change(uneven_lengths), genetic=QUICK)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"mode": "locl"}, "local"),
        ({"bounds": {"speed": [1, 2]}}, "speed"),
        ({"bounds": {"time_gap": [2, 1]}}, "time_gap"),
        ({"bounds": {"time_gap": [0, 1]}}, "time_gap"),
        ({"mode": "global", "choose_constants": True}, "choose_constants"),
    ],
)
def test_bad_settings_end_in_one_clear_error(settings, message, uneven_lengths):
    with pytest.raises(ConfigError, match=message):
        fit(uneven_lengths, **settings)


@pytest.mark.parametrize("limits", [{"min_gap_m": -1.0}, {"max_duration_s": 5.0}])
def test_bad_selection_is_refused(limits):
    with pytest.raises(ConfigError, match="selection"):
        Selection(**limits)


@pytest.mark.parametrize("modes", [[], ["local", "local"], ["both"]])
def test_bad_modes_are_refused(modes):
    with pytest.raises(ConfigError, match="mode"):
        Calibrator(modes=modes)


def test_calibrator_puts_both_modes_side_by_side(uneven_lengths):
    calibrator = Calibrator(["local", "global"], local_genetic=QUICK, global_genetic=QUICK)
    result = calibrator(uneven_lengths)
    assert result.drivers["mode"].tolist() == ["local"] * 3 + ["global"] * 3
    assert result.report[0] == "3 of 3 episodes used for calibration"
    assert sum(line.startswith("global: RMSPE of 3 drivers") for line in result.report) == 1


def test_progress_is_reported(uneven_lengths):
    seen = []
    fit(uneven_lengths, genetic=QUICK, progress=lambda *state: seen.append(state[:2]))
    assert seen == [(1, 2), (2, 2)]


def test_real_drivers_reach_the_reference_errors(shared_data):
    episodes = observe(pd.read_parquet(shared_data / "i80_pairs.parquet"))
    assert episodes.count == 249
    start = time.process_time()
    local = fit(episodes).drivers
    seconds = time.process_time() - start
    free = fit(episodes, "global").drivers
    assert local["rmspe"].mean() <= 0.095
    assert free["rmspe"].mean() <= 0.082
    assert seconds < 10.0
    assert 0.3 < local["desired_speed_at_bound"].mean() < 0.45
