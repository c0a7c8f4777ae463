"""What an environment is made, reset and stepped with in Python, and pieces that remember."""

from __future__ import annotations

import traceback
from collections import deque

import numpy as np
import pytest
import torch
from commands import DATA
from helpers import check_refused, compose, play, single_env, small_env, wavy_profiles
from tensordict import TensorDict
from torch import nn
from torchrl.envs import RewardSum, SerialEnv, TransformedEnv

from lcc_rl.config.nodes import Node
from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs import DifferentiableRollout, StringCollector, build_env, make_env
from lcc_rl.errors import ConfigError
from lcc_rl.functional.guard import _variables
from lcc_rl.interfaces.driver import Driver
from lcc_rl.pieces import Controller, Feature, Law, RewardTerm
from lcc_rl.pieces.base import REWARD
from lcc_rl.settings import path_of

PROFILE, START, DRIVER = ("leader", "profile"), ("leader", "start"), ("human", "driver")
SEED, GAP = ("episode", "seed"), ("vehicles", "gap")
BAD = [
    ({("humn", "driver"): torch.zeros(2, 1, 1).long()}, r"humn\.driver is no .*those that exist"),
    ({GAP: torch.zeros(2, 2, 1)}, r"vehicles\.gap is no .*episode\.seed, leader\.profile"),
    ({("episode", "step"): torch.zeros(2, 1).long()}, r"episode\.step is no reset option"),
    ({DRIVER: torch.zeros(2, 1, 1)}, r"human\.driver must be \[2, 1, 1\] torch.int64, got"),
    ({DRIVER: torch.zeros(2, 3, 1).long()}, r"human\.driver must be .* got \[2, 3, 1\]"),
    ({DRIVER: torch.full((2, 1, 1), 10**6)}, r"human\.driver must lie in 0…\d+, got 1000000"),
    ({SEED: torch.tensor([[1], [-3]])}, r"episode\.seed must lie in 0…4294967295, got -3"),
    ({PROFILE: torch.tensor([[0], [4]])}, r"leader\.profile must lie in 0…3, got 4"),
    ({START: torch.tensor([[0], [380]])}, r"leader\.start must lie in 0…379, got 380"),
]


@pytest.fixture(scope="module")
def envs():
    return {"group": small_env("alcc", 2), "single": single_env("alcc", 2)}


def test_a_bad_reset_option_is_named(envs) -> None:
    for env in envs.values():
        check_refused(lambda given, env=env: env.reset(options=given), BAD)


def test_every_way_to_reset_refuses_them(envs) -> None:
    env, given = envs["group"], TensorDict({GAP: torch.zeros(2, 2, 1)}, [2])
    with pytest.raises(ConfigError, match=r"vehicles\.gap is no"):
        play(env, lambda td: td, given, [REWARD])
    with pytest.raises(ConfigError, match=r"vehicles\.gap is no"):
        DifferentiableRollout(env, nn.Identity(), [REWARD]).start(given)
    with pytest.raises(ConfigError, match=r"TensorDict of \[2\] episodes, .* got \[3\]"):
        env.reset(TensorDict({SEED: torch.zeros(3, 1).long()}, [3]))
    with pytest.raises(ConfigError, match=r"episode\.seed must be \[2, 1\]"):
        env.reset(options={SEED: torch.zeros(3, 1).long()})


def test_what_is_no_argument_of_a_reset_is_refused(envs) -> None:
    cases = [
        ({"tensordict": 5}, r"TensorDict of \[2\] episodes, .* got 5"),
        ({"options": 5}, "options must be entries by key, got 5"),
        ({"seed": 5}, r"reset takes no seed; env\.set_seed"),
    ]
    check_refused(lambda given: envs["single"].reset(**given), cases)
    for env in (SerialEnv(2, lambda: small_env()), TransformedEnv(envs["group"], RewardSum())):
        check_refused(lambda given, env=env: env.reset(**given), cases[1:])


def test_what_torchrl_itself_resets_is_no_option(envs) -> None:
    for env in envs.values():
        assert env.rollout(45, break_when_any_done=False).shape == (2, 45)
    collector = StringCollector(envs["group"], None, frames_per_batch=90)
    assert collector.collect().shape == (2, 45)


def test_an_impossible_batch_seed_or_device() -> None:
    devices = ["banana", *([] if torch.cuda.is_available() else ["cuda"])]
    cases = [
        ({"batch_size": 10**30}, r"batch_size=.* needs about \d+.* of memory"),
        *(({"seed": seed}, "seed must be") for seed in (-1, 2**32, 1.0, True, "1")),
        ({"held_out": "no"}, "held_out must be True or False, got 'no'"),
        ({"single": 1}, "single must be True or False, got 1"),
        *(({"device": name}, f"device '{name}' is not available") for name in devices),
    ]
    words = [*DATA, "scenario.horizon=300"]
    check_refused(
        lambda given: make_env("alcc", **{"batch_size": (), **given}, overrides=words), cases
    )


def test_settings_of_trainings_have_no_effect_on_an_environment() -> None:
    cases = [
        ("seed=7", r"^seed=7 has no .*: use make_env\(seed=…\), or reset\(seed=…\) in Gymnasium"),
        ("training={environments: 3}", r"use make_env\(batch_size=…\)"),
        ("agent.hold=5", r"^agent\.hold=5 .*: use scenario\.controllers\.automated\.hold=…"),
        ("agent.humans_first=5", "has no effect: it belongs to the learners of lcc-rl train"),
        *((f"evaluation.{x}=3", "has no effect: nothing is eval") for x in ("drivers", "profiles")),
        ("evaluation={seed: 3}", "nothing is evaluated"),
    ]
    check_refused(lambda word: make_env("alcc", overrides=[word]), cases)
    cases = [
        ("training.gap_range=[1,1]", "only episodes of a training draw it"),
        ("scenario.controllers.human.time_gap_range=[1,2]", "only episodes of a training draw it"),
        ("agent.hold=5", "has no effect"),
        ("evaluation.batch_size=3", "nothing is evaluated"),
    ]
    check_refused(lambda word: make_env("alcc", overrides=[word], held_out=True), cases)
    assert make_env("alcc", 2, ["experiment=smoke", "training.gap_range=[0.5,0.6]"])
    given = ["experiment=smoke", "evaluation.profiles=1", "agent=ppo"]
    assert make_env("alcc", 2, given, held_out=True)


def test_seeds_that_would_play_the_same_episodes_are_refused(envs) -> None:
    env = envs["group"]
    env.set_seed(2**32 - 1)
    last = env.reset()[SEED]
    env.set_seed(0)
    assert not torch.equal(env.reset()[SEED], last)
    for seed in (2**32, 2**33, -1):
        with pytest.raises(ConfigError, match="seed must be a whole number from 0 to 4294967295"):
            env.set_seed(seed)


def test_a_wrong_setting_is_one_traceback() -> None:
    wrong = ("wrong.option=1", "seed", "agent=dddpg", "scenario.horizon=0", "--config-dir=x")
    for typed in (*wrong, None, 3, [3]):
        with pytest.raises(ConfigError) as caught:
            make_env(overrides=typed)
        text = "".join(traceback.format_exception(caught.value))
        assert text.count("Traceback") == 1, typed


def test_an_action_of_another_shape_or_type(envs) -> None:
    three = small_env("ddpg", 2, ["scenario.string=automated*3"])
    cases = [
        (envs["single"], torch.zeros(2), r"\[2, 1\]"),
        (envs["single"], torch.zeros(2, 1, dtype=torch.float64), r"\[2, 1\]"),
        (three, torch.zeros(2, 1, 1), r"\[2, 3, 1\]"),
        (three, torch.zeros(2, 3, 1, dtype=torch.int64), r"\[2, 3, 1\]"),
    ]
    check_refused(
        lambda env, action: env.step(env.reset().set(env.action_key, action)),
        [(*given, f"action must be {wanted} torch.float32, got") for *given, wanted in cases],
    )


# -- controllers that remember -----------------------------------------------------------------


class Remembering(Controller):
    """Sums up what it saw in ``self``, in one of several ways."""

    how: str = ""
    reads = ("self.speed",)

    def setup(self, world) -> None:
        super().setup(world)
        self.last, self.seen, self.total = None, deque(), torch.zeros(())

    def command(self, speed):
        if self.how == "last":
            self.last = speed
        elif self.how == "seen":
            self.seen.append(speed)
        elif self.how == "total":
            self.total += speed.mean()
        elif self.how == "once" and self.last is None:
            self.last = torch.ones(())
        return torch.zeros_like(speed)


LAST: list[torch.Tensor] = []
ARRAY = np.zeros(2)
COUNT = 0


class Store:
    last: torch.Tensor | None = None


def counted(speed):
    global COUNT
    COUNT += 1
    return torch.zeros_like(speed)


def listed(speed):
    LAST[:] = [speed]
    return torch.zeros_like(speed)


def arrayed(speed):
    ARRAY[:] = speed[:, 0, 0].numpy()
    return torch.zeros_like(speed)


def helped(speed):
    return stored(speed)


def stored(speed):
    Store.last = speed
    return torch.zeros_like(speed)


def still(speed):
    return torch.zeros_like(speed) * (0.0 if Store is None else len(LAST) + COUNT)


def mixing(speed):
    return speed.mean() - speed


def drawing(speed):
    return torch.randn_like(speed)


def alarmed(gap, speed):
    return 0.1 * (gap - 2.0 * speed) - (3.0 if (gap < 0.5 * speed + 3.0).any() else 0.0)


def careful(gap, speed):
    """Branches, and refuses states, as a right rule may."""
    assert (speed >= 0.0).all()
    command = 0.1 * (gap - 2.0 * speed)
    return torch.where(gap < 3.0, -3.0, command) if (gap < 3.0).any() else command


class Crowded(RewardTerm):
    reads = ("self.gap",)

    def reward(self, gap):
        return -gap if gap.max() > 60.0 else 0.0 * gap


class Counting(Controller):
    """Counts its calls in its class, where no check of attributes looks."""

    reads = ("self.speed",)
    calls = 0

    def command(self, speed):
        type(self).calls += 1
        return 0.0 * speed - 0.01 * self.calls


class Base(Controller):
    """Remembers in a variable, in a static method."""

    reads = ("self.speed",)

    @staticmethod
    def law(speed):
        return listed(speed)

    def command(self, speed):
        return self.law(speed)


class Derived(Base):
    """Remembers by what its base does."""


class RememberingFeature(Feature):
    """Keeps the last gap in an attribute."""

    role = "vehicles"
    reads = (GAP,)
    writes = ("vehicles.change",)

    def setup(self, world) -> None:
        super().setup(world)
        self.before = None

    def compute(self, gap):
        self.before = gap
        return gap


def driven_by(group: str, name: str, node: dict) -> None:
    cfg = compose("idm")
    cfg = cfg.with_(scenario={group: {name: Node.of(node, name)}})
    build_env(cfg, wavy_profiles(), bootstrap(), 2)


def test_a_controller_that_remembers_in_an_attribute_is_refused() -> None:
    words = "Remembering remembers in its attribute '{}'.* names in remembers"
    check_refused(
        lambda how: driven_by(
            "controllers", "automated", {"_target_": f"{__name__}.Remembering", "how": how}
        ),
        [(how, words.format(how)) for how in ("last", "seen", "total")],
    )


def test_a_function_that_remembers_in_a_variable_is_refused() -> None:
    words = rf"{__name__}.{{}} remembers in its variable '{{}}', which all"
    names = [
        ("counted", "COUNT"),
        ("listed", "LAST"),
        ("arrayed", "ARRAY"),
        ("helped", "Store.last"),
    ]
    cases = [(f"{__name__}.{name}", words.format(name, variable)) for name, variable in names]
    check_refused(
        lambda law: driven_by("controllers", "automated", {"_target_": path_of(Law), "law": law}),
        cases,
    )
    check_refused(lambda law: Driver(law, 0.1), cases)
    assert "TensorDictModuleBase" not in _variables(Law(law="f"))  # libraries are not examined
    driven_by("controllers", "automated", {"_target_": path_of(Law), "law": f"{__name__}.still"})
    with pytest.raises(ConfigError, match="Derived remembers in its variable 'LAST'"):
        driven_by("controllers", "automated", {"_target_": f"{__name__}.Derived"})


def test_a_command_is_of_one_episode_and_one_step_alone() -> None:
    words = "{} gives an episode other automated.command alone, or in the same step again"
    for name in ("mixing", "drawing", "alarmed"):
        law = {"_target_": path_of(Law), "law": f"{__name__}.{name}"}
        with pytest.raises(ConfigError, match=words.format(f"{__name__}.{name}")):
            driven_by("controllers", "automated", law)
        with pytest.raises(ConfigError, match="alone, or in the same step again"):
            Driver(f"{__name__}.{name}", 0.1)
    with pytest.raises(ConfigError, match=words.format("Counting")):
        driven_by("controllers", "automated", {"_target_": f"{__name__}.Counting"})
    term = f"+reward.terms.crowded={{_target_: {__name__}.Crowded}}"
    with pytest.raises(ConfigError, match=r"Crowded gives an episode other .*: use torch\.where"):
        build_env(compose("alcc", term), wavy_profiles(), bootstrap(), 2)
    driven_by("controllers", "automated", {"_target_": path_of(Law), "law": f"{__name__}.careful"})
    Driver(f"{__name__}.careful", 0.1)


def test_pieces_and_controllers_inside_others_are_held_to_it_too() -> None:
    with pytest.raises(ConfigError, match="remembers in its attribute 'before'"):
        driven_by("pieces", "change", {"_target_": f"{__name__}.RememberingFeature"})
    inner = {"_target_": f"{__name__}.Remembering", "how": "last"}
    human = {"_target_": "lcc_rl.pieces.ConstantAcceleration"}
    node = {"_target_": "lcc_rl.pieces.Handover", "before": human, "after": inner, "from_s": 1.0}
    with pytest.raises(ConfigError, match=r"remembers in its attribute 'after\.last'"):
        driven_by("controllers", "automated", node)


def test_what_does_not_change_may_be_kept() -> None:
    for how in ("", "once"):
        driven_by("controllers", "automated", {"_target_": f"{__name__}.Remembering", "how": how})
