"""Equations against values worked out by hand."""

import torch
from helpers import t

from lcc_rl.functional.kinematics import advance_gap, advance_speed
from lcc_rl.functional.power import motor_power
from lcc_rl.functional.safety import time_gap, time_to_collision


def test_advance_speed_stops_at_zero() -> None:
    # 10 + 2·0.1 = 10.2; 0.1 − 3·0.1 < 0, so it stops and has executed (0 − 0.1)/0.1 = −1.
    speed, executed = advance_speed(t(10.0, 0.1), t(2.0, -3.0), 0.1)
    torch.testing.assert_close(speed, t(10.2, 0.0))
    torch.testing.assert_close(executed, t(2.0, -1.0))


def test_advance_gap_is_trapezoidal() -> None:
    # 5 + 0.1/2·((12 − 10) + (11 − 10.2)) = 5 + 0.05·2.8 = 5.14
    gap = advance_gap(t(5.0), t(12.0), t(10.0), t(11.0), t(10.2), 0.1)
    torch.testing.assert_close(gap, t(5.14))


def test_motor_power_a2() -> None:
    # v = 10, a = 1: 110.3 + 4229 + 1213 − 2.79 + 24840 + 2911 + 355.7 + 137.4 + 251.9
    # = 34045.51 W
    # v = 10, a = −1: 110.3 + 4229 − 1213 − 2.79 − 24840 + 2911 + 355.7 − 137.4 + 251.9
    # = −18335.29 W
    torch.testing.assert_close(motor_power(t(10.0, 10.0), t(1.0, -1.0)), t(34045.51, -18335.29))
    torch.testing.assert_close(motor_power(t(10.0), t(-1.0), recuperation=False), t(0.0))
    # Standing still: the constant alone.
    torch.testing.assert_close(motor_power(t(0.0), t(0.0)), t(110.3))


def test_time_to_collision() -> None:
    # closing: 8/2 = 4; opening or steady: the ceiling; contact: the floor.
    got = time_to_collision(t(8.0, 8.0, 8.0, 0.001, -0.5), t(2.0, 0.0, -1.0, 5.0, -1.0))
    torch.testing.assert_close(got, t(4.0, 1e3, 1e3, 0.01, 0.01))


def test_time_gap_floor() -> None:
    # 20/10 = 2; standing, floored at 1 m/s: 2.2/1 = 2.2; the literal rule: the ceiling.
    torch.testing.assert_close(time_gap(t(20.0, 2.2), t(10.0, 0.0)), t(2.0, 2.2))
    torch.testing.assert_close(time_gap(t(2.2), t(0.0), speed_floor=0.0), t(1e3))


def test_time_to_collision_has_finite_gradient_where_it_does_not_close() -> None:
    rate = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    time_to_collision(t(1.0, 5.0, -1.0), rate).sum().backward()
    assert rate.grad is not None
    assert torch.isfinite(rate.grad).all()
