"""What an environment is made with and stepped with, in Python."""

from __future__ import annotations

import pytest
import torch
from commands import DATA

from lcc_rl.data.leaders import stretch
from lcc_rl.envs import make_env
from lcc_rl.errors import ConfigError

PLATOON = ("scenario.string=automated*3",)


@pytest.mark.parametrize("size", [10**9, (10**5, 10**5), 10**30])
def test_a_batch_that_does_not_fit_into_memory(size) -> None:
    with pytest.raises(ConfigError, match=r"batch_size=.* needs about \d+.* of memory"):
        make_env("alcc", size, DATA)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"seed": -1}, "seed must be a whole number from 0"),
        ({"seed": 10**30}, "seed must be a whole number from 0"),
        ({"seed": 0.5}, "seed must be a whole number from 0"),
    ],
)
def test_numbers_that_are_none(settings, words) -> None:
    with pytest.raises(ConfigError, match=words):
        make_env("alcc", overrides=DATA, **settings)


@pytest.mark.parametrize("shape", [(2,), (2, 2), (2, 1, 1)])
def test_an_action_of_another_shape(shape) -> None:
    env = make_env("alcc", 2, DATA)
    moment = env.reset().set("action", torch.zeros(shape))
    with pytest.raises(ConfigError, match=r"action must be \[2, 1\], got"):
        env.step(moment)


def test_one_action_does_not_drive_three_vehicles() -> None:
    env = make_env("ddpg", 2, PLATOON, single=False)
    moment = env.reset().set(("automated", "action"), torch.zeros(2, 1, 1))
    with pytest.raises(ConfigError, match=r"automated.action must be \[2, 3, 1\], got \[2, 1, 1\]"):
        env.step(moment)


def test_a_scale_that_makes_a_leader_implausibly_fast() -> None:
    assert stretch("udds", 0.1, scale=2.0).speeds.max() > 50.0
    with pytest.raises(ConfigError, match=r"udds at scale=100 drives up to .* m/s, leader.plaus"):
        stretch("udds", 0.1, scale=100.0)
