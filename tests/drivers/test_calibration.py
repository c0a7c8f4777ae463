"""Calibration: right errors, known drivers recovered, real drivers fitted, bad tables refused."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import pytest
import torch
from helpers import check_refused, compose, slow_but, wavy_profiles

from lcc_rl.drivers import kernel
from lcc_rl.drivers.calibrator import Calibration, Calibrator
from lcc_rl.drivers.fit_error import FitError
from lcc_rl.drivers.genetic import GeneticSettings
from lcc_rl.drivers.observed import Selection, observe
from lcc_rl.drivers.parameters import DEFAULT_BOUNDS, fitted
from lcc_rl.drivers.population import from_table
from lcc_rl.envs import build_env
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.functional import machine_code
from lcc_rl.functional.driver_models import (
    PARAMETERS,
    DriverConstants,
    Parameter,
    simulate_follower,
)
from lcc_rl.functional.laws import LAWS

QUICK = GeneticSettings(population=8, generations=2, founders=1)
EXPONENT = ("idm", {"exponent": 2.5})
EACH = pytest.mark.parametrize("model", list(LAWS))
KNOWN: dict[str, dict[str, float]] = {
    "idm": {"acceleration": 1.8, "deceleration": 2.5, "min_gap": 3.0},
    "ovm": {"sensitivity": 2.2, "form": 0.8, "min_gap": 3.0},
    "fvdm": {"sensitivity": 0.6, "form": 1.0, "min_gap": 3.0, "speed_gain": 0.8},
    "gipps": {"acceleration": 1.4, "deceleration": 2.5, "leader_deceleration": 2.8, "min_gap": 3.0},
}


def fit(episodes: Any, mode: str = "local", seed: int = 0, **settings: Any) -> Calibration:
    return Calibrator(modes=[mode], **settings)(episodes, seed=seed)


def quick(episodes: Any, **settings: Any) -> Calibration:
    return fit(episodes, local_genetic=QUICK, **settings)


def random_candidates(model: str, *shape: int) -> torch.Tensor:
    """Parameters of a model within the bounds, ``[*shape, names]``."""
    names = fitted("global", model)
    low, high = torch.tensor([DEFAULT_BOUNDS[name] for name in names]).double().unbind(-1)
    share = torch.rand(*shape, len(names), generator=torch.Generator().manual_seed(1)).double()
    return low + share * (high - low)


def reference_measures(observed, candidates, model, constants) -> dict[str, torch.Tensor]:
    """The definitions, episode by episode, with the plain simulation."""
    names = fitted("global", model)
    found = {
        name: torch.zeros(candidates.shape[:2]).double()
        for name in ("speed_rmspe", "gap_rmse", "gap_nrmse")
    }
    for row, samples in enumerate(observed.samples):
        truth, gaps = observed.follower_speed[:samples, row], observed.gaps[:samples, row]
        for column, values in enumerate(candidates[row]):
            own = dict(zip(names, values, strict=True))
            speed, gap, _ = simulate_follower(
                observed.leader_speed[:samples, row],
                *(truth[0], gaps[0], own.pop("desired_speed"), own.pop("time_gap")),
                constants.with_(**own),
                observed.time_step,
            )
            off, apart = (speed - truth).square(), (gap - gaps).square()
            found["speed_rmspe"][row, column] = (off.sum() / truth.square().sum()).sqrt()
            found["gap_rmse"][row, column] = apart.mean().sqrt()
            found["gap_nrmse"][row, column] = (apart.sum() / gaps.square().sum()).sqrt()
    return found


@pytest.mark.parametrize("compiled", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("model", "more"), slow_but([("gipps", {}), EXPONENT], [*((x, {}) for x in LAWS), EXPONENT])
)
def test_errors_are_those_of_the_plain_simulation(model, more, compiled, uneven_lengths):
    observed, names = observe(uneven_lengths), fitted("global", model)
    constants, candidates = LAWS[model](**more), random_candidates(model, 3, 6)
    expected = reference_measures(observed, candidates, model, constants)
    expected["both"] = expected["speed_rmspe"] + expected["gap_nrmse"]
    for objective, values in expected.items():
        error = FitError(observed, constants, names, objective)
        error.compiled = compiled
        torch.testing.assert_close(error(candidates), values, rtol=1e-9, atol=1e-9)


def test_a_cache_that_cannot_be_read_costs_a_compilation_and_no_result(
    uneven_lengths, monkeypatch, caplog
):
    def damaged(*arguments):
        raise EOFError("Ran out of input")

    def njit(cache=False, **how):
        return (lambda function: damaged) if cache else numba_njit(**how)

    numba_njit = machine_code.numba.njit
    observed, candidates = observe(uneven_lengths), random_candidates("idm", 3, 6)
    error = FitError(observed, LAWS["idm"](), fitted("global", "idm"))
    expected = error(candidates)
    monkeypatch.setattr(machine_code.numba, "njit", njit)
    monkeypatch.setattr(kernel, "kept", cache(machine_code.kept.__wrapped__))
    with caplog.at_level("INFO", logger="lcc_rl"):
        for _ in range(2):
            assert torch.equal(error(candidates), expected)
    assert caplog.text.count("for this run only") == 1


@EACH
def test_both_simulations_agree_in_single_precision_and_on_what_is_no_number(model, uneven_lengths):
    observed = observe(uneven_lengths).to("cpu", torch.float32)
    names, candidates = fitted("global", model), random_candidates(model, 3, 300).float()
    for at in range(len(names)):
        candidates[1, at, at] = np.nan
    found = []
    for compiled in (True, False):
        error = FitError(observed, LAWS[model](), names)
        error.compiled = compiled
        found.append(error(candidates))
    torch.testing.assert_close(*found, rtol=1e-3, atol=1e-4, equal_nan=True)
    lost = torch.zeros(found[0].shape, dtype=torch.bool)
    lost[1, : len(names)] = True
    assert torch.equal(found[0].isnan(), lost)


@EACH
def test_known_drivers_are_recovered(model, known_drivers, make_episodes):
    speeds, gaps = (known_drivers[name].tolist()[:8] for name in ("desired_speed", "time_gap"))
    episodes = make_episodes(speeds, gaps, LAWS[model](**KNOWN[model]), model=model)
    local = fit(episodes, constants=KNOWN[model], model=model, objective="gap_rmse").drivers
    assert (local["desired_speed_mps"] / speeds - 1.0).abs().median() < 0.01
    assert (local["time_gap_s"] / gaps - 1.0).abs().median() < 0.01
    assert local["rmspe"].max() < 0.01
    assert not local["desired_speed_at_bound"].any()


@pytest.mark.parametrize("model", slow_but(["fvdm"], LAWS))
def test_all_parameters_of_known_drivers_are_recovered(model, known_drivers, make_episodes):
    speeds, gaps = (known_drivers[name].tolist()[:8] for name in ("desired_speed", "time_gap"))
    episodes = make_episodes(speeds, gaps, LAWS[model](**KNOWN[model]), model=model)
    free = fit(episodes, "global", model=model).drivers
    assert free["rmspe"].median() < 1e-4
    assert (free["time_gap_s"] / gaps - 1.0).abs().median() < 0.01


def test_the_equilibrium_gap_is_that_at_the_recorded_speed(uneven_lengths):
    rows = quick(uneven_lengths).drivers
    seen = uneven_lengths.groupby("episode")[["follower_speed_mps", "gap_m"]].mean()
    np.testing.assert_allclose(rows[["mean_speed_mps", "mean_gap_m"]], seen)
    v0, headway, speed = (rows[x] for x in ("desired_speed_mps", "time_gap_s", "mean_speed_mps"))
    longer = (2.0 + speed * headway) / (1.0 - (speed / v0) ** 4).clip(lower=1e-6) ** 0.5
    expected = np.minimum(longer, 4.0 + 3.0 * speed)
    np.testing.assert_allclose(rows["equilibrium_gap_m"], expected)
    assert (rows["equilibrium_gap_m"] > 2.0 + speed * headway).any()


def test_gaps_that_speeds_do_not_tell_are_named(make_episodes):
    # Noise of the gap, none of the speed.
    episodes = make_episodes([40.0], [1.2])
    noise = np.random.default_rng(0).normal(1.0, 0.2, len(episodes))
    episodes["gap_m"] *= noise
    named = {
        aim: any(
            "calibration.objective=both" in line for line in fit(episodes, objective=aim).report
        )
        for aim in ("speed_rmspe", "both")
    }
    assert named == {"speed_rmspe": True, "both": False}
    episodes["gap_m"] = make_episodes([40.0], [1.2])["gap_m"] * np.where(noise > 1, 3.0, 0.5)
    jumps = " ".join(fit(episodes, objective="both").report)
    assert re.search(r"gaps are off by \d+ %, speeds by .*: are they to one leader", jumps)
    clean = fit(make_episodes([40.0], [1.2])).report
    assert not any("calibration.objective=both" in line for line in clean)


def test_rows_keep_the_order_and_identity_of_the_input(uneven_lengths):
    both = Calibrator(modes=["local", "global"], local_genetic=QUICK, global_genetic=QUICK)
    seen: list[tuple[int, int]] = []
    found = both(uneven_lengths, progress=lambda *state: seen.append(state[:2]))
    drivers = found.drivers
    assert drivers["mode"].tolist() == ["local"] * 3 + ["global"] * 3
    assert drivers["episode"].tolist() == [0, 1, 2] * 2
    assert drivers["follower_id"].tolist() == [100, 101, 102] * 2
    assert drivers["samples"].tolist() == [238, 401, 315] * 2
    assert drivers.columns.tolist() == [
        *("episode", "recording", "follower_id", "leader_id"),
        *(PARAMETERS[name].column for name in fitted("global")),
        *("mean_speed_mps", "mean_gap_m", "equilibrium_gap_m"),
        *("rmspe", "gap_rmse_m", "gap_nrmse", "samples"),
        *(f"{name}_at_bound" for name in fitted("global")),
        *("mode", "model"),
        *(f"{PARAMETERS[x].column}_{end}" for end in ("low", "high") for x in fitted("local")),
        *(f"{PARAMETERS[x].column}_{end}" for end in ("low", "high") for x in fitted("global")[2:]),
    ]
    assert seen == [(1, 2), (2, 2)] * 2
    renamed = uneven_lengths.rename(columns={"episode": "event", "recording": "period"})
    pd.testing.assert_frame_equal(both(renamed).drivers, drivers)


def test_equal_seeds_give_equal_drivers_and_none_depends_on_the_others(uneven_lengths):
    first, again, other = (quick(uneven_lengths, seed=seed).drivers for seed in (3, 3, 4))
    pd.testing.assert_frame_equal(first, again)
    assert not first.equals(other)
    alone = quick(uneven_lengths[uneven_lengths["episode"] == 2], seed=3).drivers
    pd.testing.assert_series_equal(alone.iloc[0], first.iloc[2], check_names=False)


def test_a_driver_who_never_drives_freely_is_flagged(make_episodes):
    episodes = make_episodes([35.0, 20.0], [1.2, 1.2])
    drivers = fit(episodes, bounds={"desired_speed": [5.0, 30.0]}).drivers
    assert drivers["desired_speed_at_bound"].tolist() == [True, False]
    assert not drivers[["acceleration_at_bound", "min_gap_at_bound"]].any(axis=None)


def test_unfit_episodes_are_dropped_and_counted(make_episodes):
    episodes = make_episodes([20.0] * 6, [1.0] * 6, seconds=[20.0] * 5 + [5.0])
    at = {number: episodes.index[episodes["episode"] == number] for number in range(6)}
    episodes.loc[at[1][50], "gap_m"] = 0.5
    episodes.loc[at[2][50], "follower_speed_mps"] = np.nan
    episodes.loc[at[3], ["follower_speed_mps", "leader_speed_mps"]] = 0.0
    episodes = episodes.drop(at[4][50:60])
    result = quick(episodes, selection=Selection(max_duration_s=15.0, low_gaps="drop"))
    assert result.drivers["episode"].tolist() == [0]
    assert result.drivers["samples"].tolist() == [151]
    counted = [line for line in result.report if line.startswith("1 of 6 episodes dropped: ")]
    assert len(counted) == 5
    cut = observe(episodes, Selection(max_duration_s=15.0))
    assert cut.report[-1].startswith("fits the first 15 s of each, 80 % of the samples (cal")
    whole = observe(episodes, Selection(max_duration_s=None))
    assert not any("fits the first" in line for line in whole.report)
    assert dict(zip(cut.identity["episode"], cut.samples, strict=True)) == {0: 151, 1: 150}
    assert cut.gaps[0, 1] == episodes["gap_m"][at[1][51]]
    assert "1 of 6 episodes cut where the gap is below 1 m, the first: recording" in cut.report[0]


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


@dataclass(frozen=True)
class Helly(DriverConstants):
    """Helly's linear model: a law of one's own, with a parameter that no other has."""

    gap_gain: float = 0.1
    speed_gain: float = 0.5

    own: ClassVar = {
        "gap_gain": Parameter("gap_gain_hz2", "gap gain [1/s²]", (0.01, 1.0), (0.001, 10.0))
    }

    def wish(self, speed, gap, approach_rate, desired_speed, time_gap):
        following = self.gap_gain * (gap - self.min_gap - time_gap * speed)
        following = following - self.speed_gain * approach_rate
        return torch.minimum(following, self.speed_gain * (desired_speed - speed))

    def steady_gap(self, speed, desired_speed, time_gap):
        return self.min_gap + time_gap * speed


class Sorted(Helly):
    """The same law by an operation that has no counterpart in machine code."""

    def wish(self, *motion):
        return super().wish(*motion).unsqueeze(-1).sort(-1).values.squeeze(-1)


def test_a_model_of_ones_own_is_calibrated_and_drives(make_episodes):
    known, name = Helly(gap_gain=0.2, speed_gain=0.8), f"{__name__}.Helly"
    episodes = make_episodes([15.0, 25.0], [1.0, 1.5], known, [30.0] * 2)
    settings = {"model": name, "constants": {"gap_gain": 0.2, "speed_gain": 0.8}}
    drivers = fit(episodes, objective="gap_rmse", **settings).drivers
    assert drivers["desired_speed_mps"].tolist() == pytest.approx([15.0, 25.0], rel=0.01)
    assert drivers["time_gap_s"].tolist() == pytest.approx([1.0, 1.5], rel=0.01)
    assert (drivers["gap_gain_hz2"] == 0.2).all()
    quiet = "scenario.controllers.human.noise=0"
    cfg = compose("alcc", "controller@scenario.controllers.human=calibrated", quiet)
    data = build_env(cfg, wavy_profiles(), from_table(drivers), 4).rollout(20)
    speed, gap, rate = (data["vehicles", x][..., 1:, :] for x in ("speed", "gap", "relative_speed"))
    own = (data["human", "desired_speed"], data["human", "desired_time_gap"])
    wanted = known(speed, gap, -rate, *own)
    torch.testing.assert_close(data["next", "human", "command"], wanted)


class Redeclared(Helly):
    """A law that describes a parameter of the shipped models anew."""

    own: ClassVar = {**Helly.own, "speed_gain": Parameter("gain_hz", "λ", (0.05, 2.0), (0.01, 9.0))}


def test_a_parameter_of_shipped_models_is_not_described_anew(make_episodes):
    with pytest.raises(
        ConfigError, match=r"Redeclared\.own names 'speed_gain' .*bounds\.speed_gain=\["
    ):
        fit(make_episodes([15.0], [1.0]), model=f"{__name__}.Redeclared")


SEEN: dict[str, float] = {"last": 0.0}


class Mindful(Helly):
    """A law that keeps the last approach rate in a variable of its module."""

    def wish(self, speed, gap, approach_rate, *own):
        SEEN["last"] = 0.9 * SEEN["last"] + 0.1 * float(approach_rate.mean())
        return super().wish(speed, gap, approach_rate + SEEN["last"], *own)


def extended(name: str, wish, **attributes) -> type[Helly]:
    return type(name, (Helly,), {"wish": wish, "__module__": __name__, **attributes})


Mixing = extended("Mixing", lambda self, v, *more: Helly.wish(self, v, *more) - v.mean())
Smoothing = extended("Smoothing", lambda self, *motion: (Helly.wish(self, *motion), motion[2]))
Declaring = extended("Declaring", Smoothing.wish, remembers=("smooth",))


def test_a_calibrated_law_is_a_function_of_the_present() -> None:
    cases = {
        "Mindful": "Mindful remembers in its variable 'SEEN', which .*; evaluate one with memory",
        "Mixing": "Mixing gives an episode other acceleration alone",
        "Smoothing": "Smoothing: wish must return one tensor",
        "Declaring": "Declaring has remembers: a calibrated law .* as a DriverModel",
    }
    check_refused(lambda x: Calibrator(model=f"{__name__}.{x}"), [*cases.items()], ConfigError)


def test_a_law_without_machine_code_is_simulated_by_tensors(uneven_lengths):
    observed, candidates = observe(uneven_lengths), torch.tensor([[20.0, 1.0]]).double()
    found = []
    for law in (Helly(), Sorted()):
        error = FitError(observed, law, ("desired_speed", "time_gap"))
        found.append(error(candidates.expand(3, 5, 2)))
    assert not error.compiled
    torch.testing.assert_close(*found)


def test_the_part_held_out_is_predicted_and_has_no_say_in_the_fit(make_episodes):
    episodes = make_episodes([20.0, 25.0], [1.0, 1.5])
    whole = fit(episodes, holdout=0.3).drivers
    # The free drive that tells v0 begins at 40 % of the episode.
    assert whole["rmspe_out"].max() < 0.02
    changed = episodes.copy()
    late = changed.groupby("episode")["time_s"].rank(pct=True) > 0.75
    changed.loc[late, "follower_speed_mps"] += 1.0
    other = fit(changed, holdout=0.3).drivers
    same = ["desired_speed_mps", "time_gap_s", "rmspe", "gap_rmse_m", "samples"]
    pd.testing.assert_frame_equal(whole[same], other[same])
    assert (other["rmspe_out"] != whole["rmspe_out"]).all()


def test_bad_tables_end_in_one_clear_error(uneven_lengths) -> None:
    check_refused(
        lambda change: quick(change(uneven_lengths)),
        [
            (lambda table: table.drop(columns="gap_m"), "gap_m"),
            (lambda table: table.iloc[:0], "no rows"),
            (lambda table: table.assign(gap_m="x"), "'gap_m' is not numeric"),
            (lambda table: table.assign(time_s=1.0), "does not advance"),
            (lambda table: table.assign(gap_m=0.2), "gap below 1 m"),
        ],
        DataError,
    )


def test_bad_settings_are_named() -> None:
    check_refused(
        lambda settings: Calibrator(**settings),
        [
            ({"modes": []}, "modes"),
            ({"model": "krauss"}, "model"),
            ({"bounds": {"time_gap": [2.0, 1.0]}}, "time_gap"),
            ({"bounds": {"time_gap": [0.0, 1.0]}}, "time_gap"),
            ({"model": "ovm", "constants": {"acceleration": 1.0}}, "acceleration"),
            ({"selection": {"min_gap_m": -1.0}}, "min_gap_m"),
            ({"selection": {"max_duration_s": 5.0}}, "max_duration_s"),
            ({"local_genetic": {"population": 3}}, "population"),
        ],
        ConfigError,
    )


def test_real_drivers_reach_the_reference_errors(shared_data):
    pairs = pd.read_parquet(shared_data / "i80_pairs.parquet")
    observed = observe(pairs, Selection(low_gaps="drop"))
    assert observed.count == 249
    start = time.process_time()
    local = fit(observed).drivers
    assert time.process_time() - start < 10.0
    assert local["rmspe"].mean() <= 0.095
    assert fit(observed, "global").drivers["rmspe"].mean() <= 0.082
    assert 0.3 < local["desired_speed_at_bound"].mean() < 0.45


@pytest.mark.slow
def test_real_drivers_by_every_model(shared_data):
    pairs = pd.read_parquet(shared_data / "i80_pairs.parquet")
    observed = observe(pairs, Selection(low_gaps="drop"))
    means = {}
    for model in LAWS:
        drivers = fit(observed, "global", model=model, objective="gap_rmse", holdout=0.3).drivers
        means[model] = drivers[["gap_rmse_m", "gap_rmse_m_out"]].mean()
    assert means["fvdm"]["gap_rmse_m"] < 1.05
    assert means["fvdm"]["gap_rmse_m_out"] < 3.4
    assert means["idm"]["gap_rmse_m"] < 1.15
    assert all(mean["gap_rmse_m_out"] < 4.5 for mean in means.values())
