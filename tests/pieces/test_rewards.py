"""Reward terms against values worked out by hand (A10–A17)."""

import math

import torch

from lcc_rl.pieces import (
    CollisionPenalty,
    EfficiencyReward,
    EnergyReward,
    SafetyReward,
    SpacingReward,
    parse_string,
)
from lcc_rl.pieces.world import World


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
    # Within it: closing has the floor, standing and opening nothing, a collision the floor.
    got = SafetyReward().reward(t(6.0, 0.9, 0.9, 0.9, -0.1), t(-2.5, -0.1, 0.0, 1.0, 1.0))
    worst = math.log(0.0025)
    torch.testing.assert_close(got, t(math.log(0.5), worst, 0.0, 0.0, worst))


def test_efficiency() -> None:
    got = EfficiencyReward().reward(t(2.49, 2.5, 9.0))
    torch.testing.assert_close(got, t(0.0, -1.0, -1.0))


def test_energy() -> None:
    # −20 kW/20 kW · 0.1 s; recuperation earns.
    got = EnergyReward().bind().reward(t(20000.0, -5000.0))
    torch.testing.assert_close(got, t(-0.1, 0.025))


def test_spacing() -> None:
    # 0.02 (e/2 m)²; 1 m too near costs what 1 m too far does. It pulls back in proportion.
    error = t(2.0, -1.0, 0.0).requires_grad_()
    got = SpacingReward(weight=0.02, gap_scale=2.0).bind().compute(error)
    torch.testing.assert_close(got.detach(), t(-0.02, -0.005, 0.0))
    got.sum().backward()
    torch.testing.assert_close(error.grad, t(-0.02, 0.01, 0.0))


# -- many automated vehicles -------------------------------------------------------------------

# Places: automated 0, human 1 and 2, automated 3, human 4 and 5.
STRING = parse_string("(automated human*2)*2")
RING = parse_string("(automated human*2)*2", "ring")
POWER = torch.tensor([1.0, 10.0, 100.0, 2.0, 20.0, 200.0]).view(1, 6, 1) * 1000.0
GAPS = torch.full((1, 6, 1), 5.0)


def test_whose_energy_counts() -> None:
    humans = {"power": "human.predicted_power"}  # of an entry that only human drivers have
    for settings, power, earned in (
        ({"of": "self"}, POWER, (1.0, 2.0)),
        ({"of": "behind"}, POWER, (110.0, 220.0)),
        ({"of": "string"}, POWER, (333.0, 333.0)),
        ({"of": "behind", **humans}, POWER[:, [1, 2, 4, 5]], (110.0, 220.0)),
    ):
        term = EnergyReward(scale=1000.0, **settings).bind(World(STRING))
        torch.testing.assert_close(term.computed([power]), -0.1 * t(*earned).unsqueeze(0))
    assert term.in_keys == [("human", "predicted_power")]


def test_what_is_ahead_of_the_first_is_behind_the_last_on_a_ring() -> None:
    string = parse_string("human (automated human)*2", "ring")
    term = EnergyReward(of="behind", scale=1000.0).bind(World(string))
    power = 1000.0 * torch.tensor([1.0, 10.0, 100.0, 2.0, 20.0]).view(1, 5, 1)
    torch.testing.assert_close(term.computed([power]), -0.1 * t(100.0, 21.0).unsqueeze(0))
    assert torch.equal(
        EnergyReward(of="behind").bind(World(RING)).computed([POWER]),
        EnergyReward(of="behind").bind(World(STRING)).computed([POWER]),
    )


def test_who_pays_for_a_collision(subtests) -> None:
    for hit, behind, pays in [
        ((0,), True, (1.0, 0.0)),
        ((3,), True, (0.0, 1.0)),  # of one automated vehicle into a human: the one that hit
        ((3,), False, (0.0, 1.0)),
        ((1,), True, (1.0, 0.0)),
        ((2,), True, (1.0, 0.0)),
        ((1,), False, (0.0, 0.0)),
        ((5,), True, (0.0, 1.0)),
        ((0, 4), True, (1.0, 1.0)),
        ((), True, (0.0, 0.0)),
    ]:
        with subtests.test(hit=hit):
            gaps = GAPS.clone()
            gaps[:, list(hit)] = -0.1
            term = CollisionPenalty(weight=100.0, behind=behind).bind(World(STRING))
            torch.testing.assert_close(term.computed([gaps]), -100.0 * t(*pays).unsqueeze(0))
