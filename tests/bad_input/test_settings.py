"""Settings that are no numbers, not finite or out of range: one error that names the key."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from math import inf, nan

import pytest
import torch
from helpers import POPULATION, composed, wavy_profiles
from omegaconf import OmegaConf

from lcc_rl.config import TARGET, build, load, plain
from lcc_rl.drivers.population import fixed
from lcc_rl.envs import build_env
from lcc_rl.errors import ConfigError, require_in, require_positive, require_whole
from lcc_rl.functional.pattern import parse_string
from lcc_rl.pieces import Action, DriverEstimator, Observation, SafetyReward
from lcc_rl.pieces.world import World
from lcc_rl.schemas import RANGES, WHOLE, check_ranges

STRING = parse_string("automated human")
WORLD = World(STRING, 0.1, 20, wavy_profiles(), POPULATION)
RESOURCES = {
    "world": WORLD,
    "name": "automated",
    "population": POPULATION,
    "time_step": 0.1,
    "string": STRING,
    "observation": Observation(scales={"ahead": {"speed": 0.1}}).bind(WORLD),
    "observation_size": 7,
    "action_size": 1,
    "seed": 0,
}
AUTO, HUMAN = "scenario.controllers.automated", "scenario.controllers.human"
NEVER = (nan, 1e30, "abc")
POSITIVE, NOT_NEGATIVE, ANY = (0, -1, *NEVER), (-1, *NEVER), NEVER
SHARE, WHOLE_ONE = (-0.1, 1.5, *NEVER), (0, -1, 1.5, *NEVER)
# The node of a configuration by overrides and place, and bad values of its settings; of fields one
# of each kind, and what one setting says about another.
NODES = (
    ("", AUTO, {"max_acceleration": POSITIVE}),
    ("", HUMAN, {"noise": (-0.1, 1, *NEVER), "time_gap": POSITIVE, "delay": (-1, 1.5, 1001)}),
    (f"controller@{AUTO}=handover", AUTO, {"from_s": NOT_NEGATIVE}),
    (
        f"controller@{AUTO}=follower_stopper",
        AUTO,
        {
            "window": (0, 4000.0),
            "gaps": ([1, 2], [0, 1, 2], [3, 2, 1], [1, 2, nan], ["a", 1, 2], 3),
            "decelerations": ([1, 2, 0], [], None),
        },
    ),
    ("variant=cacc", AUTO, {"k1": ANY, "k2": (5, *ANY)}),
    ("variant=deadbeat", AUTO, {"lookahead": ("soon", 1)}),
    ("variant=hcfs", "deployed", {"braking": (0, 3.5, nan), "rule.k1": ANY}),
    ("", "scenario.start.automated", {"gap_range": ([1], [2, 1], [0, 1], [nan, 1], [1, 1e30], 1)}),
    ("variant=ddpg", "scenario.start.automated", {"gap_spread": (5, *NOT_NEGATIVE)}),
    ("variant=ddpg", "scenario.pieces.communication", {"connected": ("automated", [1])}),
    ("", "scenario.pieces.leader", {"profile": (-1, 4, 1.5, nan)}),
    ("", "scenario.pieces.power", {"recuperation": (2, "perhaps", None)}),
    ("", "scenario.pieces.estimator", {"learning_time": (-1, nan, inf, "abc")}),
    ("+filter=cbf", "scenario.filters.automated", {"shortest_time_gap": (3.0, *POSITIVE)}),
    ("+knowledge=preview", "scenario.pieces.preview", {"horizons": ([], [-1], [nan], ["a"], 1)}),
    (
        "+knowledge=memory",
        "scenario.pieces.memory",
        {"seconds": ([], [0], [nan], [1e30], ["a"], 1), "sources": ([], [1], "self.gap")},
    ),
    ("", "observation", {"visible": (*WHOLE_ONE, 10**30), "scales.self.gap": (0, nan, "abc")}),
    ("", "reward.terms.safety", {"weight": NOT_NEGATIVE, "floor": (0, 4, nan)}),
    ("", "reward.terms.cav_energy", {"scale": POSITIVE, "of": ("all", 1)}),
    (
        "",
        "agent",
        {
            **dict.fromkeys(("actor_lr", "critic_lr", "updates_per_transition"), POSITIVE),
            "gamma": (-0.1, 1, *NEVER),
            "tau": (0, *SHARE),
            "saturation": NOT_NEGATIVE,
            "final_lr_fraction": (0, *SHARE),
            "exploration.initial": NOT_NEGATIVE,
            "exploration.decay_share": (0, *SHARE),
        },
    ),
    ("agent=td3", "agent", {"policy_noise": NOT_NEGATIVE, "policy_delay": WHOLE_ONE}),
    ("agent=sac", "agent", {"alpha_init": POSITIVE, "target_entropy": (nan, "abc")}),
    (
        "agent=analytic",
        "agent",
        {
            **dict.fromkeys(("learning_rate", "clip_norm", "value_lr"), POSITIVE),
            "gamma": (0, *SHARE),
            "td_lambda": SHARE,
            "value_every": WHOLE_ONE,
            "tau": (0, *SHARE),
            "surrogates.safety.width": POSITIVE,
            "surrogates.efficiency.speed_floor": POSITIVE,
        },
    ),
    ("", "data", {"noise": (-0.1, 1, *NEVER), "seed": (-1, 1.5, nan), "duration_s": ([9, 1], 3)}),
    ("", "data", {"leader.wave_s": POSITIVE, "leader.wave_spread_mps": NOT_NEGATIVE}),
    ("", "data", {"criteria.min_duration_s": (0, *NOT_NEGATIVE), "criteria.max_gap_m": (-1, nan)}),
    ("", "split", {"evaluation_share": (0, 1.1, *NEVER), "by": ("colour", 1)}),
    ("drivers=fixed", "drivers", {"desired_speed": POSITIVE, "min_gap": POSITIVE}),
    ("drivers=kde", "drivers", {"drivers": WHOLE_ONE, "seed": (-1,), "bandwidth": (0, nan)}),
    ("variant=ddpg", "leader", {"least_variation": NOT_NEGATIVE}),
    ("drivers=highway", "drivers", {"least_speed": POSITIVE}),
)
CALIBRATION = {
    "bounds.time_gap": ([2, 1], [0, 1], [1], [1, nan], 3),
    "constants.acceleration": POSITIVE,
    "constants": (3,),
    "selection.min_gap_m": NOT_NEGATIVE,
    "local_genetic.mutation_rate": SHARE,
    "local_genetic.generations": WHOLE_ONE,
    "local_genetic.tolerance": NOT_NEGATIVE,
    "modes": (["loacl"], [], "local"),
}


def cases() -> Iterator[tuple[str, str, str, object]]:
    for override, place, settings in NODES:
        for key, values in settings.items():
            yield from ((override, place, key, value) for value in values)


@cache
def node_of(override: str, place: str) -> dict:
    return plain(OmegaConf.select(composed(*filter(None, [override])), place))


@pytest.mark.parametrize(("override", "place", "key", "value"), list(cases()))
def test_a_bad_number_is_one_error_that_names_the_setting(override, place, key, value) -> None:
    refused(node_of(override, place), place, key, value, RESOURCES)


@pytest.mark.parametrize(("override", "place"), sorted({node[:2] for node in NODES}))
def test_the_rest_of_each_node_is_right(override, place) -> None:
    build(node_of(override, place), place, **RESOURCES)


@pytest.mark.parametrize(("key", "value"), [(k, v) for k, vs in CALIBRATION.items() for v in vs])
def test_a_bad_setting_of_the_calibration_is_named(key, value) -> None:
    refused(CALIBRATE, "calibration", key, value, {})


CALIBRATE = plain(load("calibrate").calibration)


def refused(node, place, key, value, resources) -> None:
    node = OmegaConf.create(node)
    OmegaConf.update(node, key, value, merge=False)
    with pytest.raises(ConfigError) as caught:
        build(node, place, **resources)
    said = str(caught.value)
    assert "\n" not in said
    assert re.search(rf"\b{re.escape(key.rpartition('.')[2])}|modes?\b|kv = ", said), said


@pytest.mark.parametrize("value", [nan, inf, -inf, 1e30, 10**30])
def test_every_number_of_every_shipped_node_must_be_finite(value) -> None:
    cfg = OmegaConf.create(plain(composed("variant=hcfs", "+knowledge=[memory,preview]")))
    places = list(numbers(plain(cfg)))
    assert len(places) > 100
    for key in places:
        before = OmegaConf.select(cfg, key)
        OmegaConf.update(cfg, key, value)
        with pytest.raises(ConfigError, match=re.escape(key)):
            check_ranges(cfg)
        OmegaConf.update(cfg, key, before)
    check_ranges(cfg)


def numbers(node, place: str = "") -> Iterator[str]:
    items = node.items() if isinstance(node, dict) else enumerate(node)
    for key, item in items:
        path = f"{place}[{key}]" if isinstance(node, list) else f"{place}.{key}".lstrip(".")
        if isinstance(item, dict | list):
            yield from numbers(item, path)
        elif isinstance(item, int | float) and not isinstance(item, bool):
            yield path


SCHEMA = [(key, value) for key in RANGES for value in (-1.0, nan, inf, 1e30)]
SCHEMA += [(key, value) for key in WHOLE for value in (-1, 10**15 + 1)]


@pytest.mark.parametrize(("key", "value"), SCHEMA)
def test_numbers_of_the_schema_are_in_their_range(key, value) -> None:
    cfg = OmegaConf.create({key.partition(".")[0]: {}})
    OmegaConf.update(cfg, key, value)
    with pytest.raises(ConfigError, match=key.rpartition(".")[2]):
        check_ranges(cfg)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("scenario.time_step=nan", r"scenario\.time_step must lie in \[0\.001, 10\], got nan"),
        (
            "scenario.horizon=0",
            r"horizon must be a whole number from 1 to 1000000, got 0",
        ),
        ("scenario.horizon=2.5", r"scenario\.horizon=2\.5: Value '2\.5' .* Integer"),
        ("training.gap_range=[inf,1]", r"automated\.gap_range\[0\] must be a finite number"),
        ("training.gap_range=wide", r"training\.gap_range"),
        ("seed=-1", r"^seed must be a whole number from 0 to 2147483647, got -1"),
        ("scenario.initial_speed=${nowhere}", r"nowhere"),
    ],
)
def test_they_are_refused_when_a_configuration_is_composed(override, words) -> None:
    with pytest.raises(ConfigError, match=words):
        load("train", [override])


def test_a_configuration_changed_in_python_is_checked_when_the_environment_is_built() -> None:
    cfg = composed("variant=alcc")
    cfg.scenario.time_step = -1.0
    with pytest.raises(
        ConfigError, match=r"scenario\.time_step must lie in \[0\.001, 10\], got -1"
    ):
        build_env(cfg, wavy_profiles(), POPULATION)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Action(max_acceleration=nan), r"Action\.max_acceleration must be a finite number"),
        (lambda: Action(max_acceleration="3"), r"max_acceleration must be a valid number, got '3'"),
        (
            lambda: SafetyReward(weight=-1),
            r"^SafetyReward\.weight must be greater than or equal to 0, got",
        ),
        (lambda: fixed(time_gap=nan), r"drivers\.time_gap must be positive"),
        (lambda: fixed(min_gap=-1), r"IDM\.min_gap must be positive"),
        (lambda: require_in("a", "[0, 1)", b=1), r"a\.b must lie in \[0, 1\), got 1$"),
        (
            lambda: require_positive("a", b=inf),
            r"a\.b must be positive, and a finite number up to 1e",
        ),
        (lambda: require_whole("", 0, 5, b=6), r"^b must be a whole number from 0 to 5, got 6$"),
    ],
)
def test_python_users_get_the_same_error(make, words) -> None:
    with pytest.raises(ConfigError, match=words):
        make()


def test_without_a_learning_time_the_population_mean_is_predicted_throughout() -> None:
    cfg = composed("variant=alcc", "scenario.pieces.estimator.learning_time=null")
    node = cfg.scenario.pieces.estimator
    assert isinstance(build(node, "estimator", **RESOURCES), DriverEstimator)
    assert build(node, "estimator", **RESOURCES).learning_steps == inf


def test_bounds_themselves_are_in_range() -> None:
    require_in("a", "[0, 1]", b=0, c=1)
    require_in("a", "(-inf, inf)", b=-1e9, c=1e9)
    require_whole("a", 1, b=1, c=10**15)
    assert torch.tensor(1e9).square().isfinite()


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("+agent.exploration.inital=1", r"agent\.exploration 'inital'.*Did you mean 'initial'"),
        ("agent.exploration=fast", "exploration must be mapping of float"),
        ("agent.exploration={initial: many}", "exploration must be mapping of float"),
        ("agent.hidden=[many]", "hidden must be list of int"),
        ("agent.fused=1", "fused must be bool"),
    ],
)
def test_types_inside_lists_and_mappings(override, words) -> None:
    with pytest.raises(ConfigError, match=words):
        build(composed("variant=alcc", override).agent, "agent", **RESOURCES)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("leader.training.udds.scale=0", r"scale must be greater than 0"),
        ("leader.training.udds.scale=abc", r"leader\.training\.udds\.scale must be a valid number"),
        (
            "leader.training.udds.from_s=abc",
            r"leader\.training\.udds\.from_s must be a valid number",
        ),
        ("leader.training.udds=5", r"leader\.training\.udds must be a mapping"),
        (
            "leader.cases.case_1.followers=0",
            r"case_1\.followers must be greater than or equal to 1",
        ),
        ("leader.cases.case_1.start_s=-1", r"case_1\.start_s must be greater than or equal to 0"),
        ("leader.training=3", r"leader\.training must be a valid dictionary"),
    ],
)
def test_stretches_and_cases_of_a_leader(override, words) -> None:
    with pytest.raises(ConfigError, match=words):
        build(composed("variant=ddpg", override).leader, "leader").load(0.2, 100, 6)


def test_a_node_of_something_else_is_no_number(tmp_path) -> None:
    node = plain(composed("variant=alcc").data)
    assert TARGET in node
    node["leader"] = 3.0
    with pytest.raises(ConfigError, match=r"data\.leader must be StopAndGo \(a node with _target_"):
        build(node, "data")
