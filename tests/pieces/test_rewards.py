"""Reward terms against values worked out by hand (A10–A17)."""

import math

import pytest
import torch

from lcc_rl.errors import ConfigError
from lcc_rl.pieces import (
    CollisionPenalty,
    EfficiencyReward,
    EnergyReward,
    SafetyReward,
    TotalReward,
)


def t(*values: float) -> torch.Tensor:
    return torch.tensor(values).unsqueeze(-1)


def test_safety() -> None:
    # Gap 6 m closing at 3 m/s: log(2/4); at 1 m/s: 6 s, safe; opening: safe; contact: log(0.01/4).
    term = SafetyReward(margin=0.0)
    got = term.reward(t(6.0, 6.0, 6.0, -0.1), t(-3.0, -1.0, 1.0, -1.0))
    torch.testing.assert_close(got, t(math.log(0.5), 0.0, 0.0, math.log(0.0025)))
    assert got.min() > -6.0


def test_safety_with_margin() -> None:
    # To the margin of 1 m: (6 − 1)/2.5 = 2 s; literally it would be 2.4 s.
    got = SafetyReward().reward(t(6.0, 0.9), t(-2.5, 0.0))
    torch.testing.assert_close(got, t(math.log(0.5), math.log(0.0025)))


def test_efficiency() -> None:
    got = EfficiencyReward().reward(t(2.49, 2.5, 9.0))
    torch.testing.assert_close(got, t(0.0, -1.0, -1.0))


def test_energy() -> None:
    # −20 kW/20 kW · 0.1 s; recuperation earns.
    got = EnergyReward(0.1).reward(t(20000.0, -5000.0))
    torch.testing.assert_close(got, t(-0.1, 0.025))
    string = torch.tensor([[[20000.0], [10000.0]]])
    got = EnergyReward(0.1, followers=True).reward(string)
    torch.testing.assert_close(got, t(-0.15))


def test_collision_and_weights() -> None:
    crashed = torch.tensor([[True], [False]])
    torch.testing.assert_close(CollisionPenalty(weight=100.0).compute(crashed), t(-100.0, 0.0))
    torch.testing.assert_close(EfficiencyReward(weight=0.5).compute(t(3.0)), t(-0.5))


def test_sum() -> None:
    torch.testing.assert_close(TotalReward(["a", "b"]).compute(t(1.0), t(-3.0)), t(-2.0))


@pytest.mark.parametrize("settings", [{"margin": -1.0}, {"floor": 5.0}, {"weight": math.nan}])
def test_impossible_settings(settings) -> None:
    with pytest.raises(ConfigError):
        SafetyReward(**settings)
