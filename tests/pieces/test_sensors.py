"""Sensors: what is measured lies within the bounds of the truth of some steps ago."""

from __future__ import annotations

import torch
from helpers import ACTION, play, small_env

ROLE = "automated"
SETTINGS = (
    "+faults=sensors",
    "scenario.sensors.automated.dropouts=0.3",
    "scenario.horizon=100",
    "scenario.string='automated human automated'",
)
BOUNDS = {"gap": 0.5, "speed": 0.05, "ahead_speed": 0.1}


def record(*overrides: str) -> dict[tuple[str, ...], torch.Tensor]:
    """Sixteen episodes of 100 steps with drawn actions; entries ``[time, batch, n, 1]``."""
    env = small_env("alcc", 16, [*SETTINGS, *overrides])
    chance = torch.Generator().manual_seed(0)

    def policy(td):
        return td.set(ACTION, 2.0 * torch.rand((16, 2, 1), generator=chance) - 1.0)

    measured = [(ROLE, f"sensed_{name}") for name in (*BOUNDS, "relative_speed")]
    true = [("vehicles", "gap"), ("vehicles", "speed"), ("leader", "speed")]
    found, _ = play(env, policy, None, [*measured, *true, (ROLE, "sensors"), (ROLE, "observation")])
    return {key: entry[-100:] for key, entry in found.items()}


def test_measurements_lie_within_the_bounds_of_the_state_of_their_age() -> None:
    found = record()
    age, own_age = found[ROLE, "sensors"][..., :2].long().split(1, -1)
    assert torch.equal(age, own_age)  # a drop-out keeps all of a measurement
    assert age.unique().tolist() == [2, 3, 4, 5, 6]
    own = [0, 2]  # the automated vehicles' places
    speed, leader = found["vehicles", "speed"], found["leader", "speed"].unsqueeze(-2)
    true = {
        "gap": found["vehicles", "gap"][..., own, :],
        "speed": speed[..., own, :],
        "ahead_speed": torch.cat([leader, speed[..., 1:2, :]], -2),
    }
    time = torch.arange(100).view(-1, 1, 1, 1)
    for name, bound in BOUNDS.items():
        then = true[name].gather(0, (time - age).clamp(min=0))[6:]
        error = (found[ROLE, f"sensed_{name}"][6:] - then).abs()
        assert 0.9 * bound < error.max() <= bound + 1e-4
    relative = found[ROLE, "sensed_ahead_speed"] - found[ROLE, "sensed_speed"]
    assert torch.equal(found[ROLE, "sensed_relative_speed"], relative)


def test_what_is_measured_is_observed() -> None:
    found = record()
    observed = found[ROLE, "observation"][..., :4]
    names = ("ahead_speed", "speed", "relative_speed", "gap")
    scales = torch.tensor([0.1, 0.1, 0.5, 0.1])
    sensed = torch.cat([found[ROLE, f"sensed_{name}"] for name in names], -1)
    assert torch.allclose(observed, sensed * scales)


def test_errors_are_functions_of_the_episodes_seed() -> None:
    one, other = record(), record()
    assert all(torch.equal(one[key], other[key]) for key in one)
    without = record("scenario.sensors.automated.gap_error=0.0")[ROLE, "sensed_gap"]
    # Nothing that the drawn actions do depends on what is measured.
    assert (one[ROLE, "sensed_gap"] - without).std() > 0.2


def test_an_error_of_scale_is_one_factor_of_each_speed_in_an_episode() -> None:
    exact = ("gap_error=0", "speed_error=0", "ahead_error=0", "delay=0", "scale_error=0.02")
    lost = ("dropouts=0", "longest_dropout=0")
    found = record(*(f"scenario.sensors.automated.{x}" for x in (*exact, *lost)))
    true = found["vehicles", "speed"][..., [0, 2], :]
    moves = true > 0.1
    factor = torch.where(moves, found[ROLE, "sensed_speed"] / true - 1.0, torch.nan)
    drawn = factor.nanmean(0, keepdim=True)
    assert ((factor - drawn).abs()[moves] < 1e-4).all()
    assert 0.018 < drawn.abs().max() <= 0.02
    assert len(drawn.unique()) == drawn.numel()  # of every vehicle its own
