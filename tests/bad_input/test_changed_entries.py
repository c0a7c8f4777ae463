"""What a user's class reads is the state of all vehicles: a class that changes it is refused."""

from __future__ import annotations

import pytest
import torch
from commands import NO_AGENT
from helpers import POPULATION, check_refused, compose, wavy_profiles
from tensordict import TensorDict

import lcc_rl
from lcc_rl.agents.controller import ControllerPolicy
from lcc_rl.energy import EnergyModel, Fleet, PaperMotor
from lcc_rl.envs import build_env
from lcc_rl.errors import ConfigError
from lcc_rl.functional.guard import unchanged
from lcc_rl.pieces import IDM, Controller, Feature, MotorPower, RewardTerm
from lcc_rl.pieces.observation import Observation


class Greedy(Controller):
    reads = ("self.gap", "self.relative_speed")

    def command(self, gap, relative_speed):
        return 0.1 * (gap.clamp_(min=20.0) - 20.0) + 0.5 * relative_speed


class Hidden(Greedy):
    """Changes what it reads by way of NumPy, which no counter of torch sees."""

    def command(self, gap, relative_speed):
        seen = gap.detach().numpy()
        seen += 1.0
        return 0.1 * (gap - 20.0) + 0.5 * relative_speed


class Remembering(Controller):
    reads = ("self.gap",)
    remembers = ("count",)

    def command(self, gap, count):
        count += 1.0
        return 0.1 * gap, count


class Rounded(RewardTerm):
    reads = ("self.jerk",)

    def reward(self, jerk):
        jerk[jerk.abs() < 0.1] = 0.0
        return -jerk.abs()


class Heavy(EnergyModel):
    mass = 2000.0

    def power(self, speed, acceleration):
        return speed.mul_(2.0) * acceleration


class Smooth(PaperMotor):
    def path_power(self, speed, acceleration):
        return super().path_power(speed, acceleration.clamp_(-1.0, 1.0))


class Lossy(MotorPower):
    def compute(self, *entries):
        return super().compute(*entries).abs() + entries[0].abs_()


class Kinetic(Feature):
    role = "vehicles"
    reads = ("vehicles.speed",)
    writes = ("vehicles.kinetic",)

    def compute(self, speed):
        return speed.square_()


class Scaled(Observation):
    def compute(self, *entries):
        entries[0].mul_(0.5)
        return super().compute(*entries)


class Hasty(IDM):
    def command(self, speed, gap, *more):
        gap.sub_(2.0)
        return super().command(speed, gap, *more)


def nearer(gap, relative_speed):
    gap -= 5.0
    return 0.1 * gap + 0.5 * relative_speed


HERE = __name__
CONTROLLER = "scenario.controllers.automated"
LAW = f"{{_target_: lcc_rl.pieces.Law, law: {HERE}.nearer}}"
CASES = [  # the class at fault, what it changes, and the option that uses it
    ("Greedy", "vehicles.gap", f"{CONTROLLER}={{_target_: {HERE}.Greedy}}"),
    ("Hidden", "vehicles.gap", f"{CONTROLLER}={{_target_: {HERE}.Hidden}}"),
    ("Remembering", "automated.count", f"{CONTROLLER}={{_target_: {HERE}.Remembering}}"),
    (f"{HERE}.nearer", "vehicles.gap", f"{CONTROLLER}={LAW}"),
    ("Hasty", "vehicles.gap", f"scenario.controllers.human._target_={HERE}.Hasty"),
    ("Rounded", "vehicles.jerk", f"+reward.terms.rounded={{_target_: {HERE}.Rounded}}"),
    ("Heavy", "speed", f"energy={{_target_: {HERE}.Heavy}}"),
    ("Lossy", "vehicles.speed", f"scenario.pieces.power._target_={HERE}.Lossy"),
    ("Kinetic", "vehicles.speed", f"+scenario.pieces.kinetic={{_target_: {HERE}.Kinetic}}"),
    ("Scaled", "leader.speed", f"observation._target_={HERE}.Scaled"),
]


@pytest.mark.parametrize("string", ["automated human", "human automated*2 human"])
def test_a_class_that_changes_what_it_reads_is_named(string) -> None:
    first = "vehicles.speed" if string.startswith("human") else "leader.speed"
    check_refused(
        lambda option: make(option, f"scenario.string='{string}'"),
        (
            (option, rf"{title}.* changes (next\.)?{entry.replace('leader.speed', first)} in place")
            for title, entry, option in CASES
        ),
    )


def make(*options: str):
    return build_env(compose("alcc", *options), wavy_profiles(), POPULATION, 2)


class Late(Controller):
    """Changes the gap from the third step on only, which no check at building sees."""

    reads = ("self.gap", "episode.step")

    def command(self, gap, step):
        return gap.clamp_(min=20.0) if bool((step > 2).any()) else 0.0 * gap


def test_a_change_in_a_later_step_ends_the_rollout() -> None:
    env = make(f"{CONTROLLER}={{_target_: {HERE}.Late}}")
    env.rollout(3)
    with pytest.raises(ConfigError, match=r"Late changes vehicles\.gap in place"):
        env.rollout(4)


def test_a_comparison_names_it(tmp_path) -> None:
    small = [*NO_AGENT, "evaluation.profiles=1", "evaluation.drivers=1"]
    with pytest.raises(ConfigError, match=r"nearer changes vehicles\.gap in place"):
        lcc_rl.compare([nearer], "idm", small, tmp_path)


def test_every_other_door_names_it() -> None:
    motion = torch.ones(3), torch.full((3,), 2.0)
    data = TensorDict({("vehicles", "gap"): torch.ones(2, 1, 1)}, [2])
    data["vehicles", "relative_speed"] = torch.zeros(2, 1, 1)
    doors = [
        (lambda: Fleet({"all": Smooth()}).path_power(*motion), "Smooth changes acceleration"),
        (lambda: Greedy().bind()(data), "Greedy changes vehicles.gap"),
        (lambda: ControllerPolicy(Greedy().bind())(data), "Greedy changes vehicles.gap"),
    ]
    check_refused(lambda door: door(), doors)


def test_compiled_code_and_inference_mode_run() -> None:
    value = torch.ones(3)
    with torch.inference_mode():
        assert unchanged(torch.neg, [torch.ones(1)], "neg", ["x"]).item() == -1.0
    compiled = torch.compile(lambda x: unchanged(torch.neg, [x], "neg", ["x"]), backend="eager")
    assert compiled(value).tolist() == [-1.0] * 3
