"""Entry point: train a variant and evaluate it on held-out profiles, ``python -m lcc_rl.train``."""

from __future__ import annotations

import logging
from pathlib import Path

import pandas as pd
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from lcc_rl.agents.training import Trainer
from lcc_rl.cli import entry_point, prepare_torch, run_folder
from lcc_rl.config import require
from lcc_rl.envs.factory import Inputs, build_agent, build_env, build_policy, load_inputs
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation import platoon_cases
from lcc_rl.evaluation.monte_carlo import Strategy, evaluate
from lcc_rl.results.files import write_parquet
from lcc_rl.results.runs import identity, load_config, save_config, save_policy
from lcc_rl.results.tables import as_rich, summary

log = logging.getLogger("lcc_rl")

MEASURED = ("cav_ttc", "cav_time_gap", "cav_power", "hdv_power")


def run(cfg: DictConfig, folder: str | Path, quiet: bool = False) -> pd.DataFrame:
    """Train the variant of a configuration, then evaluate it.

    Writes config.yaml, training.parquet, timing.parquet, checkpoint.pt, policy.pt,
    episodes.parquet and steps.parquet; the first four only where something is learned.

    Args:
        cfg: configuration of the entry point ``train``; with ``resume`` the run in that folder
            goes on with its own settings instead.
        folder: where the files go.
        quiet: do not print the table.

    Returns:
        The rows of episodes.parquet.

    Raises:
        LccError: one clear error for whatever is wrong with settings, data or files.
    """
    folder, resume = Path(folder), cfg.resume is not None
    if resume:
        folder = Path(cfg.resume)
        cfg = load_config(folder)
    elif (folder / "checkpoint.pt").exists():
        raise ConfigError(
            f"{folder} already holds a training; go on with resume={folder} or choose another "
            "hydra.run.dir"
        )
    prepare_torch(cfg)
    check_sizes(cfg)
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
        env = build_env(
            cfg, inputs.training, inputs.population, cfg.training.environments, 0, cfg.device
        )
        trainer = Trainer(agent, env, cfg.training, cfg.seed, folder, identity(cfg))
        if resume:
            trainer.load()
        trainer.run()
        save_policy(agent.policy.state_dict(), cfg, folder / "policy.pt")
    else:
        log.info("variant %s learns nothing: evaluating it", cfg.variant)
    policy = build_policy(cfg, agent.policy)
    strategy = Strategy(cfg.variant, cfg, policy, seed if agent.learns else None)
    return evaluate_and_write([strategy], cfg, inputs, folder, quiet)


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
    write_parquet(episodes, folder / "episodes.parquet", metadata)
    write_parquet(steps, folder / "steps.parquet", metadata)
    title = (
        f"{len(inputs.evaluation)} held-out profiles × "
        f"{episodes['driver_id'].nunique()} drivers, {cfg.scenario.horizon} steps"
    )
    if not quiet:
        Console().print(as_rich(summary(episodes), title))
    return episodes


@entry_point("train")
def main(cfg: DictConfig) -> None:
    """Train into the run's folder."""
    others = [item for item in HydraConfig.get().overrides.task if not item.startswith("resume=")]
    if cfg.resume is not None and others:
        raise ConfigError(
            f"resume goes on with the settings the run was started with; remove {' '.join(others)}"
        )
    folder = Path(cfg.resume) if cfg.resume is not None else run_folder()
    run(cfg, folder)
    log.info("results in %s", folder)


if __name__ == "__main__":
    main()
