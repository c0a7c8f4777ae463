"""Pieces of a user's own, named by ``_target_``, serve every strategy of an evaluation."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import pytest
from commands import UNTRAINED, tiny
from helpers import POPULATION, check_refused, compose, small_env, wavy_profiles

from lcc_rl.commands import evaluation
from lcc_rl.config.nodes import Node, as_plain
from lcc_rl.envs import build_env
from lcc_rl.errors import ConfigError
from lcc_rl.pieces import Controller, Feature, MotorPower, RewardTerm
from lcc_rl.settings import Positive, Settings, values


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


@dataclass(frozen=True)
class Band:
    name: str = "wide"
    ends: tuple[float, float] = (0.0, 1.0)


class Part(Settings):
    times: tuple[Positive, ...] = (1.0,)


class Typed(RewardTerm):
    """Settings of every type that the page on extending lists."""

    ends: tuple[float, float] = (1.0, 2.0)
    names: tuple[str, ...] | None = None
    corners: tuple[tuple[float, float], ...] = ((1.0, 2.0),)
    rows: list[tuple[int, float]] = field(default_factory=lambda: [(1, 2.0)])
    table: dict[str, tuple[float, float]] = field(default_factory=lambda: {"a": (1.0, 2.0)})
    sizes: Sequence[int] = (3, 4)
    kind: Literal["one", "two"] = "one"
    band: Band = Band()
    part: Part = Part()
    parts: tuple[Part, ...] = ()

    reads = ("self.jerk",)

    def reward(self, jerk):
        return self.ends[0] * jerk


GIVEN = {
    "ends": [3, 4.0],
    "names": ["x"],
    "corners": [[1.0, 3.0], [4.0, 5.0]],
    "rows": [[1, 3.0], [2, 4.0]],
    "table": {"b": [5.0, 6.0]},
    "sizes": [7],
    "band": {"name": "near", "ends": [0.5, 0.7]},
    "part": {"times": [2.0]},
    "parts": [{"times": [2.0]}, {}],
}


def test_settings_of_ones_own_may_be_of_these_types_and_are_stored_and_read_again() -> None:
    plain = Node.of({"_target_": f"{__name__}.Typed", "weight": 1.0}, "t")
    given = plain.changed(**GIVEN)
    for node in (plain, given):
        again = Node.of(json.loads(json.dumps(as_plain(node))), "t")
        assert as_plain(again) == as_plain(node)
        object_again = Node.of(values_of(node.made()), "t").made()  # as lcc_rl.compare takes it
        assert as_plain(values(object_again)) == as_plain(values(node.made()))
    made = given.made()
    assert (made.ends, made.names, made.sizes, made.kind) == ((3, 4.0), ("x",), [7], "one")
    assert (made.corners, made.rows) == (((1.0, 3.0), (4.0, 5.0)), [(1, 3.0), (2, 4.0)])
    assert made.table == {"a": (1.0, 2.0), "b": (5.0, 6.0)}
    assert made.band == Band("near", (0.5, 0.7))
    assert (made.part.times, [one.times for one in made.parts]) == ((2.0,), [(2.0,), (1.0,)])
    cases = [
        ({"ends": [1.0]}, r"t\.ends\[1\] "),
        ({"corners": [[1.0, "x"]]}, r"t\.corners\[0\]\[1\] must be a valid number, got 'x'"),
        ({"rows": [2.0]}, r"t\.rows\[0\] must be a valid tuple, got 2\.0"),
        ({"part": {"times": [-1.0]}}, r"t\.part\.times\[0\] must be greater than 0"),
        ({"part": {"tims": []}}, r"unknown setting of t\.part \(Part\) 'tims'; valid: times"),
        ({"kind": "three"}, r"t\.kind must be 'one' or 'two'|t\.kind .*'three'"),
        ({"ends": {1.0, 2.0}}, "which a configuration cannot store"),
    ]
    check_refused(lambda settings: plain.changed(**settings), cases, ConfigError)


class Nothing(Comfort):
    def reward(self, jerk):
        jerk.abs()


def test_what_is_no_term_of_the_reward_is_refused() -> None:
    cases = [
        ("scenario.pieces", "Comfort", r"scenario\.pieces\.x is a reward .* under reward\.terms"),
        ("reward.terms", "Kinetic", "x: expected a subclass of .*RewardTerm, got .*Kinetic"),
        ("reward.terms", "Nothing", "Nothing does not fit .*it returned None, not a tensor"),
    ]
    words = f"+{{}}.x={{{{_target_: {__name__}.{{}}}}}}"
    check_refused(lambda *given: small_env("alcc", 2, [words.format(*given)]), cases, ConfigError)


def values_of(made: Typed) -> dict[str, object]:
    return {"_target_": f"{__name__}.Typed", **values(made)}


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
