"""Each setting, changed alone, changes the trained weights, is refused, or has its reason here."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from commands import DATA

from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.factory import build_agent, check_lengths, make_trainer, training_env
from lcc_rl.config.compose import NOT_IDENTITY, load
from lcc_rl.config.nodes import as_plain
from lcc_rl.envs import load_inputs
from lcc_rl.errors import LccError
from lcc_rl.evaluation import cases, episodes
from lcc_rl.evaluation.strategies import Strategy

SIZE = (
    *("scenario.horizon=20", "training.environments=4", "training.episodes=8"),
    *("evaluation.warm_up=0", "evaluation.profiles=2", "evaluation.drivers=2"),
    *("training.checkpoint_every=99", "training.compiled=false"),
)
NETWORK = "agent.hidden=[8,8]"
BATCH = "agent.batch_size=16"
SMOKE = "experiment=smoke"
OFF_POLICY = (SMOKE, BATCH, NETWORK, "training.segment=10")
TRAININGS = {
    "analytic": ("variant=alcc", "agent=analytic", SMOKE, NETWORK, "training.segment=10"),
    "limits": ("variant=alcc", "experiment=[limits,smoke]", NETWORK, "training.segment=20"),
    "ddpg": ("variant=alcc", *OFF_POLICY),
    "ppo": ("variant=alcc", "agent=ppo", SMOKE, "agent.batch_size=8", NETWORK),
    "rule": ("variant=rule", SMOKE, "training.segment=20"),
}
# Settings that are no part of a training: how it is run, evaluated and written.
ELSEWHERE = (*NOT_IDENTITY, "data", "evaluation", "inputs", "seed", "task", "deployed", "threads")
ELSEWHERE += ("training.checkpoint_every", "training.keep_every", "training.compiled")
FILTER = "scenario.filters.automated"
SHORT = ("max_acceleration", "time_to_collision", "rate", "margin", "braking_ahead")
# Why a setting may change nothing, or nothing but rows and record, in trainings of seconds.
REASONS: Mapping[str, str] = {
    "split.evaluation_share": "whole recordings are held out, and there are two",
    "scenario.controllers.human.wiener_range": "a factor of wiener, which is 0",
    "scenario.max_braking": "no command is as unsafe",
    "scenario.max_acceleration": "no command is as large",
    "scenario.vehicle_length": "enters flow and the excess of spacing only",
    "scenario.start.human.cap_time_gap": "no gap at the start is as long",
    f"{FILTER}.robust": "actuators and sensors are ideal",
    f"{FILTER}.full_speed": "acts at lower speeds",
    f"{FILTER}.least_gap": "acts at lower speeds",
    **dict.fromkeys((f"{FILTER}.{name}" for name in SHORT), "no command is as unsafe"),
    "scenario.pieces.leader.foresight": "read by controllers with lookahead=oracle only",
    "scenario.pieces.estimator.*": "an episode of 2 s is shorter than learning_time",
    "scenario.pieces.ttc.floor": "no TTC is as short",
    "scenario.pieces.time_gap.speed_floor": "no time gap is long",
    "scenario.pieces.power.recuperation": "path energy is defined without it",
    "scenario.pieces.predicted_power.*": "the gradient takes the true power: in the record only",
    "reward.terms.safety.*": "no TTC is short",
    "reward.terms.efficiency.threshold": "no time gap is long: in the record only",
    "reward.terms.collision.*": "no episode collides",
    "agent.buffer_size": "the buffer does not fill in seconds",
    "agent.learning_starts": "an iteration has more transitions",
    "agent.exploration.decay_share": "of two iterations the second begins after the decay",
    "agent.mask_terminal": "no episode collides",
    "agent.clip": "no ratio of probabilities is as far from 1",
    "agent.clip_norm": "no gradient is as long",
    "agent.value_every": "acts by the target of the value, which hardly moves in two updates",
    "agent.td_lambda": "acts by the target of the value, which hardly moves in two updates",
    "agent.surrogates.safety.*": "no TTC is short",
    "agent.surrogates.efficiency.*": "no time gap is long: in the record only",
    "agent.limits.*": "no time gap is long: in the record only",
    "agent.limit_rate": "no time gap is long: in the record only",
}
CLOSE = ("training.gap_range=[0.05,0.3]",)
CRASH = ("training.gap_range=[0.001,0.01]",)
FAR = ("training.gap_range=[1.2,1.6]", f"{FILTER}.time_gap=null")
LONGER = ("training.episodes=24",)
TOUCHING = "{_target_: lcc_rl.pieces.HeadwayStart, headway: 0.0005, gap_spread: 0.0004}"
# Where a setting with a reason acts: training, further words, and the setting with its value.
ACTS: Sequence[tuple[str, Sequence[str], str]] = (
    ("ddpg", ["data.recordings=3"], "split.evaluation_share=0.7"),
    (
        "ddpg",
        ["scenario.controllers.human.wiener=0.5"],
        "scenario.controllers.human.wiener_range=[0.5,0.6]",
    ),
    ("ddpg", [], "scenario.vehicle_length=4.25"),
    (
        "ddpg",
        ["scenario.start.automated.time_gap=1.2"],
        "scenario.start.automated.standstill_gap=4",
    ),
    ("ddpg", [], "scenario.start.human.cap_time_gap=0.3"),
    ("limits", ["+faults=all"], f"{FILTER}.robust=false"),
    ("limits", ["training.gap_range=[2.0,4.0]"], f"{FILTER}.full_speed=20"),
    ("limits", ["training.gap_range=[2.0,4.0]"], f"{FILTER}.least_gap=40"),
    ("limits", CLOSE, f"{FILTER}.max_acceleration=2.55"),
    ("limits", CLOSE, f"{FILTER}.time_to_collision=3.4"),
    ("limits", CLOSE, "scenario.max_braking=2.55"),
    ("ddpg", [], "scenario.max_acceleration=0.1"),
    ("limits", CLOSE, f"{FILTER}.rate=0.1"),
    ("limits", CLOSE, f"{FILTER}.margin=0.17"),
    ("limits", CLOSE, f"{FILTER}.braking_ahead=2.21"),
    ("ddpg", ["scenario.horizon=80"], "scenario.pieces.estimator.learning_time=4"),
    ("ddpg", ["scenario.horizon=80"], "scenario.pieces.estimator.measurement_error=0.5"),
    ("ddpg", [], "scenario.pieces.ttc.floor=20"),
    ("limits", FAR, "scenario.pieces.time_gap.speed_floor=12"),
    ("ddpg", [], "scenario.pieces.power.recuperation=false"),
    ("ddpg", [], "scenario.pieces.predicted_power.recuperation=false"),
    ("ddpg", [], "reward.terms.safety.threshold=3.4"),
    ("analytic", CLOSE, "reward.terms.safety.threshold=3.4"),
    ("analytic", CLOSE, "reward.terms.safety.weight=0.85"),
    ("limits", FAR, "reward.terms.efficiency.threshold=2.125"),
    ("ddpg", CRASH, "reward.terms.collision.weight=85"),
    ("ddpg", [f"scenario.start.human={TOUCHING}"], "reward.terms.collision.behind=false"),
    ("ddpg", [], "agent.buffer_size=40"),
    ("ddpg", [], "agent.learning_starts=60"),
    ("ddpg", LONGER, "agent.exploration.decay_share=0.425"),
    ("ddpg", CRASH, "agent.mask_terminal=false"),
    ("ppo", [], "agent.clip=0.001"),
    ("limits", [], "agent.clip_norm=0.01"),
    ("analytic", ["agent.tau=0.9", *LONGER], "agent.value_every=6"),
    ("rule", ["agent.tau=0.9", *LONGER], "agent.td_lambda=0.8"),
    ("analytic", CLOSE, "agent.surrogates.safety.width=0.085"),
    ("limits", FAR, "agent.surrogates.efficiency.width=0.0425"),
    ("limits", [*LONGER, *FAR], "agent.limits.efficiency=0.3"),
    ("limits", [*LONGER, *FAR], "agent.limit_rate=0.0425"),
)
UNTRIED = {"scenario.pieces.leader.foresight"}  # no training has such a controller


def other(value: Any) -> str | None:
    """Return another value as the text of an override; None where there is none to try."""
    if isinstance(value, bool):
        return str(not value).lower()
    if isinstance(value, int):
        return str(value + 1 if value < 10 else int(value * 1.5))
    if isinstance(value, float):
        return f"{value * 0.85:.6g}" if value else "0.05"
    if isinstance(value, list) and value and all(type(x) in (int, float) for x in value):
        return "[" + ",".join(f"{x * 0.9:.6g}" for x in value) + "]"
    return None


def settings(node: Mapping[str, Any], at: str = "") -> Iterator[tuple[str, str]]:
    """Yield the dotted key of each setting, and another value."""
    for key, value in node.items():
        name = f"{at}{key}"
        if any(f"{name}.".startswith(f"{x}.") for x in ELSEWHERE):
            continue
        if isinstance(value, Mapping):
            yield from settings(value, f"{name}.")
        elif (text := other(value)) is not None:
            yield name, text


def digest(values: Any) -> str:
    return hashlib.sha256(b"".join(values)).hexdigest()


def trained(folder: Path, *words: str) -> tuple[str, Any, Any]:
    """Return digests of weights and record of a training, and a function to that of its rows."""
    cfg = load("train", words)
    check_lengths(cfg)
    inputs = load_inputs(cfg)
    profiles = inputs.to_learn_from()
    torch.manual_seed(0)
    agent = build_agent(cfg, inputs.population)
    agent.take(profiles)
    rows: list[Mapping[str, Any]] = []
    trainer = make_trainer(cfg, agent, training_env(cfg, profiles, inputs.population), folder)
    trainer.on_row = rows.append
    trainer.save = lambda *given, **named: None
    trainer.run()
    weights = digest(x.numpy().tobytes() for x in agent.policy.state_dict().values())
    record = [{k: x for k, x in row.items() if "second" not in k} for row in rows]

    def played() -> str:
        strategy = Strategy(
            cfg.variant, cfg.after_training(), shared_policy(agent.policy), cfg.seed
        )
        if cfg.evaluation.rows == "vehicles":
            table, _ = cases.Cases(strategy, cfg, inputs).play()
        else:
            plan = episodes.plan_of(cfg, inputs)
            player = episodes.Episodes(strategy, inputs, plan, cfg.evaluation.seed, 0)
            table = pd.concat([player.play(block)[0] for block in plan.own])
        numbers = pd.util.hash_pandas_object(table.select_dtypes("number"), index=False)
        return digest([numbers.to_numpy().tobytes()])

    return weights, str(record), played


class Changes:
    """What settings change in a training, beside the training without them."""

    def __init__(self, folder: Path, training: str, *words: str) -> None:
        self.folder, self.words = folder, (*TRAININGS[training], *DATA, *SIZE, *words)
        self.weights, self.record, played = trained(folder, *self.words)
        self.rows = played()

    def by(self, *words: str) -> str:
        """Return the first of weights, rows and record that words change; or why not."""
        try:
            weights, record, played = trained(self.folder, *self.words, *words)
            if weights != self.weights:
                return "weights"
            if played() != self.rows:
                return "rows"
            return "record" if record != self.record else "nothing"
        except LccError as error:
            return f"refused: {error}"


@pytest.mark.slow
@pytest.mark.parametrize("training", TRAININGS)
def test_every_setting_acts_is_refused_or_has_a_reason(training: str, tmp_path) -> None:
    changes, idle = Changes(tmp_path, training), {}
    for name, text in settings(as_plain(load("train", changes.words))):
        found = changes.by(f"{name}={text}")
        known = any(fnmatchcase(name, pattern) for pattern in REASONS)
        if found in ("rows", "record", "nothing") and not known:
            idle[f"{name}={text}"] = found
    assert not idle


def test_every_reason_is_tried() -> None:
    tried = [setting.partition("=")[0] for *_, setting in ACTS]
    untried = {x for x in REASONS if not any(fnmatchcase(name, x) for name in tried)}
    assert untried == UNTRIED


@pytest.mark.slow
def test_settings_with_a_reason_act_elsewhere(tmp_path) -> None:
    known: dict[tuple[str, ...], Changes] = {}
    found = {}
    for training, words, setting in ACTS:
        key = (training, *words)
        if key not in known:
            known[key] = Changes(tmp_path, *key)
        found[(*key, setting)] = known[key].by(setting)
    assert set(found.values()) <= {"weights", "rows"}, found
