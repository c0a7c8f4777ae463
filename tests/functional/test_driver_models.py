"""Optimal velocity, full velocity difference and Gipps' models: formulas and equilibria."""

import math

import pytest
import torch
from helpers import t

from lcc_rl.functional.driver_models import simulate_follower
from lcc_rl.functional.gipps import GippsConstants
from lcc_rl.functional.laws import LAWS
from lcc_rl.functional.ovm import FVDMConstants, OVMConstants

EACH = pytest.mark.parametrize("model", list(LAWS))


def test_optimal_velocity_by_hand() -> None:
    # v0 = 20, T = 1.5, β = 1.5: tanh β = 0.90514825, A = 20/1.90514825 = 10.497871; s = 20,
    # s0 = 2: tanh(18/15.746806 − 1.5) = tanh(-0.356911) = -0.342490;
    # V = 10.497871 · 0.562658 = 5.906710; κ = 1.2, v = 10: 1.2 · −4.093290
    own = OVMConstants(sensitivity=1.2, form=1.5, min_gap=2.0)
    got = own(t(10.0), t(20.0), t(2.0), t(20.0), t(1.5))
    torch.testing.assert_close(got, t(-4.91194754), rtol=0, atol=1e-6)
    # λ = 0.5, Δv = 2: one less.
    more = FVDMConstants(sensitivity=1.2, form=1.5, min_gap=2.0, speed_gain=0.5)
    got = more(t(10.0), t(20.0), t(2.0), t(20.0), t(1.5))
    torch.testing.assert_close(got, t(-5.91194754), rtol=0, atol=1e-6)


def test_optimal_speed_is_bandos_function() -> None:
    # 16.8 (tanh(0.086 (Δx − 25)) + 0.913), vehicles 5 m long.
    form = math.atanh(0.913)
    scale = 16.8 * 1.913
    own = OVMConstants(form=form, min_gap=25.0 - form / 0.086 - 5.0)
    gap = torch.linspace(0.5, 60.0, 40, dtype=torch.float64)
    got = own.optimal_speed(gap, scale, 1.913 / 0.086 / scale)
    expected = 16.8 * (torch.tanh(0.086 * (gap + 5.0 - 25.0)) + 0.913)
    torch.testing.assert_close(got, expected, rtol=1e-9, atol=1e-9)


def test_gipps_by_hand() -> None:
    # τ = 1 (T = 1.5), a = 1.7, b = 3.4, b̂ = 3.2, s0 = 2, v = 10, v0 = 20.
    own = GippsConstants(acceleration=1.7, deceleration=3.4, leader_deceleration=3.2, min_gap=2.0)
    # s = 20, v_ahead = 8: −3.4 + √(11.56 + 3.4 (36 − 10) + 64 · 3.4/3.2) = −3.4 + √167.96 − …
    safe = -3.4 + math.sqrt(11.56 + 3.4 * 26.0 + 68.0)
    got = own(t(10.0), t(20.0), t(2.0), t(20.0), t(1.5))
    torch.testing.assert_close(got, t(safe - 10.0))
    assert got.item() == pytest.approx(-0.4400616)
    # Free road: 2.5 · 1.7 · 0.5 · √0.525 = 1.53972...
    got = own(t(10.0), t(500.0), t(0.0), t(20.0), t(1.5))
    torch.testing.assert_close(got, t(2.125 * math.sqrt(0.525)))


def test_gipps_with_a_step_of_the_reaction_time_reaches_gipps_speed() -> None:
    own, tau = GippsConstants(), 0.8
    leader = torch.full((2, 1), 9.0, dtype=torch.float64)
    speed, _, _ = simulate_follower(leader, t(10.0), t(15.0), t(20.0), t(1.5 * tau), own, tau)
    brake, ratio = 3.4 * tau, 3.4 / 3.2
    expected = -brake + math.sqrt(brake**2 + 3.4 * (26.0 - 10.0 * tau) + 81.0 * ratio)
    assert speed[1].item() == pytest.approx(expected)


@EACH
def test_nobody_accelerates_at_the_equilibrium_gap(model) -> None:
    own, speed = LAWS[model](), torch.linspace(0.0, 22.0, 12, dtype=torch.float64)
    gap = own.equilibrium_gap(speed, t(25.0), t(1.2), 1e3)
    got = own(speed, gap, torch.zeros_like(speed), t(25.0), t(1.2))
    torch.testing.assert_close(got, torch.zeros_like(got), rtol=0, atol=1e-9)
    assert (gap.diff() > 0).all()
    assert gap[0].item() == pytest.approx(own.min_gap)
    nearer = own(speed, gap - 0.5, torch.zeros_like(speed), t(25.0), t(1.2))
    assert (nearer < 0).all()


def test_stops_behind_a_standing_leader() -> None:
    leader, time_gap = torch.zeros(1801, 9), t(0.9, 1.2, 2.0).repeat_interleave(3)
    start = (t(8.0, 15.0, 20.0).repeat(3), t(60.0, 90.0, 150.0).repeat(3))
    for model in ("idm", "fvdm", "gipps"):
        speed, gap, _ = simulate_follower(
            leader.double(), *start, t(25.0), time_gap, LAWS[model](), 0.1
        )
        assert 1.5 < gap.min() <= gap[-1].max() < 2.1, model  # about s0
        assert speed[-1].max() < 0.05, model


@EACH
def test_gradients_are_finite_everywhere(model) -> None:
    law = LAWS[model]
    speed = t(0.0, 0.0, 10.0, 30.0, 5.0).requires_grad_()
    gap = t(2.0, -1.0, 0.0, 500.0, 8.0).requires_grad_()
    law()(speed, gap, speed - 5.0, t(25.0), t(1.2)).sum().backward()
    assert speed.grad is not None
    assert speed.grad.isfinite().all()
    assert gap.grad is not None
    assert gap.grad.isfinite().all()
