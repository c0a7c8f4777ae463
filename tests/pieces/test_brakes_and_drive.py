"""One limit of brakes and drive of automated vehicles, for every controller, filter and policy."""

from __future__ import annotations

from importlib.util import find_spec

import pytest
import torch
from helpers import POPULATION, check_refused, composed, play
from torch import Tensor

import lcc_rl
from lcc_rl.config import load
from lcc_rl.data.profiles import Profiles, from_records
from lcc_rl.envs import build_env
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.strategies import Strategy, baseline, trained
from lcc_rl.functional.pattern import RING, parse_string
from lcc_rl.pieces import CACC, Action, Actuation, CBFFilter, FollowerStopper
from lcc_rl.pieces.cruise import IDMACC
from lcc_rl.pieces.world import World
from lcc_rl.results.policies import SHIPPED_POLICIES, load_policy

STRONG = ("scenario.max_braking=6", "scenario.horizon=160")
FILTERED = (*STRONG, "+filter=cbf", "scenario.filters.automated.braking_ahead=6")
RULES = ("acc", "idm_acc", "follower_stopper", "pi_saturation", "calm", "constant", "idm", "gipps")
MORE = ("ovm", "fvdm", *["mpc"] * bool(find_spec("osqp")))
SEEN = [("vehicles", name) for name in ("gap", "acceleration", "ttc")]
AUTO = "scenario.controllers.automated"


def braking_leaders(time_step: float) -> Profiles:
    """Leaders that brake by 6 m/s² to standstill after 5 s at 12, 24 and 36 m/s."""
    time = torch.arange(1 + round(30.0 / time_step)) * time_step
    records = [(v - 6.0 * (time - 5.0).clamp(min=0.0)).clamp(min=0.0) for v in (12.0, 24.0, 36.0)]
    names = [f"braking/{i}@0s" for i in range(3)]
    return from_records(records, names, ["braking"] * 3, time_step)


def driven(strategy: Strategy) -> dict[str, Tensor]:
    """Play each of the leaders from its first sample; return gaps, accelerations and TTC."""
    cfg = strategy.cfg
    leaders = braking_leaders(cfg.scenario.time_step)
    env = build_env(cfg, leaders, POPULATION, 3, nominal=True)
    start = env.reset().empty()
    number = torch.arange(3).unsqueeze(-1)
    start["leader", "profile"], start["leader", "start"] = number, torch.zeros_like(number)
    record, alive = play(env, strategy.policy, start, SEEN)
    assert alive.all(), f"{strategy.name}: collision"
    return {name: entry[..., :1, :] for (_, name), entry in record.items()}


def check_safe(strategy: Strategy) -> None:
    found = driven(strategy)
    assert found["gap"].min() > 0.0, strategy.name
    assert found["ttc"].min() >= 4.0, strategy.name
    assert found["acceleration"].min() < -5.0, f"{strategy.name} has stronger brakes"


def test_no_rule_collides_behind_a_leader_that_brakes_as_hard_as_declared() -> None:
    cfg = composed("variant=alcc", *FILTERED)
    for name in (*RULES, *MORE):
        check_safe(baseline(cfg, f"{name}_filtered"))
    for name in ("cacc", "deadbeat"):
        cfg = composed(f"variant={name}", *FILTERED, "scenario.horizon=100")
        check_safe(baseline(cfg, name))


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(path.stem for path in SHIPPED_POLICIES.glob("*.pt")))
def test_no_policy_collides_behind_a_leader_that_brakes_as_hard_as_declared(name) -> None:
    policy = load_policy(f"pretrained/{name}")
    own, words = policy[1], FILTERED
    if own.scenario.name == "platoon":
        words = (*FILTERED, "scenario=platoon", "scenario.horizon=100")
    cfg = composed(f"variant={own.variant}", f"scenario.name={own.scenario.name}", *words)
    check_safe(trained(cfg, f"pretrained/{name}", policy, POPULATION))


def test_filters_that_expect_weaker_brakes_than_the_cars_ahead_have(caplog) -> None:
    leader = [25.0] * 51 + [max(0.0, 25.0 - 0.26 * n) for n in range(150)]
    hint, weak = (f"scenario.filters.automated.{x}" for x in ("braking_ahead=3", "max_accel"))
    for string, override, collides, said in (
        ("automated*8", "", True, True),
        ("automated*8", hint, False, False),
        ("automated*8", f"{weak}eration=2.6", False, False),
        ({"size": 8, "penetration": 0.5}, "", None, True),
        ("automated human automated", "", None, False),
    ):
        caplog.clear()
        settings = ["+filter=cbf", *filter(None, [override])]
        found = lcc_rl.simulate(leader, string, "constant_filtered", overrides=settings)
        assert collides in (None, found.vehicles["collided"].any()), (string, override)
        lines = [x for x in caplog.messages if "(scenario.max_braking)" in x and hint in x]
        assert len(lines) == said, (string, override)
    assert parse_string("automated human automated", RING).follows("automated")


def test_the_limits_hold_for_commands_of_every_kind() -> None:
    strong = World(max_braking=6.0, max_acceleration=2.0)
    cases = (
        (IDMACC(), strong, (-6.0, 2.0)),
        (IDMACC(max_acceleration=2.5), strong, (-2.5, 2.0)),
        (IDMACC(max_acceleration=3.0), strong, (-3.0, 2.0)),
        (CACC(max_acceleration=3.0), World(max_braking=6.0, max_acceleration=6.0), (-3.0, 3.0)),
        (FollowerStopper(), strong, (-6.0, 1.5)),
        (FollowerStopper(max_deceleration=2.0), strong, (-2.0, 1.5)),
        (Action(), World(max_braking=6.0), None),  # its scale is that of the training
        (Action(), World(max_braking=2.0), (-2.0, 3.0)),
        (IDMACC(), World(), (-3.0, 3.0)),
    )
    for piece, world, expected in cases:
        assert piece.bind(world).limits == expected, piece
    action = torch.tensor([[[-1.0]], [[1.0]]])
    assert Action().bind(World(max_braking=2.0)).compute(action).flatten().tolist() == [-2.0, 3.0]
    human = IDMACC().bind(World(max_braking=6.0), "human")
    assert human.limits == (-3.0, 3.0)  # limits of automated vehicles only
    for limit, least in ((3.0, -6.0), (2.5, -2.5)):  # a filter's 3 does not lower
        assert CBFFilter(max_acceleration=limit).bind(strong, "automated").least == least


def test_limits_without_effect_are_refused() -> None:
    cases = [
        (lambda: IDMACC(max_acceleration=6.0).bind(), r"max_acceleration=6 exceeds .*max_braking"),
        (lambda: Action(max_acceleration=6.0).bind(), "max_acceleration=6 exceeds the limits"),
        (lambda: FollowerStopper(max_deceleration=6.0).bind(), "max_deceleration=6 exceeds"),
        (
            lambda: Actuation(braking=5.0).bind(World(), "automated"),
            r"actuators\.automated\.braking=5\.0 has no effect above scenario\.max_braking=3",
        ),
        (
            lambda: lcc_rl.compare("acc", overrides=[f"+{AUTO}.max_acceleration=6"]),
            "has no effect: every controller is named",
        ),
        (
            lambda: lcc_rl.export(FollowerStopper(max_deceleration=6.0), "x.c"),
            r"brake by at most 3 m/s² \(limits\.max_braking\)",
        ),
    ]
    check_refused(lambda call: call(), cases, ConfigError)
    none = "scenario.max_braking=6 has no effect: "
    words = {
        "variant=direct scenario.max_braking=6": f"{none}no vehicle of the string is automated",
        "+faults=actuation scenario.max_braking=6": rf"{none}.*automated.braking=2\.8 is less",
        "scenario.max_braking=-1": "max_braking must be greater than 0",
        "scenario.max_acceleration=60": "less than or equal to 12, got",
    }
    check_refused(lambda given: load("train", given.split()), words.items(), ConfigError)
