"""Pieces of a user's own, named by ``_target_``, serve every strategy of an evaluation."""

from __future__ import annotations

import pytest
from commands import UNTRAINED, tiny
from helpers import POPULATION, compose, wavy_profiles

from lcc_rl.commands import evaluation
from lcc_rl.envs import build_env

MODULE = '''
import torch
from lcc_rl.pieces import Controller, Feature, MotorPower, RewardTerm


class DoublePower(MotorPower):
    """Twice the power of the shipped model."""

    def compute(self, *entries):
        return 2.0 * super().compute(*entries)


class KeepDistance(Controller):
    reads = ("self.gap", "self.relative_speed")

    def command(self, gap, relative_speed):
        return (0.1 * (gap - 20.0) + 0.5 * relative_speed).clamp(-3.0, 3.0)


class Comfort(RewardTerm):
    reads = ("self.jerk",)

    def reward(self, jerk):
        return -jerk.abs()


class Kinetic(Feature):
    """Half the square of the speed."""

    def setup(self, world):
        key = ("vehicles", "kinetic")
        self.wire([("vehicles", "speed")], [key], (len(world.string), 1))

    def compute(self, speed):
        return 0.5 * speed.square()
'''
POWER = "scenario.pieces.power._target_=own_pieces.DoublePower"
OWN = "scenario.controllers.automated._target_=own_pieces.KeepDistance"


@pytest.fixture(autouse=True)
def own_pieces(tmp_path, monkeypatch):
    (tmp_path / "own_pieces.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")


def rows(folder, *overrides):
    return evaluation.run(tiny("evaluate", *overrides, agent=False), folder, quiet=True)


def test_a_power_model_measures_every_strategy(tmp_path) -> None:
    words = ("variant=alcc", "policy=pretrained")
    plain, own = rows(tmp_path / "a", *words), rows(tmp_path / "b", *words, POWER)
    assert set(own["strategy"]) == {*UNTRAINED, "alcc"}
    # The same drives, measured by another model: direct has no automated vehicle.
    for name in ("cav_energy_kj", "hdv_energy_kj"):
        known = plain[name].notna()
        assert own[name][known].to_numpy() == pytest.approx(2.0 * plain[name][known].to_numpy())
    assert plain.loc[plain["strategy"] == "idm", "cav_energy_kj"].notna().all()
    assert own["min_ttc_s"].equals(plain["min_ttc_s"])


def test_a_controller_is_evaluated_beside_the_baselines(tmp_path) -> None:
    own, plain = rows(tmp_path / "a", "variant=idm", OWN), rows(tmp_path / "b", "variant=idm")
    assert list(own["strategy"].unique()) == [*UNTRAINED, "keepdistance"]
    one, two = (x[x["strategy"] == "idm"].reset_index(drop=True) for x in (own, plain))
    assert one[two.columns].equals(two)


def test_a_reward_term_and_an_entry_of_the_observation() -> None:
    cfg = compose(
        "alcc",
        "+reward.terms.comfort={_target_: own_pieces.Comfort, weight: 0.5}",
        "+scenario.pieces.kinetic={_target_: own_pieces.Kinetic}",
        "+observation.scales.self.kinetic=0.01",
    )
    data = build_env(cfg, wavy_profiles(), POPULATION, 2).rollout(3)
    expected = -0.5 * data["next", "vehicles", "jerk"][..., :1, :].abs()
    assert (data["next", "automated", "reward_terms", "comfort"] == expected).all()
    seen = data["automated", "observation"]
    assert (
        seen.shape[-1]
        == build_env(compose(), wavy_profiles(), POPULATION, 2)
        .rollout(1)["automated", "observation"]
        .shape[-1]
        + 1
    )
    kinetic = 0.005 * data["vehicles", "speed"][..., :1, :].square()
    assert ((seen - kinetic).abs() < 1e-6).any(-1).all()
