"""Checks of settings before expensive work starts."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

from torchrl.envs import TransformedEnv

from lcc_rl.agents.factory import build_agent, check_lengths, make_trainer, training_env
from lcc_rl.config.nodes import CALLED
from lcc_rl.config.schemas import StudyConfig, TrainConfig
from lcc_rl.envs import build_env
from lcc_rl.envs.factory import moment_bytes
from lcc_rl.envs.inputs import LOADS, build_drivers, constant_profiles
from lcc_rl.envs.rollout import OBSERVATION
from lcc_rl.envs.step import pieces_of
from lcc_rl.errors import ConfigError, require
from lcc_rl.evaluation.entrants import check_installed
from lcc_rl.evaluation.fit import MESSAGES, check_table_unit, check_variant
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.io.memory import require_memory
from lcc_rl.runs.loggers import Silent

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
    trial = cfg.for_any_leader().with_(training={"environments": 2, "episodes": 2})
    horizon, time_step = cfg.scenario.horizon, cfg.scenario.time_step
    profiles = constant_profiles(10.0, horizon, time_step, ["trial"])
    if not cfg.learns or cfg.deployed is not None:
        build_env(trial.after_training(), profiles, population, 1, 0, cfg.device, nominal=True)
    if cfg.learns:
        check_lengths(cfg)
        env = training_env(trial, profiles, population)
        require_memory(training_bytes(cfg, env), cfg.device)
        agent = build_agent(cfg, population, cfg.device)
        make_trainer(trial, agent, env, folder)


def training_bytes(cfg: StudyConfig, env: TransformedEnv) -> dict[str, float]:
    """Return the least memory that a training needs by option [bytes]."""
    settings, agent = cfg.training, cfg.agent.settings
    count, moment = settings.environments, moment_bytes(pieces_of(env))
    vehicles, width = env.observation_spec[OBSERVATION].shape[-2:]
    transition = 4 * (2 * width + 2)  # before, after, action and reward
    needs = {f"training.episodes={settings.episodes}": settings.episodes / count * RECORD_BYTES}
    if isinstance(hidden := agent.get("hidden"), list):
        sizes = [width, *hidden, 1]
        weights = sum((before + 1) * after for before, after in pairwise(sizes))
        copies = 10 if "buffer_size" in agent else 4  # gradient, two moments; critic, targets
        needs[f"agent.hidden={hidden}"] = 4.0 * copies * weights
    if "buffer_size" in agent:
        played = KEPT_MOMENTS * moment + 2 * cfg.scenario.horizon * vehicles * transition
        learned = 2 * transition + 16 * sum(agent["hidden"])
        needs[f"agent.buffer_size={agent['buffer_size']}"] = agent["buffer_size"] * transition
        needs[f"agent.batch_size={agent['batch_size']}"] = agent["batch_size"] * learned
    else:
        played = KEPT_MOMENTS * moment * settings.segment
    return {f"training.environments={count}": count * played, **needs}


def build_logger(cfg: TrainConfig) -> Any:
    """Build the logger of the training rows; by default a silent one."""
    return Silent() if cfg.logger is None else cfg.logger.made(("opened",))


def check_measured(cfg: StudyConfig) -> None:
    """Check that the scenario has the pieces that an evaluation needs, and the unit of tables."""
    check_table_unit(cfg)
    rows = cfg.evaluation.rows
    needed = MEASURED[rows]
    lacking = [name for name in needed if cfg.scenario.pieces.get(name) is None]
    require(not lacking, f"scenario.pieces lacks {lacking}, which the evaluation measures")
    rewarded = rows == "episodes" or AUTOMATED in cfg.scenario.vehicles.names
    require(rewarded, "evaluation.rows=vehicles needs an automated vehicle in scenario.string")
