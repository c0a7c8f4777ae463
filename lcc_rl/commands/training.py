"""Training and evaluation of the variant of a configuration."""

from __future__ import annotations

import logging
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.factory import Agent, build_agent, make_trainer, training_env
from lcc_rl.commands.checks import build_logger, check_settings
from lcc_rl.commands.evaluation import evaluate_and_write, made_by
from lcc_rl.config.compose import NOT_IDENTITY, identity, with_inputs
from lcc_rl.config.schemas import TrainConfig
from lcc_rl.envs import Inputs, load_inputs
from lcc_rl.errors import ConfigError, Interrupted, ResultsError
from lcc_rl.evaluation.cases import WINDOW_CASES
from lcc_rl.evaluation.comparison import Comparison
from lcc_rl.evaluation.fit import check_policy
from lcc_rl.evaluation.strategies import Strategy, name_of, rule, with_weights
from lcc_rl.io.files import Rows, as_rows
from lcc_rl.results.platoons import case_table
from lcc_rl.results.policies import load_policy, save_policy
from lcc_rl.results.report import summary, windows_for
from lcc_rl.results.runs import EPISODES, POLICY, RECORD, check_folder, resumed_config, save_config
from lcc_rl.results.trust import trust_option
from lcc_rl.runs.loggers import RowLogger, Silent
from lcc_rl.runs.output import log_report
from lcc_rl.runs.precision import prepare_torch
from lcc_rl.runs.states import CHECKPOINT, forget, working

log = logging.getLogger("lcc_rl")

POLICIES, LAST = "policies", "policy_last.pt"


def run(cfg: TrainConfig, folder: str | Path, quiet: bool = False, resume: bool = False) -> Rows:
    """Train the variant of a configuration, then evaluate it.

    Writes config.yaml; with an agent training.parquet, timing.parquet, checkpoint.pt, policy.pt,
    policies/<iteration>.pt with training.keep_every, and policy_last.pt if agent.best_window
    selects another policy; steps.parquet; and, last, episodes.parquet.

    Args:
        cfg: configuration of the entry point ``train``; with ``resume`` the run in that folder is
            resumed with its settings.
        folder: folder of the results.
        quiet: do not print the table.
        resume: resume from a checkpoint of the same configuration if the folder has one.

    Returns:
        The rows of episodes.parquet; many rows as a dataset, which is read on demand.

    Raises:
        LccError: for any error in settings, data or files, in one line, which is also written to
            error.txt.
    """
    folder = Path(folder)
    if cfg.resume is not None:
        folder = Path(cfg.resume)
        cfg = _resumed(cfg, folder)
    elif (folder / CHECKPOINT).exists() and not resume:
        raise ConfigError(
            f"{folder} already holds a training; resume it with resume={folder} or choose another "
            "hydra.run.dir"
        )
    else:
        cfg = with_inputs(cfg)
        check_folder(cfg, folder, *(NOT_IDENTITY if resume else ()))
    with working(folder):
        return _run(cfg, folder, quiet, (folder / CHECKPOINT).exists())


def _resumed(cfg: TrainConfig, folder: Path) -> TrainConfig:
    """Return the checked configuration of the run in a folder; its logger may be given again."""
    own: TrainConfig = resumed_config(folder, cfg.trust)
    for table in (EPISODES, RECORD):
        if made_by(folder / table) not in (None, identity(own)):
            raise ResultsError(
                f"{folder}: {table} belongs to another configuration than config.yaml; resume with "
                "the settings it was started with"
            )
        if own.learns and (folder / table).exists() and not (folder / CHECKPOINT).exists():
            raise ResultsError(
                f"{folder}: {table} without {CHECKPOINT} cannot be resumed; lcc-rl repeat {folder} "
                "begins again in a new folder"
            )
    return own if isinstance(build_logger(cfg), Silent) else own.with_(logger=cfg.logger)


def _run(cfg: TrainConfig, folder: Path, quiet: bool, resume: bool) -> Rows:
    prepare_torch(cfg)
    check_settings(cfg, folder)
    inputs = load_inputs(cfg)
    log_report(inputs.report)
    agent = weights = None
    if not cfg.learns:
        strategy = rule(cfg)
        log.info("%s has no agent: evaluating it", strategy.name)
    elif cfg.policy is not None:
        cfg, weights, strategy = _given(cfg, inputs)
    else:
        agent = build_agent(cfg, inputs.population, cfg.device)
        strategy = Strategy(
            name_of(cfg), cfg.after_training(), shared_policy(agent.policy), cfg.seed
        )
    comparison = Comparison(cfg, inputs, [strategy])  # before a training, which takes long
    if agent is not None:
        _train(cfg, agent, inputs, folder, resume)
    else:
        save_config(cfg, folder)
    if weights is not None:
        save_policy(weights, cfg, folder / POLICY)
    rows = evaluate_and_write(comparison, inputs, folder, quiet)
    if isinstance(logger := build_logger(cfg), RowLogger):
        logger.log_result(folder, measured(rows))
    return rows


def _given(cfg: TrainConfig, inputs: Inputs) -> tuple[TrainConfig, dict[str, Any], Strategy]:
    """Return configuration, weights and strategy of a variant that uses a trained policy."""
    if cfg.deployed is None:
        raise ConfigError(
            f"policy={cfg.policy}: variant {cfg.variant} uses no trained policy; remove it, "
            "or evaluate a policy by lcc-rl evaluate"
        )
    weights, own = load_policy(str(cfg.policy), cfg.variant, cfg.trust)
    check_policy(cfg, own)
    cfg = cfg.with_(agent=own.agent)
    strategy = with_weights(cfg, weights, own.seed, str(cfg.policy), inputs.population)
    return cfg, weights, replace(strategy, cfg=cfg.after_training())


def _train(cfg: TrainConfig, agent: Agent, inputs: Inputs, folder: Path, resume: bool) -> None:
    """Train an agent to the end and write its policy, which the agent then has."""
    profiles = inputs.to_learn_from()
    agent.take(profiles)
    trainer = make_trainer(cfg, agent, training_env(cfg, profiles, inputs.population), folder)
    first = deepcopy(agent.policy.state_dict())
    if resume:
        trainer.load()
    save_config(cfg, folder, resume)
    trainer.on_keep = lambda iteration: save_policy(
        agent.policy.state_dict(), cfg, folder / POLICIES / f"{iteration:06d}.pt"
    )
    with build_logger(cfg).opened(folder) as trainer.on_row:
        try:
            trainer.run()
        except Interrupted as error:
            raise Interrupted(f"{error}{trust_option(cfg)}") from error
    weights = agent.policy.state_dict()
    if all(torch.equal(weights[name], value) for name, value in first.items()):
        log.warning(
            "the training changed nothing: it made no update, or every gradient was 0; the rows "
            "are those of the initial policy"
        )
    if trainer.best is not None:
        save_policy(agent.policy.state_dict(), cfg, folder / LAST)
        agent.policy.load_state_dict(trainer.best["weights"])
        log.info("the policy is that of iteration %s of the training", trainer.best["iteration"])
    save_policy(agent.policy.state_dict(), cfg, folder / POLICY)


def complete(cfg: TrainConfig, folder: Path) -> Rows:
    """Complete a run of a sweep: skip a finished one, resume a stopped one."""
    table = folder / EPISODES
    if made_by(table) == identity(cfg):
        log.info("%s: finished before", folder.name)
        forget(folder)
        return as_rows(table)
    return run(cfg, folder, quiet=True, resume=True)


def measured(rows: Rows) -> dict[str, Any]:
    """Return the last row of the summary, that of the trained strategy."""
    # From its rows, because a resumed run has its own variant.
    vehicles = isinstance(rows, pd.DataFrame) and "follower" in rows
    table = case_table(rows, WINDOW_CASES) if vehicles else summary(windows_for(rows))
    return {str(key): value for key, value in table.iloc[-1].items()}
