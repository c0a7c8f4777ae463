"""Calibration of every driver model: errors, known drivers, parts held out, tables, figures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from helpers import slow_but

from lcc_rl.data.episodes import ALIASES
from lcc_rl.drivers import fit_error
from lcc_rl.drivers.calibrator import Calibrator
from lcc_rl.drivers.fit import fit
from lcc_rl.drivers.fit_error import OBJECTIVES, FitError
from lcc_rl.drivers.genetic import GeneticSettings
from lcc_rl.drivers.observed import observe
from lcc_rl.drivers.parameters import COLUMNS, DEFAULT_BOUNDS, PLAUSIBLE, fitted
from lcc_rl.drivers.population import bootstrap, from_table, kde
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.figures.calibration import calibration_figure, joint_figure
from lcc_rl.functional.gipps import GippsConstants
from lcc_rl.functional.idm import IDMConstants, simulate_follower
from lcc_rl.functional.laws import LAWS
from lcc_rl.functional.ovm import FVDMConstants, OVMConstants

QUICK = GeneticSettings(population=8, generations=2, founders=1)
THOROUGH = GeneticSettings(population=128, generations=150, patience=20)
EACH = pytest.mark.parametrize("model", list(LAWS))
KNOWN = {
    "idm": IDMConstants(acceleration=1.8, deceleration=2.5, min_gap=3.0),
    "ovm": OVMConstants(sensitivity=2.2, form=0.8, min_gap=3.0),
    "fvdm": FVDMConstants(sensitivity=0.6, form=1.0, min_gap=3.0, speed_gain=0.8),
    "gipps": GippsConstants(
        acceleration=1.4, deceleration=2.5, leader_deceleration=2.8, min_gap=3.0
    ),
}


def random_candidates(model: str, *shape: int) -> torch.Tensor:
    """Parameters of a model within the bounds, ``[*shape, names]``."""
    names = fitted("global", model)
    low, high = torch.tensor([DEFAULT_BOUNDS[name] for name in names]).double().unbind(-1)
    share = torch.rand(*shape, len(names), generator=torch.Generator().manual_seed(1)).double()
    return low + share * (high - low)


def reference_measures(observed, candidates, model) -> dict[str, torch.Tensor]:
    """The definitions, episode by episode, with the plain simulation."""
    law, names = LAWS[model], fitted("global", model)
    found = {name: torch.zeros(candidates.shape[:2]).double() for name in OBJECTIVES[:3]}
    for row, samples in enumerate(observed.samples):
        truth, gaps = observed.follower_speed[:samples, row], observed.gaps[:samples, row]
        for column, values in enumerate(candidates[row]):
            own = dict(zip(names, values, strict=True))
            speed, gap, _ = simulate_follower(
                observed.leader_speed[:samples, row],
                *(truth[0], gaps[0], own.pop("desired_speed"), own.pop("time_gap")),
                law.constants().with_(**own),
                observed.time_step,
                law=law,
            )
            off, apart = (speed - truth).square(), (gap - gaps).square()
            found["speed_rmspe"][row, column] = (off.sum() / truth.square().sum()).sqrt()
            found["gap_rmse"][row, column] = apart.mean().sqrt()
            found["gap_nrmse"][row, column] = (apart.sum() / gaps.square().sum()).sqrt()
    return found


@EACH
@pytest.mark.parametrize("way", ["numba", "torch"])
def test_errors_are_those_of_the_plain_simulation(model, way, uneven_lengths, monkeypatch):
    if way == "numba":
        pytest.importorskip("numba")
    else:
        monkeypatch.setattr(fit_error, "kernel_of", lambda name: None)
    observed, names = observe(uneven_lengths), fitted("global", model)
    candidates = random_candidates(model, 3, 6)
    expected = reference_measures(observed, candidates, model)
    got = FitError(observed, LAWS[model].constants(), names, model).measures(candidates)
    assert set(got) == set(expected)
    for name, values in expected.items():
        torch.testing.assert_close(got[name], values, rtol=1e-9, atol=1e-9)
    expected["both"] = expected["speed_rmspe"] + expected["gap_nrmse"]
    for objective in OBJECTIVES:
        error = FitError(observed, LAWS[model].constants(), names, model, objective)
        torch.testing.assert_close(error(candidates), expected[objective], rtol=1e-9, atol=1e-9)


@EACH
def test_numba_and_torch_agree_in_single_precision(model, uneven_lengths, monkeypatch):
    pytest.importorskip("numba")
    observed = observe(uneven_lengths).to("cpu", torch.float32)
    names, candidates = fitted("global", model), random_candidates(model, 3, 300).float()
    found = []
    for kernel in (fit_error.kernel_of, lambda name: None):
        monkeypatch.setattr(fit_error, "kernel_of", kernel)
        found.append(FitError(observed, LAWS[model].constants(), names, model)(candidates))
    torch.testing.assert_close(*found, rtol=1e-3, atol=1e-4)


@EACH
@pytest.mark.parametrize("way", ["numba", "torch"])
def test_what_is_no_number_stays_so(model, way, uneven_lengths, monkeypatch):
    if way == "torch":
        monkeypatch.setattr(fit_error, "kernel_of", lambda name: None)
    names, candidates = fitted("global", model), random_candidates(model, 3, 8)
    for at in range(len(names)):
        candidates[1, at, at] = np.nan
    observed = observe(uneven_lengths)
    error = FitError(observed, LAWS[model].constants(), names, model)(candidates)
    assert error[1, : len(names)].isnan().all()
    assert error[1, len(names) :].isfinite().all()
    assert error[[0, 2]].isfinite().all()


@EACH
@pytest.mark.parametrize("objective", ["speed_rmspe", "gap_rmse"])
def test_known_drivers_are_recovered(model, objective, known_drivers, make_episodes):
    speeds, gaps = (known_drivers[name].tolist()[:8] for name in ("desired_speed", "time_gap"))
    episodes = make_episodes(speeds, gaps, KNOWN[model], model=model)
    local = fit(episodes, constants=KNOWN[model], model=model, objective=objective).drivers
    assert (local["desired_speed_mps"] / speeds - 1.0).abs().median() < 0.01
    assert (local["time_gap_s"] / gaps - 1.0).abs().median() < 0.01
    assert local["rmspe"].max() < 0.01


@pytest.mark.parametrize("model", slow_but(["fvdm"], LAWS))
def test_all_parameters_of_known_drivers_are_recovered(model, known_drivers, make_episodes):
    speeds, gaps = (known_drivers[name].tolist()[:8] for name in ("desired_speed", "time_gap"))
    episodes = make_episodes(speeds, gaps, KNOWN[model], model=model)
    free = fit(episodes, "global", model=model, genetic=THOROUGH).drivers
    assert free["rmspe"].median() < 0.001
    assert (free["desired_speed_mps"] / speeds - 1.0).abs().median() < 0.01
    assert (free["time_gap_s"] / gaps - 1.0).abs().median() < 0.08
    for name in {"acceleration", "sensitivity", "speed_gain"} & set(LAWS[model].shared):
        expected = getattr(KNOWN[model], name)
        assert free[COLUMNS[name]].median() == pytest.approx(expected, rel=0.05), name
    if model in ("idm", "ovm"):  # a larger s0 and a smaller T are hard to tell apart elsewhere
        assert free["min_gap_m"].median() == pytest.approx(3.0, rel=0.01)


@EACH
def test_another_model_fits_worse(model, make_episodes):
    episodes = make_episodes([20.0, 25.0], [1.0, 1.5], KNOWN[model], model=model)
    errors = {other: fit(episodes, "global", model=other).drivers["rmspe"] for other in LAWS}
    means = {other: error.mean() for other, error in errors.items()}
    assert min(means, key=means.get) == model


def test_an_objective_is_minimised_by_its_own_fit(make_episodes):
    episodes = make_episodes([20.0, 25.0, 30.0], [1.0, 1.4, 1.8], KNOWN["gipps"], model="gipps")
    found = {x: fit(episodes, objective=x).drivers for x in OBJECTIVES}
    for objective, column in (("speed_rmspe", "rmspe"), ("gap_rmse", "gap_rmse_m")):
        best = min(found, key=lambda x: found[x][column].mean())
        assert found[objective][column].mean() <= found[best][column].mean() * 1.01
    total = {x: (drivers["rmspe"] + drivers["gap_nrmse"]).mean() for x, drivers in found.items()}
    assert total["both"] <= min(total.values()) * 1.01


def test_episodes_are_cut_where_the_holdout_begins(uneven_lengths):
    observed = observe(uneven_lengths)
    first, last = observed.split(0.3)
    assert (first.samples + last.samples == observed.samples + 1).all()
    assert last.samples.tolist() == [int(0.3 * n) + 1 for n in observed.samples]
    for name in ("leader_speed", "follower_speed", "gaps"):
        whole = getattr(observed, name)
        for column, samples in enumerate(observed.samples):
            cut = first.samples[column] - 1
            head, tail = getattr(first, name)[:, column], getattr(last, name)[:, column]
            assert torch.equal(head[: cut + 1], whole[: cut + 1, column])
            assert torch.equal(tail[: samples - cut], whole[cut:samples, column])
            assert not head[cut + 1 :].any()
            assert not tail[samples - cut :].any()


def test_the_part_held_out_has_no_say_in_the_fit(uneven_lengths):
    settings = {"genetic": QUICK, "holdout": 0.4}
    whole = fit(uneven_lengths, **settings).drivers
    changed = uneven_lengths.copy()
    late = changed.groupby("episode")["time_s"].rank(pct=True) > 0.65
    changed.loc[late, "follower_speed_mps"] += 1.0
    other = fit(changed, **settings).drivers
    same = ["desired_speed_mps", "time_gap_s", "rmspe", "gap_rmse_m", "samples"]
    pd.testing.assert_frame_equal(whole[same], other[same])
    assert (other["rmspe_out"] != whole["rmspe_out"]).all()
    names = [f"{name}_out" for name in ("rmspe", "gap_rmse_m", "gap_nrmse", "samples")]
    assert set(names) <= set(whole.columns)
    assert not set(names) & set(fit(uneven_lengths, genetic=QUICK).drivers.columns)


def test_a_driver_of_the_model_is_predicted_too(make_episodes):
    episodes = make_episodes([20.0, 25.0], [1.0, 1.5])
    result = fit(episodes, holdout=0.3)
    # The free drive that tells v0 begins at 40 % of the episode.
    assert result.drivers["rmspe_out"].max() < 0.02
    assert any(line.startswith("held out: RMSPE") for line in result.report)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"model": "krauss"}, "driver model 'krauss'; valid: fvdm, gipps, idm, ovm"),
        ({"objective": "gap"}, "objective 'gap'"),
        ({"holdout": 1.0}, r"holdout must lie in \[0, 0.9\]"),
        ({"model": "ovm", "constants": IDMConstants()}, "constants of ovm expected"),
    ],
)
def test_bad_settings_end_in_one_clear_error(settings, message, uneven_lengths):
    with pytest.raises(ConfigError, match=message):
        fit(uneven_lengths, **settings)
    if "constants" not in settings:
        with pytest.raises(ConfigError, match=message):
            Calibrator(**settings)


def test_a_holdout_without_a_step_is_refused(uneven_lengths):
    with pytest.raises(DataError, match=r"holdout 0\.001 of an episode of 238 samples"):
        fit(uneven_lengths, genetic=QUICK, holdout=0.001)


def test_constants_of_another_model_are_refused():
    assert Calibrator(constants={"sensitivity": None}).shared() == IDMConstants()
    own = Calibrator(model="ovm", constants={"sensitivity": 2.0, "acceleration": None})
    assert own.shared() == OVMConstants(sensitivity=2.0)
    with pytest.raises(ConfigError, match="constant of model ovm 'acceleration'"):
        Calibrator(model="ovm", constants={"acceleration": 1.0})


def test_constants_are_chosen_for_every_model(make_episodes):
    episodes = make_episodes([20.0, 25.0], [1.0, 1.4], KNOWN["fvdm"], [20.0] * 2, "fvdm")
    given = fit(episodes, model="fvdm")
    chosen = fit(episodes, model="fvdm", choose_constants=True)
    assert chosen.drivers["rmspe"].mean() < 0.5 * given.drivers["rmspe"].mean()
    assert chosen.drivers["speed_gain_hz"].nunique() == 1
    assert any("constants chosen" in line and "speed_gain_hz" in line for line in chosen.report)


@pytest.fixture(scope="module")
def table(uneven_lengths) -> pd.DataFrame:
    """The same three drivers, calibrated by each model."""
    parts = [fit(uneven_lengths, "global", genetic=QUICK, model=x).drivers for x in LAWS]
    return pd.concat(parts, ignore_index=True)


def test_a_table_of_several_models_is_a_population(table, tmp_path):
    table.to_parquet(tmp_path / "drivers.parquet")
    population = bootstrap(tmp_path / "drivers.parquet")
    assert population.models == tuple(np.repeat(list(LAWS), 3))
    assert len(set(population.ids)) == 3
    own = population.parameters()
    assert set(own) == {*COLUMNS}
    gipps = table["model"] == "gipps"
    expected = table["leader_deceleration_mps2"].where(gipps)
    np.testing.assert_allclose(own["leader_deceleration"], expected, rtol=1e-6)
    assert population.constants == IDMConstants()
    with pytest.raises(ConfigError, match="sensitivity"):
        replace(population, own={**population.own, "sensitivity": torch.full((12,), 99.0)})


@EACH
def test_each_model_has_its_summary_figures_and_density(model, table, tmp_path):
    part = table[table["model"] == model]
    assert model.upper() in calibration_figure(part).get_suptitle()
    assert joint_figure(part) is not None
    jitter = pd.concat([part.select_dtypes("number") * x for x in (1.0, 1.01, 0.98, 1.03)])
    columns = [COLUMNS[name] for name in LAWS[model].parameters]
    many = jitter[columns].reset_index(drop=True)
    rng = np.random.default_rng(0)
    many = many * rng.uniform(0.97, 1.03, many.shape)
    many.assign(model=model).to_parquet(tmp_path / "drivers.parquet")
    drawn = kde(tmp_path / "drivers.parquet", drivers=20)
    assert set(drawn.models or ("idm",)) == {model}
    assert set(drawn.parameters()) == set(LAWS[model].parameters)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.assign(model="wiedemann"), "row 0, column 'model'.*got 'wiedemann'"),
        (lambda t: t.drop(columns="speed_gain_hz"), "missing.*speed_gain_hz"),
        (lambda t: t.assign(form=None).astype({"form": float}), "row 3, column 'form'"),
        (lambda t: t.assign(sensitivity_hz=99.0), "row 3, column 'sensitivity_hz'.*0.001 to 20"),
    ],
)
def test_bad_tables_of_models_end_in_one_clear_error(change, message, table):
    with pytest.raises(DataError, match=message):
        from_table(change(table))


def test_a_density_needs_one_model(table, tmp_path):
    table.to_parquet(tmp_path / "drivers.parquet")
    with pytest.raises(DataError, match="expected drivers of one model"):
        kde(tmp_path / "drivers.parquet")


def test_every_parameter_has_a_column_and_bounds_within_what_is_plausible():
    names = {name for law in LAWS.values() for name in law.parameters}
    assert names == set(COLUMNS) == set(DEFAULT_BOUNDS) == set(PLAUSIBLE)
    assert all(law.parameters[:2] == ("desired_speed", "time_gap") for law in LAWS.values())
    for name, (low, high) in DEFAULT_BOUNDS.items():
        assert PLAUSIBLE[name][0] <= low < high <= PLAUSIBLE[name][1]
    for law in LAWS.values():
        for name in law.shared:
            low, high = DEFAULT_BOUNDS[name]
            assert low <= getattr(law.constants(), name) <= high
    assert not set(COLUMNS.values()) & set(ALIASES)


@pytest.mark.slow
def test_real_drivers_by_every_model(shared_data):
    observed = observe(pd.read_parquet(shared_data / "i80_pairs.parquet"))
    means = {}
    for model in LAWS:
        drivers = fit(observed, "global", model=model, objective="gap_rmse", holdout=0.3).drivers
        means[model] = drivers[["gap_rmse_m", "gap_rmse_m_out"]].mean()
        assert len(drivers) == 249
    assert means["fvdm"]["gap_rmse_m"] < 1.05
    assert means["fvdm"]["gap_rmse_m_out"] < 3.4
    assert means["idm"]["gap_rmse_m"] < 1.15
    assert all(mean["gap_rmse_m_out"] < 4.5 for mean in means.values())
