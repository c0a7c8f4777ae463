"""Smooth surrogates: near the literal terms beyond their bend, with slopes that lead back."""

from __future__ import annotations

import math

import pytest
import torch

from lcc_rl.pieces import ExcessSpacing, SafetyReward, SmoothEfficiency, Smoothness, SmoothSafety


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values).unsqueeze(-1).requires_grad_()


def test_safety_is_the_literal_term_where_the_bends_are_far() -> None:
    gap, relative = column(6.0, 11.0, 4.0), column(-5.0, -4.0, -6.0)  # TTC 1, 2.5 and 0.5 s
    bends = {"width": 0.001, "gap_width": 0.01, "rate_width": 0.001}
    smooth = SmoothSafety(threshold=4.0, **bends).reward(gap, relative)
    assert torch.allclose(smooth, SafetyReward().reward(gap, relative), atol=2e-3)


def test_safety_bends_within_its_widths() -> None:
    gap, relative = column(11.0, 1.0, 1.0), column(-4.0, -1.0, 0.0)  # contact is at 1 m
    ratios = 4.0 * torch.tensor([4.0 / 10.0, 1.0 / (0.2 * math.log(2.0)), 0.1 / 0.2])
    bends = {"width": 0.3, "gap_width": 0.2, "rate_width": 0.1}
    found = SmoothSafety(threshold=4.0, **bends).reward(gap, relative).squeeze(-1)
    assert torch.allclose(found, 0.3 - (0.09 + ratios.log().square()).sqrt(), atol=1e-4)


def test_safety_always_leads_back() -> None:
    gap, relative = column(8.0, 1.2, 0.5, -3.0), column(-3.0, -1.0, -1.0, -2.0)
    SmoothSafety().reward(gap, relative).sum().backward()
    for slope in (gap.grad, relative.grad):
        assert ((slope > 0) & (slope < math.inf)).all()


def test_efficiency_begins_at_its_threshold_and_leads_back() -> None:
    gap, speed = column(12.0, 30.0, 3.0, 2.0), column(5.0, 5.0, 0.5, 0.5)  # TG 2.4, 6, 3, 2 s
    value = SmoothEfficiency(threshold=2.5, width=0.1).reward(gap, speed)
    assert (value < 0).squeeze(-1).tolist() == [False, True, True, False]
    value.sum().backward()
    assert float(gap.grad[1]) < 0 < float(speed.grad[1])
    assert value[1].item() == pytest.approx(-math.log(6.0 / 2.5), abs=0.11)


def test_smoothness_is_the_square_of_the_jerk() -> None:
    assert Smoothness(weight=0.5).bind().compute(torch.tensor([[2.0]])).item() == -2.0


def test_excess_spacing_is_the_share_of_the_lane_that_a_human_would_not_take() -> None:
    term = ExcessSpacing(standstill_gap=2.0, time_gap=1.0, vehicle_length=5.0)
    gap, speed = column(22.0, 49.0, 8.5), column(20.0, 20.0, 20.0)  # a human keeps 22 m, takes 27 m
    assert term.missed(gap, speed).squeeze(-1).tolist() == pytest.approx([0.0, 1.0, -0.5])
    assert torch.equal(term.reward(gap, speed), -term.missed(gap, speed))
    # As shares of one spacing, ten metres cost the same at every speed.
    term, slow = ExcessSpacing(standstill_gap=2.0, time_gap=1.0, spacing=40.0), column(5.0, 20.0)
    assert term.missed(slow + 12.0, slow).squeeze(-1).tolist() == [0.25, 0.25]
