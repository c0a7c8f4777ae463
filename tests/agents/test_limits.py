"""Limits whose prices are learned."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import followed_profiles, wavy_profiles
from test_analytic import make

from lcc_rl.agents.limits import Limits, LimitsEach
from lcc_rl.energy import as_fleet
from lcc_rl.errors import ConfigError
from lcc_rl.functional.power import acceleration_loss, steady_power
from lcc_rl.pieces import ExcessSpacing, PathEnergy, SmoothEfficiency, Smoothness, SmoothSafety
from lcc_rl.pieces.world import World

KNOWN = {"safety": SmoothSafety(), "efficiency": SmoothEfficiency(), "smoothness": Smoothness()}


def test_a_price_rises_until_its_limit_is_kept() -> None:
    limits = Limits({"efficiency": 0.01, "safety": 0.0}, 0.1, KNOWN)
    price = [limits.price("efficiency")]
    for share in (0.5, 0.02, 0.01, 0.0):
        limits.update({"efficiency": share, "safety": 0.0})
        price.append(limits.price("efficiency"))
    assert price[0] == 1.0
    rates = torch.tensor(price).log().diff()
    assert torch.allclose(rates, torch.tensor([0.1, 0.1, 0.0, -0.1]), atol=1e-6)
    # Kept by something else: its price falls.
    assert limits.price("safety") == pytest.approx(2.718281828**-0.4)
    assert limits.price("cav_energy") == 1.0
    resumed = Limits({"safety": 0.0, "efficiency": 0.01}, 0.1, KNOWN)
    resumed.load_state_dict(limits.state_dict())
    assert resumed.logarithms == limits.logarithms


def test_the_price_of_an_average_answers_on_both_sides() -> None:
    limits = Limits({"spacing": "recorded"}, 0.1, {"spacing": ExcessSpacing(time_gap=2.4)}, 0.5)
    profiles = followed_profiles()
    limits.take(profiles)
    gap, own = profiles.followers[:, 1].double(), 2.0 + 2.4 * profiles.followers[:, 0].double()
    largest = float(((gap - own) / (own + 5.0)).mean())
    assert limits.largest["spacing"] == pytest.approx(largest, abs=1e-5)
    assert largest < 0.0
    prices = []
    for miss in (0.02, 0.02, -0.02, 0.0):
        limits.update({"spacing": limits.largest["spacing"] + miss})
        prices.append(limits.price("spacing"))
    # The sum of the misses, and half of the latest one, as shares of the least or the limit's size.
    width = max(0.1, abs(largest))
    sums, latest = torch.tensor([2.0, 4.0, 2.0, 2.0]), torch.tensor([2.0, 2.0, -2.0, 0.0])
    expected = (0.1 * sums + 0.5 * latest) * 0.01 / width
    assert torch.allclose(torch.tensor(prices).log(), expected, atol=1e-5)
    other = Limits({"spacing": 0.0}, 0.1, {"spacing": ExcessSpacing()})
    other.load_state_dict(limits.state_dict())
    assert other.price("spacing") == limits.price("spacing")


def test_a_limit_is_that_of_the_recorded_drivers() -> None:
    known = {"safety": SmoothSafety(), "efficiency": SmoothEfficiency(limit=2.0)}
    limits = Limits({"efficiency": "recorded", "safety": "recorded"}, 0.1, known)
    profiles = followed_profiles()
    limits.take(profiles)
    speed, gap = profiles.followers.T
    far = (gap > 2.0 * speed) & (speed > 1.0)
    assert limits.largest["efficiency"] == pytest.approx(float(far.double().mean()))
    assert 0.0 < limits.largest["efficiency"] < 1.0
    near = gap < 4.0 * (speed - profiles.speeds)
    assert limits.largest["safety"] == pytest.approx(float(near.double().mean()))
    with pytest.raises(ConfigError, match=r"agent\.limits\.efficiency=recorded: no driver was rec"):
        limits.take(wavy_profiles())


def test_the_record_says_shares_and_prices(tmp_path) -> None:
    trainer = make(
        tmp_path, "surrogates@agent=limits", "training.episodes=32", "agent.limit_rate=0.5"
    )
    rows = trainer.run()
    for name in ("safety", "efficiency"):
        assert rows[f"share_{name}"].between(0.0, 1.0).all()
        assert rows[f"price_{name}"].iloc[0] == 1.0
    over = rows["share_efficiency"] / 0.01 - 1.0
    expected = 0.5 * over.clip(-1.0, 1.0).shift(fill_value=0.0).cumsum()
    assert np.log(rows["price_efficiency"]).tolist() == pytest.approx(expected.tolist(), abs=1e-6)


def test_a_limit_of_each_record_raises_the_price_behind_that_record_only() -> None:
    known = {"spacing": ExcessSpacing()}
    limits = LimitsEach({"spacing": 0.5}, 0.1, known)
    limits.take(3)
    limits.begin(torch.tensor([[2], [0], [2]]))
    # In the mean 0.4, which a limit of all episodes would keep.
    row = limits.update({"spacing": torch.tensor([1.0, -0.4, 0.6])})
    assert row == {"most_spacing": pytest.approx(0.8), "price_each_spacing": 1.0}
    price = limits.price("spacing", torch.zeros(1)).flatten()
    assert torch.allclose(price.log(), torch.tensor([2.1 * 0.6, -2.1, 2.1 * 0.6]))
    assert limits.price("gap", price) == 0.0
    other = LimitsEach({"spacing": 0.5}, 0.1, known)
    other.take(3)
    other.load_state_dict(limits.state_dict())
    other.begin(torch.tensor([[1], [2]]))
    assert other.price("spacing", price).flatten().log().tolist() == pytest.approx([0.0, 1.26])
    with pytest.raises(ConfigError, match=r"agent\.limits_each: no recorded leader on this road"):
        limits.take(0)
    with pytest.raises(ConfigError, match=r"agent\.limits_each\.gap: there is no agent\.surrog"):
        LimitsEach({"gap": 0.5}, 0.1, known)


def test_a_training_keeps_a_price_behind_each_record(tmp_path) -> None:
    words = ("surrogates@agent=limits", "training.episodes=32", "agent.limit_rate=0.5")
    trainer = make(tmp_path / "one", *words, "+agent.limits_each.efficiency=0.0")
    rows = trainer.run()
    assert (rows["most_efficiency"] >= rows["share_efficiency"] - 1e-6).all()
    prices = {x.price("efficiency") for x in trainer.objective.each.records}
    assert rows["price_each_efficiency"].iloc[0] == 1.0 != rows["price_each_efficiency"].iloc[-1]
    again = make(tmp_path / "one", *words, "+agent.limits_each.efficiency=0.0")
    again.load()
    assert {x.price("efficiency") for x in again.objective.each.records} == prices


def test_path_energy_is_a2_without_what_the_motion_stores() -> None:
    term = PathEnergy().bind(World(energy=as_fleet(None)))
    speed, acceleration = torch.tensor([[[10.0]]]), torch.tensor([[[1.0]]])
    before = speed - 0.1
    expected = steady_power(before) + acceleration_loss(before, acceleration)
    assert torch.allclose(term.reward(speed, acceleration), -expected * 0.1 / 20000.0)
    # Braking is never paid for.
    assert (term.reward(speed, -3.0 * acceleration) < 0.0).all()
