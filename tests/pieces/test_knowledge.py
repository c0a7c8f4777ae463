"""Memory and preview: the right values, at the right time, for every agent that asks for them."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import OBSERVATION, small_env, steady, wavy_profiles
from tensordict import TensorDict

from lcc_rl.errors import ConfigError
from lcc_rl.pieces import LeaderPreview, TrafficAhead, parse_string
from lcc_rl.pieces.base import root_key
from lcc_rl.pieces.world import World

FIRST = ("scenario.pieces.leader.start=first", "scenario.pieces.leader.profile=2")


def played(*overrides: str):
    env = small_env("alcc", 2, [*FIRST, *overrides])
    return env.rollout(20, steady(0.0, env))


def test_preview_is_what_the_leader_will_do() -> None:
    data = played("+knowledge=preview", "scenario.pieces.preview.horizons=[0,0.5]")
    seen, leader = data["preview", "speed"][0, :, 0], data["leader", "speed"][0, :, 0]
    assert torch.equal(seen[:, 0], leader)
    assert torch.equal(seen[:-5, 1], leader[5:])
    # It is part of the observation: the difference from the present, scaled.
    difference = seen - leader.unsqueeze(-1)
    assert torch.allclose(data[OBSERVATION][0, :, 0, -2:], 0.5 * difference)


def test_preview_is_what_a_perturbed_leader_will_do() -> None:
    words = ("+knowledge=preview", "scenario.pieces.preview.horizons=[0,0.5]", FIRST[1])
    for size in (0.0, 1.0):
        env = small_env(
            "alcc", 2, [*words, FIRST[0], f"scenario.pieces.leader.perturbation={size}"]
        )
        data = env.rollout(20, steady(0.0, env))
        seen, leader = data["preview", "speed"][:, :, 0], data["leader", "speed"][..., 0]
        assert torch.allclose(seen[..., 0], leader, atol=1e-5)
        assert torch.allclose(seen[:, :-5, 1], leader[:, 5:], atol=1e-5)
        assert torch.equal(leader[0], leader[1]) == (size == 0.0)


def test_a_ring_has_no_leader_to_preview() -> None:
    with pytest.raises(ConfigError, match=r"LeaderPreview reads leader\..* a ring road has no"):
        small_env("alcc", 2, ["scenario=ring", "+knowledge=preview"])


def test_differences_are_taken_in_equal_parts() -> None:
    two = "scenario.pieces.memory.sources=[ahead.speed,self.gap]"
    data = played("+knowledge=memory", "scenario.pieces.memory.seconds=[1.0,2.0]", two)
    own = data["vehicles", "gap"][..., :1, :]
    present = torch.cat([data["leader", "speed"].unsqueeze(-2), own], -1)
    difference = data["memory", "entries"] - present.repeat_interleave(2, -1)
    assert torch.allclose(data[OBSERVATION][..., -4:], 0.5 * difference, atol=1e-5)
    assert difference.abs().max() > 0.1


def test_beyond_the_record_its_last_speed_stands() -> None:
    profiles = wavy_profiles(samples=30)
    world = World(profiles=profiles, perturbation=1.0, nominal=True)  # in training only
    piece = LeaderPreview(horizons=[60.0]).bind(world)
    zero = torch.zeros(1, dtype=torch.int64)
    assert piece.compute(zero, zero, zero, zero)[0, 0] == profiles.record(0)[-1]


def test_a_window_goes_on_in_the_record_it_was_cut_from() -> None:
    whole = wavy_profiles(samples=301)
    cut = whole.windows(100)
    piece = LeaderPreview(horizons=[5.0]).bind(World(profiles=cut))
    at = torch.tensor([80])
    for window in (0, 1):  # of the first record: samples 0…100 and 101…201
        ahead = piece.compute(torch.tensor([window]), 0 * at, at, at)
        assert ahead[0, 0] == whole.record(0)[101 * window + 130]
    assert cut.lengths.tolist() == [101] * len(cut)
    assert torch.equal(cut.record(1), whole.record(0)[101:202])


def test_noise_is_as_large_as_stated_and_repeats_with_the_seed() -> None:
    profiles, zero = wavy_profiles(), torch.zeros(20000, 1, dtype=torch.int64)
    seeds = torch.arange(20000).unsqueeze(-1)
    world = World(profiles=profiles)
    exact, noisy = (LeaderPreview(horizons=[1.0], noise=n).bind(world) for n in (0.0, 0.3))
    error = noisy.compute(zero, zero, seeds, zero) - exact.compute(zero, zero, seeds, zero)
    assert error.std().item() == pytest.approx(0.3, rel=0.03)
    again = noisy.compute(zero, zero, seeds, zero) - exact.compute(zero, zero, seeds, zero)
    assert torch.equal(error, again)


def test_stacked_memory_is_what_every_vehicle_of_a_string_saw() -> None:
    settings = ["scenario.pieces.memory.kind=stacked", "scenario.pieces.memory.seconds=[0.5]"]
    mixed = "scenario.string='automated human automated'"
    data = played("+knowledge=memory", *settings, mixed)
    past, speed = data["memory", "entries"][0, ..., 0], data["vehicles", "speed"][0, ..., 0]
    leader = data["leader", "speed"][0, :, 0]
    assert torch.equal(past[5:, 1], speed[:-5, 1])
    assert torch.equal(past[5:, 0], leader[:-5])
    assert (past[:5, 0] == leader[0]).all()


def test_filtered_memory_is_an_average_and_the_spread_the_average_distance_from_it() -> None:
    seconds = (f"scenario.pieces.{name}.seconds=[2.0]" for name in ("memory", "spread"))
    data = played("+knowledge=[memory,spread]", *seconds)
    average, spread = (data[name, "entries"][0, :, 0, 0] for name in ("memory", "spread"))
    leader, share = data["leader", "speed"][0, :, 0], 1.0 - math.exp(-0.05)
    means, distances = [leader[0].item()], [0.0]
    for speed in leader[1:].tolist():
        distances.append(distances[-1] + share * (abs(speed - means[-1]) - distances[-1]))
        means.append(means[-1] + share * (speed - means[-1]))
    assert torch.allclose(average, torch.tensor(means), atol=1e-4)
    assert torch.allclose(spread, torch.tensor(distances), atol=1e-4)
    assert distances[-1] > 0.01
    assert torch.allclose(data[OBSERVATION][0, :, 0, -1], 0.5 * spread)


def test_traffic_ahead_is_the_speed_of_the_vehicles_at_these_places() -> None:
    speed, leader, drawn = torch.rand(2, 6, 1), torch.rand(2, 1), torch.tensor([[0, 4], [2, 5]])
    for pattern, road in (
        ("human automated human*2 automated*2", "open"),
        ({"size": 6, "penetration": 0.4}, "open"),
        ("human automated human*3 automated", "ring"),
    ):
        string = parse_string(pattern, road)
        piece = TrafficAhead(places=(1, 3)).bind(World(string))
        given = {("vehicles", "speed"): speed, ("leader", "speed"): leader}
        given["automated", "index"] = drawn
        state = TensorDict({key: given[root_key(key)] for key in piece.in_keys}, [2])
        seen = piece(state)["next", "traffic", "speed"]
        for episode in range(2):
            everyone, own = speed[episode].flatten(), string.places("automated")
            for row, place in enumerate(drawn[episode].tolist() if string.drawn else own):
                for column, far in enumerate((1, 3)):
                    beyond = place < far and not string.ring
                    there = leader[episode, 0] if beyond else everyone[(place - far) % 6]
                    assert seen[episode, row, column] == there


def test_late_reports_are_the_past_speeds_and_their_errors_are_as_large_as_stated() -> None:
    mixed = "scenario.string='human*2 automated human automated'"
    places = "scenario.pieces.traffic.places=[2,3]"
    words = ("+knowledge=traffic", mixed, places)
    data = played(*words, "scenario.pieces.traffic.delay=0.5")
    seen, speed = data["traffic", "speed"], data["vehicles", "speed"][..., 0]
    everyone = torch.cat([data["leader", "speed"], speed], -1)  # the leader is place 0
    for row, place in enumerate((3, 5)):
        for column, far in enumerate((2, 3)):
            true = everyone[:, :, place - far]
            assert torch.equal(seen[:, 5:, row, column], true[:, :-5])
            assert (seen[:, :5, row, column] == true[:, :1]).all()
    assert torch.allclose(
        data[OBSERVATION][0, 1:, 0, -3:-1], 0.5 * (seen - ahead_of(data))[0, 1:, 0]
    )
    noisy = played(*words, "scenario.pieces.traffic.noise=0.3")["traffic", "speed"]
    error = noisy - played(*words)["traffic", "speed"]
    assert error.std().item() == pytest.approx(0.3, rel=0.2)
    assert error.unique().numel() == error.numel()


def ahead_of(data: TensorDict) -> torch.Tensor:
    """Return the speed of the vehicle ahead of the two automated ones."""
    return data["vehicles", "speed"][..., [1, 3], :]
