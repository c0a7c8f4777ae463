"""Builds agents and training loops from configurations."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv

from lcc_rl.agents.agent import Agent, Scene
from lcc_rl.agents.loop import TrainingLoop
from lcc_rl.config.compose import identity
from lcc_rl.config.schemas import StudyConfig
from lcc_rl.data.profiles import Profiles
from lcc_rl.envs import build_env
from lcc_rl.envs.factory import after_humans, warm_up_steps, world_of
from lcc_rl.errors import ConfigError, raised_as, require
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.pieces import Hybrid, Observation
from lcc_rl.pieces.controllers import Population


def build_agent(cfg: StudyConfig, population: Population, device: str = "cpu") -> Agent:
    """Build the agent of a configuration.

    Raises:
        ConfigError: if there is no agent, or naming the option at fault.
    """
    require(cfg.learns, f"variant {cfg.variant} has no agent")
    world = world_of(cfg, population=population)
    observation = cfg.observation.made(Observation).bind(world)
    node = cfg.scenario.controllers.get(AUTOMATED)
    driver = node and node.made()
    named = getattr(driver, "max_acceleration", None)
    limit = driver.scale if isinstance(driver, Hybrid) else named
    scene = Scene(observation.event_shape[-1], cfg.seed, device, world, observation, limit)
    agent: Agent = cfg.agent.made(Agent)
    learner = agent.start(scene)
    where = f"agent: {type(agent).__name__}"
    loop, policy = (getattr(learner, name, None) for name in ("loop", "policy"))
    require(
        inspect.isclass(loop) and issubclass(loop, TrainingLoop),
        f"{where}.loop must be a class derived from lcc_rl.agents.TrainingLoop, got {loop!r}",
    )
    keys = [getattr(policy, name, None) for name in ("in_keys", "out_keys")]
    if not isinstance(policy, TensorDictModule) or keys != [["observation"], ["action"]]:
        raise ConfigError(
            f"{where}.policy must be a TensorDictModule from 'observation' to 'action', such as "
            f"make_actor's, got {type(policy).__name__}"
        )
    words = f"{where}.policy fails for observations of {scene.observation_size} numbers"
    with raised_as(ConfigError, words, Exception), torch.no_grad():  # any error of a module
        seen = TensorDict({"observation": torch.zeros(2, scene.observation_size)}, [2])
        action = policy(seen.to(device)).get("action")
        found, expected = [*action.shape, action.dtype], [2, 1, torch.get_default_dtype()]
        require(found == expected, f"expected an action {expected}, got {found}")
    return learner


def training_env(cfg: StudyConfig, profiles: Profiles, population: Population) -> TransformedEnv:
    """Build the environment of a training.

    Raises:
        ConfigError: naming the option at fault.
    """
    agent = cfg.agent.made(Agent)
    if hold := getattr(agent, "hold", 0.0):
        drivers = cfg.scenario.controllers
        held = {**drivers, AUTOMATED: drivers[AUTOMATED].changed(hold=hold)}
        cfg = cfg.with_(scenario={"controllers": held})
    driven = after_humans(cfg, getattr(agent, "humans_first", 0.0))
    return build_env(driven, profiles, population, cfg.training.environments, 0, cfg.device)


def make_trainer(
    cfg: StudyConfig, agent: Agent, env: TransformedEnv, folder: Path
) -> TrainingLoop[Any]:
    """Build the training loop of an agent in an environment, see :func:`training_env`."""
    return agent.loop(agent, env, cfg.training, cfg.seed, folder, identity(cfg))


def check_lengths(cfg: StudyConfig) -> None:
    """Check that the lengths of a training and of its parts are consistent.

    Raises:
        ConfigError: naming two that are not.
    """
    settings, horizon = cfg.training, cfg.scenario.horizon
    warm_up_steps(cfg.scenario, cfg.evaluation.warm_up, "evaluation.warm_up")
    warm_up = cfg.agent.settings.get("warm_up") or 0.0
    skipped = warm_up_steps(cfg.scenario, warm_up, "agent.warm_up")
    message = f"training.segment ({settings.segment}; its default is of agent={cfg.agent.name}) "
    message += f"must divide {horizon - skipped}, scenario.horizon ({horizon})"
    less = f" less {skipped} steps of agent.warm_up (by default evaluation.warm_up)"
    require((horizon - skipped) % settings.segment == 0, message + less * bool(skipped))
    agent = cfg.agent.made()
    every = getattr(agent, "hold", 0.0) / cfg.scenario.time_step
    require(
        settings.segment % max(every, 1.0) < 1e-6,
        f"agent.hold ({every:g} steps) must divide training.segment ({settings.segment})",
    )
    steps = getattr(agent, "n_step", 1) * max(every, 1.0)
    require(
        steps < settings.segment + 0.5,
        f"agent.n_step ({steps:g} steps with agent.hold) must not exceed training.segment "
        f"({settings.segment}), in which returns end",
    )
    window = getattr(agent, "best_window", None) or 0
    count = settings.environments
    require(
        window % count == 0 and window <= settings.episodes,
        f"agent.best_window ({window}) must be a multiple of training.environments ({count}) and "
        f"at most training.episodes ({settings.episodes}), or null: the last policy is kept",
    )
