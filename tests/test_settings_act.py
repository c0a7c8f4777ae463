"""Each setting, changed alone, changes the trained weights, is refused, or has its reason here."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from commands import DATA

from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.factory import build_agent, check_lengths, make_trainer, training_env
from lcc_rl.config import NOT_IDENTITY, load
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
}
# Settings that are no part of a training: how it is run, evaluated and written.
ELSEWHERE = (*NOT_IDENTITY, "data", "evaluation", "inputs", "seed", "task", "deployed", "threads")
ELSEWHERE += ("training.checkpoint_every", "training.keep_every", "training.compiled")
# Why a setting may change nothing, or nothing but rows and record, in trainings of seconds.
REASONS: Mapping[str, str] = {
    "split.evaluation_share": "whole recordings are held out, and there are two",
    "scenario.controllers.human.wiener_range": "a factor of wiener, which is 0",
    "scenario.vehicle_length": "enters flow and the excess of spacing only",
    "scenario.start.automated.*": "episodes begin with the recorded gap",
    "scenario.filters.automated.robust": "actuators and sensors are ideal",
    "scenario.filters.automated.full_speed": "below the speed of a standing car",
    "scenario.filters.automated.*": "a bound of the filter that seconds do not reach",
    "scenario.pieces.leader.foresight": "writes an entry that nothing reads",
    "scenario.pieces.estimator.*": "the gradient takes the true power, not the estimated one",
    "scenario.pieces.ttc.floor": "no episode comes as close",
    "scenario.pieces.time_gap.speed_floor": "no episode is as slow",
    "scenario.pieces.power.recuperation": "path energy is defined without it",
    "scenario.pieces.predicted_power.*": "the gradient takes the true power",
    "scenario.start.human.cap_time_gap": "no gap at the start is as long",
    "reward.terms.safety.*": "with a filter, or without a short TTC, in the record only",
    "reward.terms.efficiency.threshold": "no time gap between both values",
    "reward.terms.collision.*": "no episode collides",
    "agent.buffer_size": "the buffer does not fill in seconds",
    "agent.learning_starts": "an iteration has more transitions",
    "agent.exploration.decay_share": "reaches its end in either case",
    "agent.mask_terminal": "no episode collides",
    "agent.surrogates.safety.*": "no TTC is short",
    "agent.surrogates.efficiency.*": "no time gap is long: in the record only",
    "agent.limits.*": "the price changes after the last of two updates",
    "agent.limit_rate": "the price changes after the last of two updates",
}


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


def effects(folder: Path, words: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Yield each setting and what it changes: weights, rows, record, nothing; or why not."""
    words = (*words, *DATA, *SIZE)
    weights, record, played = trained(folder, *words)
    rows = played()
    for name, text in settings(as_plain(load("train", words))):
        try:
            own, noted, again = trained(folder, *words, f"{name}={text}")
            if own != weights:
                found = "weights"
            else:
                found = "rows" if again() != rows else "record" if noted != record else "nothing"
        except LccError as error:
            found = f"refused: {error}"
        yield f"{name}={text}", found


@pytest.mark.slow
@pytest.mark.parametrize("training", TRAININGS)
def test_every_setting_acts_is_refused_or_has_a_reason(training: str, tmp_path) -> None:
    idle = {}
    for setting, found in effects(tmp_path, TRAININGS[training]):
        name = setting.partition("=")[0]
        known = any(fnmatchcase(name, pattern) for pattern in REASONS)
        if found in ("rows", "record", "nothing") and not known:
            idle[setting] = found
    assert not idle
