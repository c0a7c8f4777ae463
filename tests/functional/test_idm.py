"""The Intelligent Driver Model: formula, equilibrium and behaviour."""

import torch
from helpers import t

from lcc_rl.functional.driver_models import simulate_follower
from lcc_rl.functional.idm import IDMConstants

KNOWN = IDMConstants(acceleration=1.0, deceleration=1.5, min_gap=2.0)


def test_formula_a3() -> None:
    # v = 10, s = 20, Δv = 2, v0 = 20, T = 1.5, a = 1, b = 1.5, s0 = 2:
    # s* = 2 + 15 + 10·2/(2·√1.5) = 17 + 8.16496581 = 25.16496581
    # 1 − (1/2)⁴ − (25.16496581/20)² = 1 − 0.0625 − 1.58318876 = −0.64568876
    got = KNOWN(t(10.0), t(20.0), t(2.0), t(20.0), t(1.5))
    torch.testing.assert_close(got, t(-0.64568876), rtol=0, atol=1e-7)


def test_desired_gap_never_below_s0_a4() -> None:
    # Δv = −10: vT + vΔv/(2√ab) = 15 − 40.8 < 0, so s* = s0 = 2; 1 − 0.0625 − 0.01 = 0.9275
    got = KNOWN(t(10.0), t(20.0), t(-10.0), t(20.0), t(1.5))
    torch.testing.assert_close(got, t(0.9275))


def test_equilibrium_gap_is_equilibrium_and_capped() -> None:
    speed, v0, time_gap = t(5.0, 19.9, 25.0), t(20.0, 20.0, 20.0), t(1.2, 1.2, 1.2)
    gap = KNOWN.equilibrium_gap(speed, v0, time_gap)
    # (2 + 6)/√(1 − 1/256); near and above v0 the cap holds: 2·2 + 3·19.9 = 63.7, 2·2 + 75 = 79.
    torch.testing.assert_close(gap, t(8.0 / (255 / 256) ** 0.5, 63.7, 79.0))
    acceleration = KNOWN(speed[:1], gap[:1], t(0.0), v0[:1], time_gap[:1])
    torch.testing.assert_close(acceleration, t(0.0), rtol=0, atol=1e-9)


def test_string_with_long_time_gap_damps_a_disturbance() -> None:
    # With T = 2 s > 1 s the IDM string is stable: the dip in speed shrinks from car to car.
    time = torch.arange(1201) * 0.1
    leader = 15.0 - 3.0 * torch.exp(-(((time - 20.0) / 3.0) ** 2)).double().unsqueeze(-1)
    dips = []
    for _ in range(4):
        gap = KNOWN.equilibrium_gap(leader[0], t(25.0), t(2.0))
        leader, _, _ = simulate_follower(leader, leader[0], gap, t(25.0), t(2.0), KNOWN, 0.1)
        dips.append(15.0 - leader.min().item())
    assert dips == sorted(dips, reverse=True)
    assert dips[-1] < 0.8 * dips[0]
