"""Environments of every variant and of mixed strings: specs, TorchRL's vectors, refused shapes."""

from __future__ import annotations

import pytest
import torch
from helpers import (
    ACTION,
    OBSERVATION,
    PLATOON,
    POPULATION,
    VARIANTS,
    check_refused,
    compose,
    composed,
    single_env,
    small_env,
    string,
    wavy_profiles,
)
from torch import Tensor
from torchrl.envs import check_env_specs

from lcc_rl.envs import Inputs, build_env, make_env
from lcc_rl.envs.checks import check_pieces
from lcc_rl.envs.step import pieces_of
from lcc_rl.errors import ConfigError
from lcc_rl.functional.pattern import parse_string
from lcc_rl.pieces import (
    Action,
    Feature,
    NGSIMLeader,
    RolePlaces,
    StringMotion,
    TimeGapStart,
    TimeToCollision,
)
from lcc_rl.pieces.world import World

RING = ("scenario=ring", "scenario.horizon=20", "scenario.circumference=200")
MIXTURES = {
    "pattern": ("alcc", (string("human*2 (automated human*2)*2"),)),
    "drawn": ("alcc", ("scenario.string={size: 6, penetration: 0.34}",)),
    "ring": ("reference", (*RING, string("human*2 automated human*2 automated"))),
    "drawn ring": ("reference", (*RING, "scenario.string={size: 6, penetration: 0.34}")),
    "platoon with a human": ("ddpg", (string("automated*2 human automated*2"),)),
    "CACC with a human": ("cacc", (string("automated*2 human automated*2"),)),
    "hybrid with a human": ("hcfs", (string("automated*2 human automated*2"),)),
    "two roles": ("alcc", (string("automated cacc human"), "+gains=tuned")),
}
CACC = (
    "+controller@scenario.controllers.cacc=cacc",
    "+scenario.start.cacc={_target_: lcc_rl.pieces.TimeGapStart}",
    "+scenario.pieces.communication={_target_: lcc_rl.pieces.Communication, connected: [cacc]}",
)


def mixture(name: str, batch_size=()):
    variant, overrides = MIXTURES[name]
    overrides = (*overrides, *CACC) if name == "two roles" else overrides
    cfg = composed(f"variant={variant}", "scenario.horizon=20", *overrides).after_training()
    return build_env(cfg, wavy_profiles(), POPULATION, batch_size)


def test_specs_of_mixed_strings(subtests) -> None:
    for number, name in enumerate(MIXTURES):
        with subtests.test(name=name):
            check_env_specs(mixture(name, ((), 3)[number % 2]), break_when_any_done="both")


def test_specs_of_the_single_agent_view(subtests) -> None:
    variants = [v for v in VARIANTS if v != "direct"]
    for number, variant in enumerate(variants):
        with subtests.test(variant=variant):
            alone = [string("automated")] if variant in PLATOON else []
            env = single_env(variant, ((), 3)[number % 2], alone)
            check_env_specs(env, break_when_any_done="both")
            shape = env.batch_size
            assert env.full_reward_spec["reward"].shape == (*shape, 1)
            data = env.rollout(3)
            assert data["observation"].shape[:-1] == (*shape, 3)
            assert data["next", "reward"].shape == (*shape, 3, 1)
            assert OBSERVATION not in data.keys(True)


def test_who_may_ask_for_the_single_agent_view(monkeypatch) -> None:
    inputs = Inputs(wavy_profiles(), wavy_profiles(), POPULATION)
    monkeypatch.setattr("lcc_rl.envs.factory.shared_inputs", lambda cfg: inputs)
    tiny = ["scenario.horizon=20"]
    assert "action" in make_env("alcc", 2, tiny).full_action_spec.keys(True, True)
    # Where a rule drives, there is an observation and a reward, but no action.
    ruled = make_env("idm", 2, tiny)
    assert not list(ruled.full_action_spec.keys(True, True))
    check_env_specs(ruled)
    group = make_env("alcc", 2, tiny, single=False)
    assert set(group.full_action_spec.keys(True, True)) == {ACTION}
    with pytest.raises(ConfigError, match="single=True needs one automated vehicle, the string ha"):
        make_env("alcc", 2, [*tiny, string("automated*2")], single=True)


# -- what is refused when an environment is built --------------------------------------------------

PROFILES = wavy_profiles()
WORLD = World(parse_string("automated*4"), horizon=20, profiles=PROFILES)
MOTION = StringMotion(start={"automated": TimeGapStart()})


def pieces(*more):
    needed = (NGSIMLeader(), RolePlaces(), Action(), MOTION)
    return [*(piece.bind(WORLD) for piece in needed), *more]


def check(*more) -> None:
    check_pieces(pieces(*more), 20, {ACTION: (4, 1)})


class Wide(Feature):
    """Writes a row per pair of vehicles where its spec says a row per vehicle."""

    role = "vehicles"
    reads = ("vehicles.gap",)
    writes = ("vehicles.wide",)

    def compute(self, gap: Tensor) -> Tensor:
        return gap.unsqueeze(-2).expand(*gap.shape[:-1], 4, 1)


class Misnamed(Wide):
    """Names a leaf as the group of all vehicles."""

    writes = ("vehicles.vehicles",)


class Broken(Feature):
    """Cannot compute on such a string."""

    role = "vehicles"
    reads = ("vehicles.gap",)
    writes = ("vehicles.broken",)

    def compute(self, gap: Tensor) -> Tensor:
        return gap + torch.zeros(3, 1)


def test_a_piece_that_does_not_fit_is_refused() -> None:
    three = World(parse_string("automated*3"))
    cases = {
        Wide().bind(WORLD): r"Wide writes vehicles\.wide as \[4, 4, 1\] .* expected \[4, 1\]",
        Misnamed().bind(
            WORLD
        ): r"Misnamed writes vehicles\.vehicles, but 'vehicles' is a group .* a",
        Broken().bind(
            WORLD
        ): r"Broken fails: RuntimeError: The size of tensor .*\(.*test_strings.py:\d+\)",
        MOTION.bind(
            WORLD
        ): r"vehicles\.speed is written by more than one piece: \['StringMotion', ",
        TimeToCollision().bind(three): r"vehicles\.ttc as \[4, 1\] .* expected \[3, 1\]",
        Action().bind(WORLD, "other"): r"reads other\.action, but only automated vehicles have an",
    }
    check_refused(check, cases.items(), ConfigError)


REFUSED = {  # by variant and settings
    "alcc; scenario.pieces.time_gap=null": r"reads vehicles\.time_gap, which no piece",
    "alcc; scenario.pieces.estimator=null": r"reads human\.predicted_acceleration, which",
    "ddpg; scenario.pieces.communication=null": r"reads vehicles\.gap_error, which no",
    f"alcc; {string('automated truck')}": "has the role 'truck', but scenario.controllers nam",
    "alcc; scenario.road=ring; +event=cut_in": r"no leader .*cut_out\), an open road needs one$",
    "alcc; scenario.circumference=100": "circumference=100 has no effect: it belongs to",
    "alcc; scenario.filters={auto: null}": r"unknown role \(scenario\.filters\) 'auto'",
    "alcc; scenario.start.human=null": r"scenario\.start has no entry for human",
    "alcc; reward.terms=null": "terms",
}


def test_a_configuration_that_does_not_fit_is_refused() -> None:
    def build(words: str) -> None:
        variant, *overrides = words.split("; ")
        small_env(variant, 2, overrides)

    check_refused(build, REFUSED.items(), ConfigError)


def test_a_role_without_vehicles_has_no_pieces() -> None:
    cfg, plain = compose("alcc", "+faults=all").without_automated(), small_env("direct", 2)
    further = build_env(cfg, wavy_profiles(), POPULATION, 2)
    assert list(map(type, pieces_of(further))) == list(map(type, pieces_of(plain)))
