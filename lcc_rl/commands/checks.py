"""Checks of settings before expensive work starts."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase

from lcc_rl.agents.factory import build_agent, check_lengths, learns, make_trainer
from lcc_rl.config import load
from lcc_rl.config.nodes import CALLED, nodes_in
from lcc_rl.config.schemas import StudyConfig, TrainConfig
from lcc_rl.envs import Inputs, build_env
from lcc_rl.envs.factory import after_uncounted
from lcc_rl.envs.inputs import (
    LOADS,
    build_drivers,
    constant_profiles,
)
from lcc_rl.envs.rollout import OBSERVATION
from lcc_rl.errors import ConfigError, require
from lcc_rl.evaluation.episodes import any_leader, plan_of
from lcc_rl.evaluation.named import DIRECT, controller_of
from lcc_rl.evaluation.strategies import Strategy, applies, deployed
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.io.memory import require_memory
from lcc_rl.runs.loggers import Silent

MESSAGES = "communication"  # name of the piece with messages between connected vehicles
MEASURED = {"episodes": ("ttc", "time_gap", "power"), "vehicles": (MESSAGES,)}
KEPT_MOMENTS = 24  # copies of every entry per step of a training, including gradients
RECORD_BYTES = 4096  # size of an iteration's row in the record [bytes]


def check_settings(cfg: TrainConfig, folder: Path) -> None:
    """Check all settings of a training before the data are read, which may take a long time.

    Everything is built once with a leader at constant speed.
    """
    check_measured(cfg)
    if cfg.evaluation.shards > 1:
        raise ConfigError(
            f"evaluation.shards={cfg.evaluation.shards}: a training's evaluation is one table; "
            "divide that of lcc-rl evaluate policy=<run>"
        )
    check_installed(cfg)
    build_logger(cfg)
    cfg.data.made(LOADS)
    cfg.split.made(CALLED)
    population = build_drivers(cfg)
    check_variant(cfg)
    trial = any_leader(cfg)
    horizon, time_step = cfg.scenario.horizon, cfg.scenario.time_step
    profiles = constant_profiles(10.0, horizon, time_step, ["trial"])
    env = build_env(deployed(trial), profiles, population, 1, 0, cfg.device, nominal=True)
    if learns(cfg):
        require_memory(training_bytes(cfg, env.reset()), cfg.device)
        check_lengths(cfg)
        agent = build_agent(cfg, population, cfg.device)
        small = trial.with_(training={"environments": 2, "episodes": 2})
        make_trainer(small, agent, profiles, population, folder)


def check_evaluation(cfg: StudyConfig, inputs: Inputs) -> None:
    """Check that an evaluation fits into memory."""
    own, profiles = deployed(any_leader(cfg)), inputs.evaluation
    env = build_env(own, profiles, inputs.population, 1, 0, cfg.device, nominal=True)
    require_memory(evaluation_bytes(cfg, env.reset(), inputs), cfg.device)


def check_strategies(strategies: Sequence[Strategy], inputs: Inputs) -> None:
    """Check that the controllers of all strategies fit their strings, before files are written.

    Raises:
        ConfigError: naming the controller and the wrong entry or shape.
    """
    for cfg in (any_leader(one.cfg) for one in strategies):
        build_env(cfg, inputs.evaluation, inputs.population, 1, 0, cfg.device, nominal=True)


def training_bytes(cfg: StudyConfig, moment: TensorDictBase) -> dict[str, float]:
    """Return the least memory that a training needs by option [bytes].

    Args:
        cfg: its configuration.
        moment: the state of one episode.
    """
    settings, agent = cfg.training, cfg.agent.settings
    count, vehicles = settings.environments, moment[OBSERVATION].shape[-2]
    transition = 4 * (2 * moment[OBSERVATION].shape[-1] + 2)  # before, after, action and reward
    needs = {f"training.episodes={settings.episodes}": settings.episodes / count * RECORD_BYTES}
    if isinstance(hidden := agent.get("hidden"), list):
        sizes = [moment[OBSERVATION].shape[-1], *hidden, 1]
        weights = sum((before + 1) * after for before, after in pairwise(sizes))
        copies = 10 if "buffer_size" in agent else 4  # gradient, two moments; critic, targets
        needs[f"agent.hidden={hidden}"] = 4.0 * copies * weights
    if "buffer_size" in agent:
        played = KEPT_MOMENTS * moment.bytes() + 2 * cfg.scenario.horizon * vehicles * transition
        learned = 2 * transition + 16 * sum(agent["hidden"])
        needs[f"agent.buffer_size={agent['buffer_size']}"] = agent["buffer_size"] * transition
        needs[f"agent.batch_size={agent['batch_size']}"] = agent["batch_size"] * learned
    else:
        played = KEPT_MOMENTS * moment.bytes() * settings.segment
    return {f"training.environments={count}": count * played, **needs}


def evaluation_bytes(cfg: StudyConfig, moment: TensorDictBase, inputs: Inputs) -> dict[str, float]:
    """Return the memory of the largest block of an evaluation by option [bytes]."""
    settings, count = cfg.evaluation, len(inputs.evaluation)
    steps = after_uncounted(cfg)[0].scenario.horizon
    if settings.rows == "episodes":
        count = plan_of(cfg, inputs).size
    longest = max((case.horizon for case in inputs.full_length), default=0)
    if settings.full_length and longest > count * steps:
        count, steps = 1, longest
    what = f"an evaluation of {count} episodes of {steps} steps side by side"
    return {what: count * steps * moment.bytes()}


def check_installed(cfg: StudyConfig, compared: Sequence[Any] = ()) -> None:
    """Refuse controllers that need a missing package, before data are read.

    Args:
        cfg: configuration of a study, including its baselines.
        compared: further controllers, see :func:`lcc_rl.evaluation.named.controller_of`.
    """
    own = [name for name in cfg.evaluation.baselines if applies(cfg, name)]
    others = [controller_of(spec) for spec in (*own, *compared) if spec != DIRECT]
    for node in nodes_in([cfg.scenario.controllers, *others]):
        getattr(node.kind, "check_installed", lambda: None)()


def build_logger(cfg: TrainConfig) -> Any:
    """Build the logger of the training rows; by default a silent one."""
    return Silent() if cfg.logger is None else cfg.logger.made(("opened",))


def check_variant(cfg: StudyConfig) -> None:
    """Refuse a variant that does not fit the scenario.

    Variant and configuration must both have an agent or none, and connected vehicles need messages.
    """
    try:
        own = load("train", [f"variant={cfg.variant}"])
    except ConfigError:  # a user's variant that only this command line defines
        return
    talks, heard = (MESSAGES in part.scenario.pieces for part in (own, cfg))
    if talks and not heard:
        raise ConfigError(
            f"variant={cfg.variant} is of connected vehicles, and scenario {cfg.scenario.name} has "
            "no messages: use task=platoon-us06, task=platoon-highway or scenario=platoon"
        )
    if learns(cfg) and not learns(own):  # the variant has no automated vehicle, the task has
        raise ConfigError(f"variant={cfg.variant} has no agent: use compare=[{cfg.variant}]")
    if learns(own) and not learns(cfg) and _is_driven_as(cfg, own):
        raise ConfigError(
            f"variant={cfg.variant} is a learned controller, but there is no agent; for a human "
            "driver use variant=idm"
        )


def _is_driven_as(cfg: StudyConfig, own: StudyConfig) -> bool:
    """Whether automated vehicles have the same kind of controller in two configurations."""
    kinds = [part.scenario.controllers[AUTOMATED].kind for part in (cfg, own)]
    return cfg.scenario.vehicles.count(AUTOMATED) > 0 and kinds[0] is kinds[1]


def check_measured(cfg: StudyConfig) -> None:
    """Check that the scenario has the pieces that an evaluation needs."""
    needed = MEASURED[cfg.evaluation.rows]
    lacking = [name for name in needed if cfg.scenario.pieces.get(name) is None]
    require(not lacking, f"scenario.pieces lacks {lacking}, which the evaluation measures")
    rewarded = cfg.evaluation.rows == "episodes" or AUTOMATED in cfg.scenario.vehicles.names
    require(rewarded, "evaluation.rows=vehicles needs an automated vehicle in scenario.string")
