"""Reset options that do not exist or do not fit, and controllers that remember in attributes."""

from __future__ import annotations

from collections import deque

import pytest
import torch
from helpers import compose, single_env, small_env, wavy_profiles
from tensordict import TensorDict

from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs import DifferentiableRollout, StringCollector, build_env
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.rollout import play
from lcc_rl.pieces import Controller, Feature
from lcc_rl.pieces.rewards import REWARD

EXIST = "those that exist: episode.seed, leader.profile, leader.start, human.driver"
PROFILE, START, DRIVER = ("leader", "profile"), ("leader", "start"), ("human", "driver")
SEED = ("episode", "seed")
BAD = {
    "misspelt": ({("humn", "driver"): torch.zeros(2, 1, 1).long()}, f"humn.driver is no .*{EXIST}"),
    "entry": ({("vehicles", "gap"): torch.zeros(2, 2, 1)}, f"vehicles.gap is no .*{EXIST}"),
    "root": ({"gap_factor": torch.full((2, 1), torch.nan)}, f"gap_factor is no .*{EXIST}"),
    "text": ({"profile": "first"}, f"profile is no .*{EXIST}"),
    "step": ({("episode", "step"): torch.zeros(2, 1).long()}, "episode.step is no reset option"),
    "speed": ({("leader", "speed"): torch.ones(2, 1)}, "leader.speed is no reset option"),
    "float": ({DRIVER: torch.zeros(2, 1, 1)}, r"human.driver must be \[2, 1, 1\] torch.int64, got"),
    "nan": ({SEED: torch.full((2, 1), torch.nan)}, "episode.seed must be .* got .* torch.float32"),
    "words": ({DRIVER: "first"}, "human.driver must be .* got NonTensorData"),
    "flat": ({DRIVER: torch.zeros(2, 1).long()}, r"human.driver must be .* got \[2, 1\] torch"),
    "many": ({DRIVER: torch.zeros(2, 3, 1).long()}, r"human.driver must be .* got \[2, 3, 1\]"),
    "wide": ({PROFILE: torch.zeros(2, 2).long()}, r"leader.profile must be .* got \[2, 2\]"),
    "negative driver": (
        {DRIVER: torch.full((2, 1, 1), -1)},
        r"human.driver must lie in 0…\d+, got -1",
    ),
    "far driver": ({DRIVER: torch.full((2, 1, 1), 10**6)}, r"human.driver must lie .* got 1000000"),
    "negative seed": ({SEED: torch.tensor([[1], [-3]])}, "episode.seed must lie .* got -3"),
    "huge seed": ({SEED: torch.tensor([[1], [2**40]])}, "episode.seed must lie in 0…4294967295"),
    "far profile": ({PROFILE: torch.tensor([[0], [4]])}, r"leader.profile must lie in 0…3, got 4"),
    "negative start": ({START: torch.full((2, 1), -1)}, "leader.start must lie .* got -1"),
    "late start": (
        {PROFILE: torch.tensor([[0], [1]]), START: torch.tensor([[0], [380]])},
        "leader.start must lie in 0…379, got 380",
    ),
}


@pytest.fixture(scope="module")
def envs():
    return {"group": small_env("alcc", 2), "single": single_env("alcc", 2)}


@pytest.mark.parametrize("kind", ["group", "single"])
@pytest.mark.parametrize("name", BAD)
def test_a_bad_reset_option_is_named(envs, kind, name) -> None:
    given, words = BAD[name]
    with pytest.raises(ConfigError, match=words):
        envs[kind].reset(TensorDict(given, [2]))


def test_episodes_of_another_number(envs) -> None:
    with pytest.raises(ConfigError, match=r"TensorDict of \[2\] episodes, .* got \[3\]"):
        envs["group"].reset(TensorDict({SEED: torch.zeros(3, 1).long()}, [3]))


def test_the_last_window_of_a_record_can_be_chosen(envs) -> None:
    last = TensorDict({PROFILE: torch.tensor([[0], [1]]), START: torch.full((2, 1), 379)}, [2])
    assert (envs["group"].reset(last)[START] == 379).all()


def test_evaluation_and_differentiable_rollout_refuse_them_too(envs) -> None:
    given, words = TensorDict(BAD["entry"][0], [2]), BAD["entry"][1]
    with pytest.raises(ConfigError, match=words):
        play(envs["group"], lambda td: td, given, [REWARD])
    with pytest.raises(ConfigError, match=words):
        DifferentiableRollout(envs["group"], [REWARD]).start(given)


@pytest.mark.parametrize("kind", ["group", "single"])
def test_a_whole_moment_may_be_given_and_replays_its_episode(envs, kind) -> None:
    env, given = envs[kind], TensorDict({SEED: torch.tensor([[3], [4]])}, [2])
    first = env.reset(given).clone()
    assert (env.reset(given) == first).all()  # TorchRL has written the moment into it
    reached = env.rollout(5, break_when_any_done=False, tensordict=first.clone())[:, -1]
    assert torch.equal(env.reset(reached.exclude("next"))[SEED], first[SEED])


def test_what_torchrl_itself_resets_is_no_option(envs) -> None:
    for env in envs.values():
        assert env.rollout(45, break_when_any_done=False).shape == (2, 45)
    collector = StringCollector(envs["group"], None, frames_per_batch=90)
    assert collector.collect().shape == (2, 45)


# -- controllers that remember -----------------------------------------------------------------


class Remembering(Controller):
    """Sums up what it saw in ``self``, in one of several ways."""

    how: str = ""
    reads = ("self.speed",)

    def setup(self, world) -> None:
        super().setup(world)
        self.last, self.seen, self.table = None, deque(), {}
        self.register_buffer("total", torch.zeros(()))

    def command(self, speed):
        if self.how == "attribute":
            self.last = speed
        elif self.how == "number":
            self.last = float(speed.mean())
        elif self.how == "list":
            self.seen.append(speed)
        elif self.how == "mapping":
            self.table["last"] = speed
        elif self.how == "in place":
            self.total += speed.mean()
        elif self.how == "once" and self.last is None:
            self.last = torch.ones(())
        return torch.zeros_like(speed)


class RememberingFeature(Feature):
    """Keeps the last gap in an attribute."""

    def setup(self, world) -> None:
        shape = (len(world.string), 1)
        self.wire([("vehicles", "gap")], [("vehicles", "change")], shape)
        self.before = None

    def compute(self, gap):
        self.before = gap
        return gap


def driven_by(node: dict, where: str = "scenario.controllers.automated"):
    cfg = compose("idm")
    group, _, name = where.removeprefix("scenario.").partition(".")
    getattr(cfg.scenario, group)[name] = node
    return build_env(cfg, wavy_profiles(), bootstrap(), 2)


@pytest.mark.parametrize(
    ("how", "attribute"),
    [
        ("attribute", "last"),
        ("number", "last"),
        ("list", "seen"),
        ("mapping", "table"),
        ("in place", "total"),
    ],
)
def test_a_controller_that_remembers_in_an_attribute_is_refused(how, attribute) -> None:
    node = {"_target_": f"{__name__}.Remembering", "how": how}
    words = f"Remembering remembers in its attribute '{attribute}'.* writes=… and reads"
    with pytest.raises(ConfigError, match=words):
        driven_by(node)


def test_one_inside_another_is_found_too() -> None:
    inner = {"_target_": f"{__name__}.Remembering", "how": "attribute"}
    human = {"_target_": "lcc_rl.pieces.ConstantAcceleration"}
    node = {"_target_": "lcc_rl.pieces.Handover", "before": human, "after": inner, "from_s": 1.0}
    with pytest.raises(ConfigError, match=r"Handover remembers in its attribute 'after\.last'"):
        driven_by(node)


def test_other_pieces_are_held_to_it_too() -> None:
    words = "RememberingFeature remembers in its attribute 'before'"
    with pytest.raises(ConfigError, match=words):
        driven_by({"_target_": f"{__name__}.RememberingFeature"}, "scenario.pieces.change")


@pytest.mark.parametrize("how", ["", "once"])
def test_what_does_not_change_may_be_kept(how) -> None:
    driven_by({"_target_": f"{__name__}.Remembering", "how": how})
