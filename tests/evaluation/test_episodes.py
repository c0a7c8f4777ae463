"""The Monte Carlo evaluation: paired, independent of the batch, and equal to a plain simulation."""

import pandas as pd
import pytest
import torch
from helpers import POPULATION, compose, wavy_profiles

from lcc_rl.envs.factory import build_agent, build_env
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.monte_carlo import Strategy, choices, evaluate, pairs
from lcc_rl.functional.idm import equilibrium_gap, simulate_follower
from lcc_rl.functional.power import motor_power

PROFILES = wavy_profiles().windows(100)


def strategy(variant: str, *overrides: str) -> Strategy:
    cfg = compose(variant, "scenario.horizon=100", *overrides)
    return Strategy(variant, cfg, build_agent(cfg, POPULATION).policy)


def run(variant: str, *overrides: str, drivers=5, batch_size=64, seed=1, sample_episodes=0):
    return evaluate(
        strategy(variant, *overrides),
        PROFILES,
        POPULATION,
        drivers,
        batch_size,
        seed,
        sample_episodes,
    )


def test_every_driver_behind_every_profile() -> None:
    rows, _ = run("idm")
    assert len(rows) == len(PROFILES) * 5
    assert rows.groupby(["profile_id", "driver_id"]).size().eq(1).all()
    profile, driver = pairs(3, 249, None)
    assert len(profile) == 3 * 249
    assert driver[:249].tolist() == list(range(249))


def test_batch_size_does_not_change_a_row() -> None:
    whole, _ = run("idm", batch_size=1000)
    parts, _ = run("idm", batch_size=7)
    # Up to the order of summation: vector and scalar loops round differently.
    pd.testing.assert_frame_equal(whole, parts, rtol=1e-5, atol=1e-5)


def test_seed_changes_only_the_noise() -> None:
    one, two = run("idm", seed=1)[0], run("idm", seed=2)[0]
    assert (one["driver_id"] == two["driver_id"]).all()
    relative = (one["hdv_energy_kj"] - two["hdv_energy_kj"]).abs() / one["hdv_energy_kj"].abs()
    assert 0 < relative.median() < 0.02


def test_scenario_b_equals_the_plain_simulation() -> None:
    rows, _ = run("direct", "scenario.pieces.hdv.noise=0")
    profile, driver = pairs(len(PROFILES), len(POPULATION.time_gap), 5)
    leader = torch.stack([PROFILES.record(i) for i in profile], dim=1)
    v0, gap = POPULATION.desired_speed[driver], POPULATION.time_gap[driver]
    start = equilibrium_gap(leader[0], v0, gap, POPULATION.constants)
    speed, _, acceleration = simulate_follower(
        leader, leader[0], start, v0, gap, POPULATION.constants, 0.1
    )
    energy = motor_power(speed[:-1], acceleration).sum(0) * 0.1 / 1e3
    torch.testing.assert_close(
        torch.tensor(rows["hdv_energy_kj"].to_numpy()), energy, rtol=1e-3, atol=0.05
    )


def test_strategies_meet_the_same_noise() -> None:
    # Two cars that drive alike must give the follower exactly the same episode.
    a, _ = run("idm")
    b, _ = run("idm", "reward.terms.safety.weight=3")
    pd.testing.assert_frame_equal(a, b, check_exact=True)


def test_collisions_end_the_count() -> None:
    class Rammer(torch.nn.Module):
        def forward(self, td):
            return td.set("action", torch.ones_like(td["cav", "speed"]))

    cfg = compose("alcc", "scenario.horizon=100")
    rows, _ = evaluate(Strategy("rammer", cfg, Rammer()), PROFILES, POPULATION, 3, 64, 1)
    assert rows["collided"].all()
    assert (rows["duration_s"] < 10.0).all()
    assert (rows["min_ttc_s"] < 0.1).all()


def test_string_of_followers_adds_up() -> None:
    one, _ = run("direct")
    three, _ = run("direct", "scenario.followers=3")
    assert (three["hdv_distance_m"] > 2.0 * one["hdv_distance_m"]).all()


def test_a_string_begins_with_its_driver_and_goes_on_with_the_next() -> None:
    cfg = strategy("direct", "scenario.followers=3").cfg
    env = build_env(cfg, PROFILES, POPULATION, 2)
    count = len(POPULATION.time_gap)
    given = choices(env, torch.tensor([0, 1]), torch.tensor([0, count - 1]), 1, count)
    assert given["hdv", "driver"].squeeze(-1).tolist() == [[0, 1, 2], [count - 1, 0, 1]]


def test_a_record_chosen_for_training_is_no_choice_for_evaluation() -> None:
    one, _ = run("idm")
    other, _ = run("idm", "scenario.pieces.leader.profile=77")
    pd.testing.assert_frame_equal(one, other)


def test_sample_episodes_are_time_series() -> None:
    rows, steps = run("idm", sample_episodes=2)
    assert steps.groupby(["profile", "driver_id"]).size().eq(100).all()
    assert steps.groupby(["profile", "driver_id"]).ngroups == 2
    one = steps[steps["driver_id"] == steps["driver_id"].iloc[0]]
    one = one[one["profile"] == one["profile"].iloc[0]]
    row = rows[(rows["driver_id"] == one["driver_id"].iloc[0])]
    row = row[row["profile"] == one["profile"].iloc[0]].iloc[0]
    assert one["cav_power"].sum() * 1e-4 == pytest.approx(row["cav_energy_kj"], rel=1e-4)


def test_batch_size_must_be_positive() -> None:
    with pytest.raises(ConfigError, match="batch_size"):
        run("idm", batch_size=0)
