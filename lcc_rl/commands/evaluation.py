"""Evaluates strategies in the scenario of a configuration and writes their rows."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from omegaconf import DictConfig

from lcc_rl.agents.factory import learns
from lcc_rl.commands.checks import check_evaluation, check_sizes, check_variant
from lcc_rl.config import identity
from lcc_rl.envs import Inputs, load_inputs
from lcc_rl.errors import ConfigError, unknown_name
from lcc_rl.evaluation import cases, episodes
from lcc_rl.evaluation.naming import check_distinct, named_apart
from lcc_rl.evaluation.strategies import (
    Strategy,
    baselines,
    studied,
    trained,
)
from lcc_rl.io.files import write_parquet
from lcc_rl.results.policies import PRETRAINED, load_policy
from lcc_rl.results.runs import check_folder, save_config
from lcc_rl.results.savings import by_source
from lcc_rl.results.string_tables import as_rich as vehicles_as_rich
from lcc_rl.results.string_tables import case_table
from lcc_rl.results.tables import as_rich, leader_too_fast, show, summary
from lcc_rl.runs.precision import prepare_torch
from lcc_rl.runs.states import check_present, claim

log = logging.getLogger("lcc_rl")

EPISODES, STEPS = "episodes.parquet", "steps.parquet"
ROWS = ("episodes", "vehicles")


def run(
    cfg: DictConfig,
    folder: str | Path,
    own: bool = True,
    quiet: bool = False,
    replace: bool = False,
) -> pd.DataFrame:
    """Evaluate a policy or rule, those it is compared with, and the baselines.

    All meet the same profiles, drivers and noise. Writes config.yaml, steps.parquet,
    episodes.parquet and figures.

    Args:
        cfg: configuration of the entry point ``evaluate``.
        folder: where the files go.
        own: evaluate the configuration's own variant, not only what it is compared with.
        quiet: write the rows only: print no table, draw no figures.
        replace: write over an evaluation of other settings.

    Returns:
        The rows of episodes.parquet.

    Raises:
        LccError: one clear error for whatever is wrong with settings, data or files.
    """
    with claim(Path(folder)):
        if not replace:
            check_folder(cfg, Path(folder))
        return _run(cfg, Path(folder), own, quiet, replace)


def _run(cfg: DictConfig, folder: Path, own: bool, quiet: bool, replace: bool) -> pd.DataFrame:
    prepare_torch(cfg)
    check_sizes(cfg)
    if own:
        check_variant(cfg)
    if cfg.policy not in (None, PRETRAINED) and not learns(cfg):
        raise ConfigError(f"variant {cfg.variant} learns nothing: remove policy={cfg.policy}")
    strategies, inputs = _strategies(cfg, own)
    if replace:  # rows of other settings must never stand beside this configuration
        (folder / EPISODES).unlink(missing_ok=True)
    save_config(cfg, folder)
    rows = evaluate_and_write(strategies, cfg, inputs, folder, quiet)
    if not quiet:
        _draw(cfg, folder)
    return rows


def _draw(cfg: DictConfig, folder: Path) -> None:
    # Here: a training, which draws nothing, need not load matplotlib.
    from lcc_rl.results.figures import write_study_figures
    from lcc_rl.results.string_figures import write_platoon_figures

    draw = write_study_figures if cfg.evaluation.rows == "episodes" else write_platoon_figures
    draw(folder)


def _strategies(cfg: DictConfig, own: bool) -> tuple[list[Strategy], Inputs]:
    """Build all strategies of an evaluation, and read what they are evaluated on."""
    # Before the data: a missing file should not be noticed after minutes of reading.
    trust, policy = tuple(cfg.trust), None
    if cfg.policy is not None and learns(cfg):
        policy = load_policy(cfg.policy, cfg.variant, trust)
    compared = {path: load_policy(path, cfg.variant, trust) for path in cfg.compare}
    inputs = load_inputs(cfg)
    for line in inputs.report:
        log.info(line)
    check_evaluation(cfg, inputs)
    strategies = baselines(cfg)
    strategies += [trained(cfg, path, compared[path], inputs.population) for path in cfg.compare]
    if own:
        strategies += studied(cfg, policy, inputs.population)
    for strategy in (s for s in strategies if s.policy is not None):
        cases.check_cases(strategy.cfg, inputs)
    strategies = named_apart(strategies)
    check_distinct(strategies)
    return strategies, inputs


def evaluate_and_write(
    strategies: Sequence[Strategy],
    cfg: DictConfig,
    inputs: Inputs,
    folder: Path,
    quiet: bool = False,
) -> pd.DataFrame:
    """Evaluate strategies on the held-out profiles, write the rows and print the summary.

    Raises:
        ConfigError: if ``evaluation.rows`` is unknown.
    """
    results = [_evaluate(strategy, cfg, inputs) for strategy in strategies]
    metadata = {"lcc_rl.config": identity(cfg)}
    rows = pd.concat([table for table, _ in results], ignore_index=True)
    steps = pd.concat([trace for _, trace in results], ignore_index=True)
    check_present(folder)
    write_parquet(steps, folder / STEPS, metadata)
    # Last: who finds it finds a finished run.
    write_parquet(rows, folder / EPISODES, metadata)
    for line in leader_too_fast(rows):
        log.warning(line)
    if not quiet:
        _show(rows, cfg, inputs)
    return rows


def _evaluate(
    strategy: Strategy, cfg: DictConfig, inputs: Inputs
) -> tuple[pd.DataFrame, pd.DataFrame]:
    settings = cfg.evaluation
    if settings.rows not in ROWS:
        raise unknown_name("choice of evaluation.rows", str(settings.rows), ROWS)
    if settings.rows == "vehicles":
        return cases.evaluate(strategy, cfg, inputs)
    return episodes.evaluate(
        strategy,
        inputs,
        settings.drivers,
        settings.batch_size,
        settings.seed,
        settings.sample_episodes,
        cfg.device,
    )


def _show(rows: pd.DataFrame, cfg: DictConfig, inputs: Inputs) -> None:
    """Print the summary of an evaluation."""
    for source, part in by_source(rows):
        of = f"{source}: " if source else ""
        if cfg.evaluation.rows == "vehicles":
            for case in dict.fromkeys(part["case"]):
                show(vehicles_as_rich(case_table(part, case), f"{of}{case}"))
            continue
        title = (
            f"{of}{part['profile_id'].nunique()} held-out profiles × "
            f"{part['driver_id'].nunique()} drivers, {cfg.scenario.horizon} steps"
        )
        show(as_rich(summary(part), title))
