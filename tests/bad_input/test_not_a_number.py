"""What is not a number ends an evaluation or a training with one error, and nothing is written."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
import torch
from commands import tiny
from helpers import ACTION, check_refused, compose, network, play, single_env, small_env
from platoons import env_of, hcfs, ramps
from torchrl.collectors import Collector

from lcc_rl.commands import evaluation, training
from lcc_rl.drivers.calibrator import Calibrator
from lcc_rl.drivers.genetic import GeneticSettings
from lcc_rl.drivers.observed import Selection, observe
from lcc_rl.envs import StringCollector
from lcc_rl.errors import DataError, Diverged
from lcc_rl.pieces import IDM, Controller, Feature, MotorPower, RewardTerm


def nan_at(step, value, at=3):
    return torch.where(step == at, math.nan, value)


class NanControl(Controller):
    reads = ("self.speed", "episode.step")

    def command(self, speed, step):
        return nan_at(step, 0.0 * speed)


class NanDriver(IDM):
    def command(self, *entries):
        return nan_at(entries[-1], super().command(*entries))


class NanReward(RewardTerm):
    reads = ("self.jerk", "episode.step")

    def reward(self, jerk, step):
        return nan_at(step, -jerk.abs())


class InfinitePower(MotorPower):
    def compute(self, *entries):
        return super().compute(*entries) / 0.0


class NanEntry(Feature):
    role = "vehicles"
    reads = ("vehicles.speed", "episode.step")
    writes = ("vehicles.broken",)

    def compute(self, speed, step):
        return nan_at(step, speed, at=4)


CONTROL = (f"scenario.controllers.automated._target_={__name__}.NanControl",)
DRIVER = (f"scenario.controllers.human._target_={__name__}.NanDriver",)
POWER = (f"scenario.pieces.power._target_={__name__}.InfinitePower",)
TERM = (f"+reward.terms.comfort={{_target_: {__name__}.NanReward, weight: 0.1}}",)
ENTRY = (
    f"+scenario.pieces.broken={{_target_: {__name__}.NanEntry}}",
    "+observation.scales.self.broken=0.1",
)
FILTER = ("+filter=cbf",)


# -- evaluation ------------------------------------------------------------------------------------


def test_an_evaluation_names_strategy_entry_step_and_episode(tmp_path) -> None:
    def evaluate(*overrides: str) -> None:
        cfg = tiny("evaluate", "variant=idm", *overrides, agent=False)
        evaluation.run(cfg, tmp_path / "run", quiet=True)

    which = r"of episode \d+ \(profile \S.*, driver \d+, seed \d+\)$"
    cases = [
        (*CONTROL, f"NanControl: automated.command of NanControl is nan at step 4 {which}"),
        (*CONTROL, *FILTER, f"NanControl: automated.wanted of NanControl is nan at step 4 {which}"),
        (*DRIVER, f"strategy direct: human.command of NanDriver is nan at step 4 {which}"),
        (*POWER, rf"vehicles.power of InfinitePower \(PaperMotor\) is -?inf at step 1 {which}"),
    ]
    check_refused(evaluate, cases, Diverged)
    assert not list(tmp_path.glob("run/*.parquet"))


@pytest.mark.parametrize(("overrides", "number"), [((), math.nan), (FILTER, math.inf)])
def test_the_action_counts_before_clamp_and_filter(overrides, number) -> None:
    env, good = small_env("alcc", 3, overrides), network(compose("alcc", *overrides))

    def policy(td):
        td = good(td)
        if int(td["episode", "step"][0]) == 5:
            td[ACTION][1] = number
        return td

    policy.in_keys = [*good.in_keys, ("episode", "step")]
    words = rf"strategy x: automated.action is {number} at step 6 of episode 1"
    with pytest.raises(Diverged, match=words):
        play(env, policy, None, [("vehicles", "gap")], "strategy x")
    td = env.rand_action(env.reset())
    td[ACTION][1] = number
    with pytest.raises(Diverged, match=rf"automated.action is {number} at step 1 of episode 1"):
        env.step(td)


def test_what_follows_the_end_of_an_episode_does_not_count() -> None:
    env = small_env("alcc", 2, ["scenario.start.automated.time_gap=0.05"], nominal=True)

    def policy(td):
        crashed = (td["vehicles", "gap"] <= 0).any(-2, keepdim=True)
        return td.set(ACTION, torch.where(crashed, math.nan, torch.ones(2, 1, 1)))

    record, alive = play(env, policy, None, [("vehicles", "gap")])
    assert not alive[-1].any()
    assert record["vehicles", "gap"].isfinite().all()


def test_actions_beyond_the_range_count_as_its_ends() -> None:
    for env in (
        small_env("alcc", 3, FILTER),
        single_env("alcc", 3),
        env_of(ramps(), hcfs(safe_cap=False)),
    ):
        reached = []
        for size in (1.0, 7.0):
            env.set_seed(0)
            td = env.rand_action(env.reset())
            key = env.action_key
            reached.append(env.step(td.set(key, torch.full_like(td[key], size)))["next"])
        assert (reached[0].exclude(ACTION) == reached[1].exclude(ACTION)).all()


def test_every_view_and_collector_names_the_term_that_is_nan() -> None:
    frames = {"frames_per_batch": 27, "total_frames": 27}
    kinds = Collector, StringCollector
    plays = [lambda env, x=x: next(iter(x(env, None, **frames))) for x in kinds]
    words = "automated.reward_terms.comfort is nan at step 3 of episode 0"
    plays.append(lambda env: env.rollout(9))
    cases = [(play, make, words) for play in plays for make in (single_env, small_env)]
    check_refused(lambda play, make: play(make("alcc", 3, TERM)), cases, Diverged)


class LaterNan(NanReward):
    calls = 0

    def reward(self, jerk, step):
        type(self).calls += 1
        return nan_at(step, -jerk.abs(), 3 if self.calls > 60 else -1)


def test_a_collector_counts_the_steps_of_an_episode_that_begins_within_a_batch() -> None:
    later = f"+reward.terms.comfort={{_target_: {__name__}.LaterNan, weight: 0.1}}"
    env = small_env("alcc", 3, [later, "scenario.horizon=40"])
    with pytest.raises(Diverged, match="comfort is nan at step 3 of"):
        list(StringCollector(env, None, frames_per_batch=27, total_frames=540))


# -- training --------------------------------------------------------------------------------------


def test_a_training_names_what_it_would_have_learned_from(tmp_path) -> None:
    def train(*overrides: str) -> None:
        words = ("variant=alcc", "training.segment=20", *overrides)
        training.run(tiny("train", *words, agent=False), tmp_path / "run", quiet=True)

    ends = r".* of episode \d+ in iteration 1 of .*; nothing is saved$"
    cases = [
        ("training.collector=string", *TERM, f"terms.comfort is nan at step 3{ends}"),
        ("training.collector=torchrl", *POWER, f"vehicles.power is -?inf at step 1{ends}"),
        ("training.collector=string", *ENTRY, f"automated.observation is nan at step{ends}"),
        ("agent=analytic", *TERM, f"automated.reward_terms.comfort is nan at step 3{ends}"),
    ]
    check_refused(train, cases, Diverged)
    assert not (tmp_path / "run" / "policy.pt").exists()


def test_a_calibration_without_any_fit_names_the_episode() -> None:
    time = 0.1 * np.arange(200)
    still = pd.DataFrame({"time_s": time, "follower_speed_mps": 0.0, "leader_speed_mps": 0.0})
    still = still.assign(episode=7, gap_m=5.0, follower_position_m=0.0, leader_position_m=10.0)
    observed = observe(still.assign(leader_length_m=5.0), Selection(min_mean_speed_mps=0.0))
    with pytest.raises(DataError, match=r"episode 7 .*no local parameters .* finite speed_rmspe"):
        Calibrator(local_genetic=GeneticSettings(population=4, generations=1))(observed)
