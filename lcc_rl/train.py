"""Entry point: train a variant and evaluate it on held-out profiles, ``python -m lcc_rl.train``."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from lcc_rl.agents import Analytic
from lcc_rl.agents.analytic import GradientTrainer
from lcc_rl.agents.loop import TrainingLoop
from lcc_rl.agents.training import Trainer
from lcc_rl.config import TARGET, TrainConfig, build, find_target, is_sweep, load, require
from lcc_rl.data.profiles import Profiles, from_records
from lcc_rl.envs.factory import (
    Inputs,
    any_leader,
    build_agent,
    build_env,
    build_policy,
    load_inputs,
)
from lcc_rl.envs.factory import learns as learned
from lcc_rl.errors import ConfigError, unknown_name
from lcc_rl.evaluation import platoon_cases
from lcc_rl.evaluation.monte_carlo import Strategy, evaluate
from lcc_rl.io.files import parquet_metadata, read_parquet, remove_leftovers, write_parquet
from lcc_rl.pieces.vehicles import Population
from lcc_rl.results.runs import identity, load_config, save_config, save_policy
from lcc_rl.results.string_tables import case_table
from lcc_rl.results.tables import as_rich, show, summary
from lcc_rl.runs.cli import entry_point, prepare_torch, run_folder
from lcc_rl.runs.loggers import Silent
from lcc_rl.runs.states import working

log = logging.getLogger("lcc_rl")

EPISODES, POLICIES = "episodes.parquet", "policies"
# What a sweeper may optimise: columns of the summary that need no other strategy beside them.
OBJECTIVES = (
    "kj_per_km",
    "total_energy_kj",
    "total_net_energy_kj",
    "cav_energy_kj",
    "hdv_energy_kj",
    "collisions",
    "min_ttc_s",
    "share_ttc_unsafe",
    "share_time_gap_long",
    "rms_jerk_mps3",
)
# ... and of a platoon's table of windows; it has no energies, the default is read as the first.
PLATOON_OBJECTIVES = ("speed_error_sum_mps", "jerk_sum_mps3", "collisions", "peak_jerk_mps3")
MEASURED = ("cav_ttc", "cav_time_gap", "cav_power", "hdv_power")


def run(
    cfg: DictConfig, folder: str | Path, quiet: bool = False, go_on: bool = False
) -> pd.DataFrame:
    """Train the variant of a configuration, then evaluate it.

    Writes config.yaml, training.parquet, timing.parquet, checkpoint.pt, policy.pt, steps.parquet
    and, last, episodes.parquet; the first four after config.yaml only where something is learned,
    and policies/<iteration>.pt where training.keep_every says so.

    Args:
        cfg: configuration of the entry point ``train``; with ``resume`` the run in that folder
            goes on with its own settings instead.
        folder: where the files go.
        quiet: do not print the table.
        go_on: go on from a checkpoint of the same configuration where the folder has one.

    Returns:
        The rows of episodes.parquet.

    Raises:
        LccError: one clear error for whatever is wrong with settings, data or files; it is also
            left in the folder as error.txt.
    """
    folder, resume = Path(folder), cfg.resume is not None
    if resume:
        folder = Path(cfg.resume)
        cfg = load_config(folder, tuple(cfg.trust))
    elif (folder / "checkpoint.pt").exists() and not go_on:
        raise ConfigError(
            f"{folder} already holds a training; go on with resume={folder} or choose another "
            "hydra.run.dir"
        )
    with working(folder):
        return _run(cfg, folder, quiet, resume or (folder / "checkpoint.pt").exists())


def _run(cfg: DictConfig, folder: Path, quiet: bool, resume: bool) -> pd.DataFrame:
    prepare_torch(cfg)
    check_settings(cfg, folder)
    inputs = load_inputs(cfg)
    for line in inputs.report:
        log.info(line)
    save_config(cfg, folder)
    agent, seed = build_agent(cfg, inputs.population, cfg.device), cfg.seed
    if agent.learns and cfg.get("policy") is not None:
        require(
            cfg.controller is not None,
            f"policy={cfg.policy}: variant {cfg.variant} builds on no trained policy; remove it, "
            "or say python -m lcc_rl.evaluate to evaluate one",
        )
        agent, own = platoon_cases.load_learned(cfg, inputs)
        cfg.agent, seed = own.agent, own.seed
        save_config(cfg, folder)
        save_policy(agent.policy.state_dict(), cfg, folder / "policy.pt")
    elif agent.learns:
        trainer = make_trainer(cfg, agent, inputs.training, inputs.population, folder)
        if resume:
            trainer.load()
        remove_leftovers(folder / POLICIES)
        trainer.on_keep = partial(keep_policy, agent, cfg, folder)
        with row_logger(cfg).opened(folder) as trainer.on_row:
            trainer.run()
        save_policy(agent.policy.state_dict(), cfg, folder / "policy.pt")
    else:
        log.info("variant %s learns nothing: evaluating it", cfg.variant)
    policy = build_policy(cfg, agent.policy)
    strategy = Strategy(cfg.variant, cfg, policy, seed if agent.learns else None)
    return evaluate_and_write([strategy], cfg, inputs, folder, quiet)


def keep_policy(agent: Any, cfg: DictConfig, folder: Path, iteration: int) -> None:
    """Write the policy as it is after an iteration to ``policies/<iteration>.pt``."""
    path = folder / POLICIES / f"{iteration:06d}.pt"
    save_policy(agent.policy.state_dict(), cfg, path)


def row_logger(cfg: DictConfig) -> Any:
    """Build what is told every training row; nothing is, in runs from before there was a choice."""
    node = cfg.get("logger")
    return Silent() if node is None else build(node, "logger")


def make_trainer(
    cfg: DictConfig, agent: Any, profiles: Profiles, population: Population, folder: Path
) -> TrainingLoop:
    """Build the training loop of an agent with its environment."""
    env = build_env(cfg, profiles, population, cfg.training.environments, 0, cfg.device)
    loop = GradientTrainer if isinstance(agent, Analytic) else Trainer
    return loop(agent, env, cfg.training, cfg.seed, folder, identity(cfg))


def complete(cfg: DictConfig, folder: Path) -> pd.DataFrame:
    """Bring a run of a sweep to its end: skip it where finished, go on where it stopped."""
    table = folder / EPISODES
    if table.exists() and parquet_metadata(table).get("lcc_rl.config") == identity(cfg):
        log.info("%s: finished before", folder.name)
        return read_parquet(table)
    return run(cfg, folder, quiet=True, go_on=True)


def objective(cfg: DictConfig, episodes: pd.DataFrame) -> float | list[float]:
    """Return what a sweeper is to optimise: columns of the summary that ``objective`` names."""
    # By its rows: a resumed run is not of the variant that the command line composed.
    platoon = "follower" in episodes
    table = case_table(episodes, platoon_cases.WINDOWS) if platoon else summary(episodes)
    values = [float(table.iloc[-1][name]) for name in objectives(cfg, platoon)]
    return values[0] if isinstance(cfg.objective, str) else values


def objectives(cfg: DictConfig, platoon: bool) -> list[str]:
    """Return the columns that ``objective`` names; a run made before there was any has none."""
    wanted = cfg.get("objective", TrainConfig.objective)
    names = [wanted] if isinstance(wanted, str) else list(wanted)
    return [PLATOON_OBJECTIVES[0]] if platoon and names == [TrainConfig.objective] else names


def check_settings(cfg: DictConfig, folder: Path) -> None:
    """Check every setting before the data are read, which may take long.

    Everything is built once, around a leader at constant speed.

    Raises:
        ConfigError: naming the option.
    """
    check_agent(cfg)
    check_sizes(cfg)
    check_objective(cfg)
    row_logger(cfg)
    for key in ("data", "split"):
        build(cfg[key], key)
    population = build(cfg.drivers, "drivers")
    agent = build_agent(cfg, population, cfg.device)
    check_variant(cfg, agent.learns)
    trial = any_leader(cfg)
    steps = cfg.scenario.horizon + 1
    speed = torch.full((max(2, steps),), 10.0)
    profiles = from_records([speed], ["trial"], ["trial"], cfg.scenario.time_step)
    if agent.learns:
        make_trainer(trial, agent, profiles, population, folder)
    else:
        build_env(trial, profiles, population, 1, 0, cfg.device)


def has_car(cfg: DictConfig) -> bool:
    """Whether the scenario has one controlled car; overrides of it alone make none."""
    return TARGET in cfg.scenario.pieces.get("cav", {})


def check_agent(cfg: DictConfig) -> None:
    """Refuse the analytic agent where there is no car of its own to drive.

    Raises:
        ConfigError: naming the variant.
    """
    analytic = find_target(cfg.agent[TARGET], "agent") is Analytic
    require(
        not analytic or has_car(cfg),
        f"agent=analytic drives the one car of alcc, reference and own_energy; variant "
        f"{cfg.variant} has none",
    )


def check_variant(cfg: DictConfig, learns: bool) -> None:
    """Refuse a learner under the name of a variant that learns nothing, and the reverse.

    Raises:
        ConfigError: naming both.
    """
    try:
        own = load("train", [f"variant={cfg.variant}"])
    except ConfigError:  # a variant of the user's own, known to this command line only
        return
    if learned(own) and not learns:
        raise ConfigError(
            f"variant={cfg.variant} is a learned controller, agent {cfg.agent._target_} learns "
            "nothing; for a human driver say variant=idm"
        )
    if learns and not learned(own):
        raise ConfigError(
            f"variant={cfg.variant} learns nothing: remove agent=…, or choose a learned variant"
        )


def check_objective(cfg: DictConfig) -> None:
    """Check that ``objective`` names columns of the summary.

    Raises:
        ConfigError: naming the unknown one.
    """
    platoon = cfg.scenario.name == platoon_cases.SCENARIO
    names = objectives(cfg, platoon)
    require(bool(names), "objective is empty: name at least one column of the summary")
    known = PLATOON_OBJECTIVES if platoon else OBJECTIVES
    for name in names:
        if name not in known:
            raise unknown_name("objective", str(name), known)


def check_sizes(cfg: DictConfig) -> None:
    """Check, before anything runs, what would fail only at its end.

    Raises:
        ConfigError: naming the option.
    """
    sizes = {f"evaluation.{key}": cfg.evaluation[key] for key in ("profiles", "drivers")}
    sizes["evaluation.batch_size"] = cfg.evaluation.batch_size
    if not OmegaConf.is_missing(cfg.training, "environments"):
        sizes["training.environments"] = cfg.training.environments
    for name, value in sizes.items():
        require(value is None or value >= 1, f"{name} must be at least 1, got {value}")
    pieces = cfg.scenario.pieces
    require(
        pieces.get("barrier") is None or has_car(cfg),
        f"+filter=barrier belongs to a car of its own (alcc, reference, own_energy, idm), "
        f"not to {cfg.variant}",
    )
    measured = [name for name in MEASURED if "cav" in pieces and name not in pieces]
    require(not measured, f"scenario.pieces lacks {measured}, which the evaluation measures")
    step = cfg.scenario.time_step
    require(step > 0, f"scenario.time_step must be positive, got {step}")


def evaluate_and_write(
    strategies: list[Strategy],
    cfg: DictConfig,
    inputs: Inputs,
    folder: Path,
    quiet: bool = False,
) -> pd.DataFrame:
    """Evaluate strategies on the held-out profiles, write the rows and print the summary."""
    if cfg.scenario.name == platoon_cases.SCENARIO:
        return platoon_cases.evaluate_and_write(strategies, cfg, inputs, folder, quiet)
    settings = cfg.evaluation
    results = [
        evaluate(
            strategy,
            inputs.evaluation,
            inputs.population,
            settings.drivers,
            settings.batch_size,
            settings.seed,
            settings.sample_episodes,
            cfg.device,
        )
        for strategy in strategies
    ]
    metadata = {"lcc_rl.config": identity(cfg)}
    episodes = pd.concat([rows for rows, _ in results], ignore_index=True)
    steps = pd.concat([trace for _, trace in results], ignore_index=True)
    write_parquet(steps, folder / "steps.parquet", metadata)
    # Last: who finds it finds a finished run.
    write_parquet(episodes, folder / EPISODES, metadata)
    title = (
        f"{len(inputs.evaluation)} held-out profiles × "
        f"{episodes['driver_id'].nunique()} drivers, {cfg.scenario.horizon} steps"
    )
    if not quiet:
        show(as_rich(summary(episodes), title))
    return episodes


@entry_point("train")
def main(cfg: DictConfig) -> float | list[float]:
    """Train into the run's folder; return the objective to a sweeper that optimises."""
    own = ("resume", "trust")
    typed = HydraConfig.get().overrides.task
    others = [item for item in typed if item.split("=")[0] not in own]
    if cfg.resume is not None and others:
        raise ConfigError(
            f"resume goes on with the settings the run was started with; remove {' '.join(others)}"
        )
    folder = Path(cfg.resume) if cfg.resume is not None else run_folder()
    episodes = complete(cfg, folder) if is_sweep() else run(cfg, folder)
    log.info("results in %s", folder)
    return objective(cfg, episodes)


if __name__ == "__main__":
    main()
