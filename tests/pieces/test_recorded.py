"""The driver recorded behind the leader: as a controller, as a start and as a strategy."""

from __future__ import annotations

import logging

import numpy as np
import pandas as pd
import pytest
import torch
from helpers import (
    POPULATION,
    check_episodes,
    check_refused,
    compose,
    composed,
    followed_profiles,
    strategies_of,
    wavy_profiles,
)

from lcc_rl.config import load
from lcc_rl.data.profiles import at_step, from_records, joined, leader_profiles
from lcc_rl.envs import build_env
from lcc_rl.envs.inputs import Inputs
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.episodes import evaluate
from lcc_rl.evaluation.strategies import applies, baseline, baselines
from lcc_rl.results.measures import FASTER


def drive(profiles, steps: int):
    """Play behind leaders from their first samples, all of the episode."""
    choice = "controller@scenario.controllers.automated=recorded"
    first = "scenario.pieces.leader.start=first"
    start = "scenario.start.automated={_target_: lcc_rl.pieces.TimeGapStart}"
    cfg = compose("idm", choice, start, first, f"scenario.horizon={steps}")
    env = build_env(cfg, profiles, POPULATION, 4, 0, nominal=True)
    return env.rollout(steps, break_when_any_done=False)


def test_a_record_shorter_than_the_horizon_shifts_no_other() -> None:
    speeds = [torch.full((n,), v) for n, v in ((20, 5.0), (80, 10.0), (80, 20.0))]
    behind = [torch.stack([speed, speed + 7.0], -1) for speed in speeds]
    short = from_records(speeds, [*"abc"], [*"abc"], 0.1, behind)
    cfg = compose("alcc", "scenario.horizon=50", "+knowledge=preview")
    first = build_env(cfg, short, POPULATION, 8, 0, nominal=True).reset()
    leader = first["leader", "speed"]
    assert {*leader.flatten().tolist()} == {10.0, 20.0}
    assert torch.equal(first["preview", "speed"], leader.unsqueeze(-1).expand(-1, 1, 5))
    assert torch.equal(first["vehicles", "speed"][:, 0], leader)
    assert torch.equal(first["vehicles", "gap"][:, 0], leader + 7.0)


def test_vehicles_start_as_recorded_and_reach_every_recorded_speed() -> None:
    profiles = followed_profiles()
    data = drive(profiles, 20)
    for episode in range(4):
        own = profiles.follower(int(data["leader", "profile"][episode, 0]))
        assert data["vehicles", "speed"][episode, 0, 0, 0] == own[0, 0]
        assert data["vehicles", "gap"][episode, 0, 0, 0] == own[0, 1]
        torch.testing.assert_close(
            data["next", "vehicles", "speed"][episode, 1:, 0, 0], own[2:21, 0], rtol=0, atol=1e-5
        )


def test_a_speedometer_that_errs_leads_nobody_away() -> None:
    profiles = followed_profiles()
    fast = [profiles.follower(number) + torch.tensor([0.2, 0.0]) for number in range(len(profiles))]
    each = [profiles.record(number) for number in range(len(profiles))]
    biased = from_records(each, profiles.names, profiles.recordings, 0.1, fast)
    data = drive(biased, 250)
    for episode in range(4):
        recorded = biased.follower(int(data["leader", "profile"][episode, 0]))[:250, 1]
        off = data["vehicles", "gap"][episode, :, 0, 0] - recorded
        assert -2.0 < off.min() < -1.5  # 0.2 m/s times 10 s, instead of 5 m


def test_the_strategy_starts_and_drives_as_recorded() -> None:
    cfg = composed("variant=idm", "scenario.horizon=30", "evaluation.warm_up=0")
    windows = followed_profiles().windows(30)
    inputs = Inputs(windows, windows, POPULATION)
    rows, _ = evaluate(baseline(cfg, "recorded"), inputs, 2, 64, seed=0)
    for window, distance in zip(rows["profile_id"], rows["cav_distance_m"], strict=True):
        speed = windows.follower(window)[:, 0].double()
        expected = 0.1 * float((speed[1:] + speed[:-1]).sum()) / 2.0
        assert distance == pytest.approx(expected, rel=1e-4)
    assert rows[FASTER].isna().all()  # nobody knows how fast they would like to go
    assert applies(cfg, "recorded")
    assert not applies(composed("variant=idm", "scenario.string=human automated"), "recorded")
    assert not applies(composed("variant=reference", "scenario=ring"), "recorded")
    cfg = cfg.with_(evaluation={"baselines": ["direct", "recorded"]})
    assert [one.name for one in baselines(cfg)] == ["direct", "recorded"]


def test_leaders_without_followers_are_refused() -> None:
    cfg = compose("idm", "controller@scenario.controllers.automated=recorded")
    with pytest.raises(ConfigError, match=r"controllers\.automated: no driver was recorded"):
        build_env(cfg, wavy_profiles(), POPULATION, 2)


@pytest.mark.parametrize(
    ("string", "profiles", "words", "first"),
    [
        ("automated*2 human", followed_profiles(), [], None),
        ("automated*2 human", followed_profiles(), ["scenario.start.automated.time_gap=1.0"], 1.0),
        ("human automated", followed_profiles(), [], 1.5),
        ("automated human", wavy_profiles(), [], 1.5),
    ],
)
def test_a_start_is_recorded_directly_behind_the_leader_only(
    string, profiles, words, first
) -> None:
    cfg = compose("reference", f"scenario.string={string}", *words)
    env = build_env(cfg, profiles, POPULATION, 4, 0, nominal=True)
    start = env.reset()
    place = cfg.scenario.vehicles.places("automated")
    speed, gap = (start["vehicles", x][:, list(place), 0] for x in ("speed", "gap"))
    assert torch.allclose(gap[:, 1:], 2.0 + (first or 1.5) * speed[:, 1:])
    if first is not None:
        assert torch.allclose(gap, 2.0 + first * speed)
        return
    for episode, own in enumerate(start["leader", "profile"][:, 0].tolist()):
        sample = int(start["leader", "start"][episode, 0])
        found = profiles.follower(own)[sample]
        assert torch.equal(torch.stack([speed[episode, 0], gap[episode, 0]]), found)


def test_followers_stay_beside_their_leaders() -> None:
    rows = 400
    time = 0.1 * np.arange(rows)
    table = pd.DataFrame(
        {
            "episode": np.repeat([0, 1], rows),
            "recording": "a",
            "follower_id": np.repeat([1, 2], rows),
            "leader_id": np.repeat([3, 4], rows),
            "time_s": np.tile(time, 2),
            "leader_speed_mps": np.tile(10.0 + np.sin(time), 2),
            "follower_speed_mps": np.concatenate([10.0 + np.cos(time), 9.0 + np.cos(time)]),
            "gap_m": np.concatenate([20.0 + time, 30.0 + time]),
            "follower_position_m": 0.0,
            "leader_position_m": 0.0,
            "leader_length_m": 0.0,
        }
    )
    profiles = leader_profiles(check_episodes(table), 0.1)
    cut = profiles.windows(100).select([4, 1])
    # Windows of 101 samples: three of each episode; the fifth is the second of the second one.
    for index, (episode, start) in enumerate(((1, 101), (0, 101))):
        expected = table[table.episode == episode].iloc[start : start + 101]
        own = cut.follower(index).numpy()
        np.testing.assert_allclose(own[:, 0], expected["follower_speed_mps"], rtol=1e-6)
        np.testing.assert_allclose(own[:, 1], expected["gap_m"], rtol=1e-6)
    slower = at_step(profiles, 0.2)
    np.testing.assert_allclose(slower.follower(1), profiles.follower(1)[::2], rtol=1e-6)
    assert joined([profiles, slower]).followers.shape == (4 * 300, 2)
    assert joined([profiles, wavy_profiles()]).followers is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["leader=udds"], "compare=recorded: no driver was recorded behind these leaders"),
        (
            ["scenario=ring", "scenario.string=automated human*3"],
            "compare=recorded: it has no vehicle to drive in this string",
        ),
    ],
)
def test_a_recorded_driver_that_cannot_be_played_is_never_silent(words, message, caplog) -> None:
    small = ["scenario.horizon=40", "evaluation.warm_up=0", "evaluation.profiles=2"]
    small += ["evaluation.drivers=2"]
    cfg = load("evaluate", ["variant=idm", "compare=[recorded]", *words, *small])
    with pytest.raises(ConfigError, match=message):
        strategies_of(cfg)
    cfg = cfg.with_(compare=[], evaluation={"baselines": ["idm", "recorded"]})
    with caplog.at_level(logging.WARNING, logger="lcc_rl"):
        assert "recorded" not in [one.name for one in strategies_of(cfg)[0]]
    assert "recorded is left out: no driver was recorded behind these leaders" in caplog.text


def test_a_gap_at_standstill_that_no_vehicle_uses_is_refused() -> None:
    gap = "scenario.start.automated.standstill_gap=2.5"
    copied = "scenario.start.human=${scenario.start.automated}"

    def build(profiles, string: str, *words: str):
        cfg = compose("alcc", f"scenario.string={string}", gap, *words)
        return build_env(cfg, profiles, POPULATION, 2, nominal=True)

    idle = r"^scenario\.start\.automated\.standstill_gap=2\.5 has no effect: .* recorded gap"
    check_refused(build, [(followed_profiles(), "automated human*2", idle)])
    for words in (["automated*2"], ["automated human", copied], ["human automated"]):
        assert build(followed_profiles(), *words)
    assert build(followed_profiles(), "automated human", "scenario.start.automated.time_gap=1")
    assert build(wavy_profiles(), "automated human")
