"""Evaluation by episodes: paired, independent of the batch, and equal to a plain simulation."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
import torch
from helpers import POPULATION, compose, steady, string, wavy_profiles

from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.factory import build_agent
from lcc_rl.envs import Inputs, build_env
from lcc_rl.evaluation.comparison import stacked
from lcc_rl.evaluation.episodes import Episodes, Plan, evaluate
from lcc_rl.evaluation.foreign import GivenPolicy
from lcc_rl.evaluation.strategies import Strategy, baseline
from lcc_rl.functional.driver_models import simulate_follower
from lcc_rl.functional.power import motor_power

PROFILES = wavy_profiles().windows(100)
INPUTS = Inputs(PROFILES, PROFILES, POPULATION)


def strategy(variant: str, *overrides: str) -> Strategy:
    cfg = compose(variant, "scenario.horizon=100", *overrides)
    return Strategy(variant, cfg)


def run(variant: str, *overrides: str, drivers=5, batch_size=64, seed=1, sample_episodes=0):
    driven = strategy(variant, *overrides)
    return evaluate(driven, INPUTS, drivers, batch_size, seed, sample_episodes)


def test_batch_size_does_not_change_a_row() -> None:
    whole, _ = run("idm", batch_size=1000)
    parts, _ = run("idm", batch_size=7)
    # Up to the order of summation: vector and scalar loops round differently.
    pd.testing.assert_frame_equal(whole, parts, rtol=1e-5, atol=1e-5)


def test_scenario_b_equals_the_plain_simulation() -> None:
    rows, _ = run("direct", "scenario.controllers.human.noise=0")
    profile, driver, _ = Plan(len(PROFILES), len(POPULATION.time_gap), 5, 10_000).episodes(0)
    leader = torch.stack([PROFILES.record(i) for i in profile], dim=1)
    v0, gap = POPULATION.desired_speed[driver], POPULATION.time_gap[driver]
    start = POPULATION.constants.equilibrium_gap(leader[0], v0, gap)
    speed, _, acceleration = simulate_follower(
        leader, leader[0], start, v0, gap, POPULATION.constants, 0.1
    )
    energy = motor_power(speed[:-1], acceleration).sum(0) * 0.1 / 1e3
    torch.testing.assert_close(
        torch.tensor(rows["hdv_energy_kj"].to_numpy()), energy, rtol=1e-3, atol=0.05
    )


def test_the_human_baseline_draws_its_drivers_and_leaves_the_one_behind() -> None:
    cfg = strategy("alcc").cfg
    rows, one = (
        evaluate(baseline(cfg, name), INPUTS, 5, 64, 1)[0].set_index(["profile_id", "driver_id"])
        for name in ("human", "idm")
    )
    # One driver draws the same before everybody, drivers of the population do not.
    spread, none = (x.groupby("profile_id")["cav_energy_kj"].std() for x in (rows, one))
    assert spread.min() > 100.0 * none.max()
    assert (rows["time_gap_s"] == one["time_gap_s"]).all()


def test_what_the_leader_does_is_in_every_row_of_its_window() -> None:
    rows, _ = run("idm")
    speed = PROFILES.record(2)
    own = rows[rows["profile_id"] == 2]
    assert own["leader_speed_mps"].to_numpy() == pytest.approx(float(speed.mean()))
    # Over a window A2 is the path energy and what the last speed stores more than the first.
    drawn = float(motor_power(speed[:-1], speed.diff() / 0.1).sum()) * 1e-4
    path = own["leader_path_energy_kj"].iloc[0]
    linear = [float(1213 * v + 2484 * v**2 / 2 + 1.374 * v**3 / 3) * 1e-3 for v in speed[[0, -1]]]
    assert path == pytest.approx(drawn - (linear[1] - linear[0]), rel=0.03)


def test_what_many_automated_vehicles_do_is_added_up() -> None:
    # Two IDM drivers in the place of automated vehicles, and one of them: distances add up, and
    # what is safe is that of the worst.
    one, _ = run("idm", string("automated human"))
    two, _ = run("idm", string("(automated human)*2"))
    assert (two["cav_distance_m"] > 1.5 * one["cav_distance_m"]).all()
    assert (two["hdv_distance_m"] > 1.5 * one["hdv_distance_m"]).all()
    total = two["cav_energy_kj"] + two["hdv_energy_kj"]
    assert two["total_energy_kj"].to_numpy() == pytest.approx(total.to_numpy(), rel=1e-5)


def test_drawn_places_are_measured_by_role() -> None:
    # Two human drivers and one automated vehicle, wherever it is: about twice its distance.
    drawn, _ = run("idm", "scenario.string={size: 3, penetration: 0.34}")
    assert {"cav_energy_kj", "hdv_energy_kj", "total_energy_kj"} <= set(drawn)
    ratio = drawn["hdv_distance_m"] / drawn["cav_distance_m"]
    assert 1.7 < ratio.mean() < 2.3
    assert ratio.std() < 0.5


def test_a_warm_up_is_driven_and_not_counted() -> None:
    whole, _ = run("idm")
    late, steps = run("idm", "evaluation.warm_up=4", sample_episodes=1)
    first, _ = run("idm", "scenario.horizon=40")
    for name in ("cav_distance_m", "hdv_energy_kj", "vehicle_time_s", "cav_path_energy_kj"):
        assert (late[name] + first[name]).to_numpy() == pytest.approx(whole[name], rel=1e-4)
    assert (late["steps"] == 60).all()
    assert (late["min_gap_m"] >= whole["min_gap_m"]).all()
    assert (late["speed_overshoot_mps"] <= whole["speed_overshoot_mps"]).all()
    assert len(steps) == 60
    assert late["leader_speed_mps"].iloc[0] == pytest.approx(float(PROFILES.record(0)[40:].mean()))


def test_a_collision_ends_the_count_and_counts_in_the_warm_up() -> None:
    def rammed(warm_up: float) -> tuple[pd.DataFrame, pd.DataFrame]:
        cfg = compose("alcc", "scenario.horizon=100", f"evaluation.warm_up={warm_up}")
        rammer = steady(1.0, build_env(cfg, PROFILES, POPULATION, count))
        return evaluate(Strategy("rammer", cfg, rammer), INPUTS, 3, 64, 1, count)

    count = len(PROFILES) * 3
    whole, (rows, steps) = rammed(0)[0], rammed(9.5)
    assert (whole["duration_s"] < 10.0).all()
    assert (whole["min_ttc_s"] < 0.1).all()
    assert whole["collided"].all()
    assert rows["collided"].all()
    assert (rows["steps"] == 0).any()
    assert rows.loc[rows["steps"] == 0, ["min_gap_m", "total_energy_kj"]].isna().all(axis=None)
    assert len(steps) == rows["steps"].sum()  # of every episode, also of those without any
    # Integers stay integers where an episode, or another strategy, has none: files have one schema.
    direct = run("direct", sample_episodes=1)
    for own, other in zip((rows, steps), direct, strict=True):
        for table in (own, stacked([other, own]), stacked([own, pd.DataFrame()])):
            found = pa.Schema.from_pandas(table)
            integers = [name for name in own if name in ("steps", "brakings_below_2", "cav_place")]
            assert [found.field(name).type for name in integers] == [pa.int64()] * len(integers)


def test_a_learned_policy_has_the_mean_of_each_reward_term_and_other_rows_none() -> None:
    weights = {"safety": 0.5, "efficiency": 2.0, "hdv_energy": 3.0}
    words = [f"reward.terms.{name}.weight={weight}" for name, weight in weights.items()]
    cfg = strategy("alcc", *words).cfg
    driven = Strategy("alcc", cfg, shared_policy(build_agent(cfg, POPULATION).policy), 0)
    plain, _ = evaluate(driven, INPUTS, 5, 64, 1)
    assert not plain.columns.str.contains("mean_term").any()  # the setting is off
    cfg = cfg.with_(evaluation={"terms": True})
    driven = replace(driven, cfg=cfg)
    rows, _ = evaluate(driven, INPUTS, 5, 64, 1)
    pd.testing.assert_frame_equal(rows[plain.columns], plain, check_exact=True)
    for name in cfg.reward.terms:
        own, term = rows[f"mean_reward_{name}"], rows[f"mean_term_{name}"]
        np.testing.assert_allclose(own, cfg.reward.terms[name].settings["weight"] * term)
    # A term is −energy/scale of a step of 0.1 s: without a collision its sum is the energy.
    whole = rows[~rows["collided"]]
    power = -whole["mean_term_cav_energy"] * whole["steps"] * 20.0
    np.testing.assert_allclose(power, whole["cav_energy_kj"], rtol=1e-4, atol=1e-3)
    assert (rows["mean_term_efficiency"] < 0.0).any()
    assert not run("idm")[0].columns.str.contains("mean_term").any()


@pytest.mark.parametrize("variant", ["alcc", "constant_filtered"])
def test_machine_code_gives_the_same_rows(variant) -> None:
    cfg, found = strategy("alcc", "+filter=cbf").cfg, {}
    driven = (
        Strategy("alcc", cfg, shared_policy(build_agent(cfg, POPULATION).policy), 0)
        if variant == "alcc"
        else baseline(cfg, variant)
    )
    plan = Plan(len(PROFILES), len(POPULATION.time_gap), 5, 4)
    for rowwise in (False, True):
        played = Episodes(driven, INPUTS, plan, 1, compiled=False)
        played.player.rowwise = rowwise
        found[rowwise] = pd.concat(played.play(block)[0] for block in range(2))
    assert len(found[True]) > 4
    pd.testing.assert_frame_equal(found[False], found[True], rtol=1e-4, atol=1e-4)


def test_a_policy_with_a_memory_of_its_own_is_not_played_in_machine_code(monkeypatch) -> None:
    monkeypatch.setattr("lcc_rl.evaluation.episodes.ROWWISE_STEPS", 1)
    cfg, plan = strategy("alcc").cfg, Plan(len(PROFILES), len(POPULATION.time_gap), 5, 64)
    own = build_agent(cfg, POPULATION).policy
    for policy, rowwise in ((GivenPolicy(own, "mine"), False), (shared_policy(own), True)):
        played = Episodes(Strategy("mine", cfg, policy), INPUTS, plan, 1)
        assert played.player.rowwise is rowwise
