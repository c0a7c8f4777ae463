"""The barrier: whatever the policy wants, the car stays between its limits."""

from __future__ import annotations

import pytest
import torch
from helpers import small_env
from torchrl.envs import check_env_specs

from lcc_rl.errors import ConfigError
from lcc_rl.pieces import Barrier

WHOLE = "scenario.horizon=300"


def driven(action: float | None, *overrides: str):
    """Drive 64 episodes with one action throughout, or with random ones."""
    env = small_env("alcc", 64, [WHOLE, "scenario.pieces.cav.initial_gap_range=[1,1]", *overrides])

    def policy(td):
        wanted = torch.empty(64, 1).uniform_(-1.0, 1.0) if action is None else action
        return td.set("action", torch.zeros(64, 1) + wanted)

    with torch.random.fork_rng():
        torch.manual_seed(0)
        return env.rollout(300, policy, break_when_any_done=False)["next"]


@pytest.mark.parametrize("action", [1.0, 0.0, -1.0, None])
def test_no_policy_passes_the_limits(action) -> None:
    free, held = driven(action), driven(action, "+filter=barrier")
    assert held["cav", "ttc"].min() >= 4.0
    assert held["cav", "gap"].min() > 0.1
    # The leader may pull away faster than the limit is approached, but not for long.
    assert (held["cav", "time_gap"] > 2.5).double().mean() < 0.01
    broken = (free["cav", "ttc"] < 4.0) | (free["cav", "time_gap"] > 2.5)
    assert broken.double().mean() > 0.1


@pytest.mark.parametrize("variant", ["alcc", "reference", "idm"])
def test_the_environment_keeps_its_word(variant) -> None:
    check_env_specs(small_env(variant, 2, ["+filter=barrier"]))


def test_between_the_limits_the_policy_decides() -> None:
    piece = Barrier(0.1)
    action = torch.tensor([-0.05, 0.0, 0.3]).unsqueeze(-1)
    speed, gap = torch.full((3, 1), 10.0), torch.full((3, 1), 15.0)
    assert torch.equal(piece.compute(action, speed, gap, speed, torch.zeros(3, 1)), action)


def test_safety_wins() -> None:
    # A gap far too long, closing far too fast: the limits contradict each other.
    piece = Barrier(0.1, time_gap=0.5, full_speed=0.0)
    speed, gap, ahead = (torch.full((1, 1), x) for x in (10.0, 20.0, 2.0))
    assert piece.compute(torch.ones(1, 1), speed, gap, ahead, torch.zeros(1, 1)) == -1.0


def test_a_limit_leaves_the_state_a_gradient() -> None:
    piece = Barrier(0.1, rate=1.0)
    gap = torch.full((1, 1), 5.5, requires_grad=True)
    speed, ahead = torch.full((1, 1), 6.0), torch.full((1, 1), 5.0)
    piece.compute(torch.ones(1, 1), speed, gap, ahead, torch.zeros(1, 1)).sum().backward()
    assert gap.grad is not None
    # More room, more acceleration: by rate / (τ + T/2), as a share of the largest.
    assert gap.grad.item() == pytest.approx(1.0 / 4.05 / 3.0, rel=1e-5)


def test_the_longest_gap_grows_with_the_square_of_the_speed_up_to_full_speed() -> None:
    piece = Barrier(0.1, time_gap=2.4, full_speed=12.0, least_gap=2.0)
    speed = torch.tensor([[0.0], [2.0], [6.0], [11.0], [20.0]], requires_grad=True)
    longest, slope = piece._longest_gap(speed, 2.4)
    assert torch.allclose(longest.flatten(), torch.tensor([2.0, 2.0, 7.2, 24.2, 48.0]))
    (derivative,) = torch.autograd.grad(longest.sum(), speed)
    assert torch.allclose(slope[2:], derivative[2:])  # elsewhere the least gap has none
    always, _ = Barrier(0.1, time_gap=2.4, full_speed=0.0)._longest_gap(speed, 2.4)
    assert torch.allclose(always.flatten(), 2.4 * speed.flatten().clamp(min=1.0))


def test_far_away_the_car_is_drawn_near() -> None:
    piece = Barrier(0.1, full_speed=12.0)
    speed, gap = torch.full((1, 1), 6.0), torch.full((1, 1), 14.0)
    pushed = piece.compute(-torch.ones(1, 1), speed, gap, speed, torch.zeros(1, 1))
    allowed = 2.45 * 6.0**2 / 12.0
    expected = 0.2 * (14.0 - allowed) / (2 * 2.45 * 6.0 / 12.0)
    assert 3.0 * pushed.item() == pytest.approx(expected, rel=1e-5)


def test_full_speed_is_no_negative_number() -> None:
    with pytest.raises(ConfigError, match=r"barrier\.full_speed"):
        Barrier(0.1, full_speed=-1.0)


@pytest.mark.parametrize(
    "setting", ["time_to_collision", "time_gap", "rate", "time_gap_rate", "max_acceleration"]
)
def test_limits_must_be_positive(setting) -> None:
    with pytest.raises(ConfigError, match=f"barrier.{setting} must be positive"):
        Barrier(0.1, **{setting: 0.0})
