"""Pieces of a user's own, named by ``_target_``, serve every strategy of an evaluation."""

from __future__ import annotations

import pytest
from commands import UNTRAINED, tiny
from helpers import POPULATION, compose, wavy_profiles

from lcc_rl.commands import evaluation
from lcc_rl.envs import build_env
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

    role = "vehicles"
    reads = ("vehicles.speed",)
    writes = ("vehicles.kinetic",)

    def compute(self, speed):
        return 0.5 * speed.square()


POWER = f"scenario.pieces.power._target_={__name__}.DoublePower"
OWN = f"scenario.controllers.automated._target_={__name__}.KeepDistance"


def test_models_and_controllers_serve_every_strategy(tmp_path) -> None:
    plain, double, own = (
        evaluation.run(
            tiny("evaluate", "variant=idm", *words, agent=False), tmp_path / str(words), quiet=True
        )
        for words in ([], [POWER], [OWN])
    )
    # The same drives, measured by another model: direct has no automated vehicle.
    for name in ("cav_energy_kj", "hdv_energy_kj"):
        known = plain[name].notna()
        expected = 2.0 * plain[name][known].to_numpy()
        assert double[name][known].to_numpy() == pytest.approx(expected)
    assert plain.loc[plain["strategy"] == "idm", "cav_energy_kj"].notna().all()
    assert double["min_ttc_s"].equals(plain["min_ttc_s"])
    # A controller of one's own stands beside the baselines, which it does not change.
    assert list(own["strategy"].unique()) == [*UNTRAINED, "KeepDistance"]
    one, two = (rows[rows["strategy"] == "idm"].reset_index(drop=True) for rows in (own, plain))
    assert one[two.columns].equals(two)


def test_a_reward_term_and_an_entry_of_the_observation() -> None:
    cfg = compose(
        "alcc",
        f"+reward.terms.comfort={{_target_: {__name__}.Comfort, weight: 0.5}}",
        f"+scenario.pieces.kinetic={{_target_: {__name__}.Kinetic}}",
        "+observation.scales.self.kinetic=0.01",
    )
    data, plain = (
        build_env(tree, wavy_profiles(), POPULATION, 2).rollout(3) for tree in (cfg, compose())
    )
    expected = -0.5 * data["next", "vehicles", "jerk"][..., :1, :].abs()
    assert (data["next", "automated", "reward_terms", "comfort"] == expected).all()
    seen = data["automated", "observation"]
    assert seen.shape[-1] == plain["automated", "observation"].shape[-1] + 1
    kinetic = 0.005 * data["vehicles", "speed"][..., :1, :].square()
    assert ((seen - kinetic).abs() < 1e-6).any(-1).all()
