"""Benchmark of the Monte Carlo evaluation, its results written."""

from __future__ import annotations

from argparse import Namespace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.harness import Row, alternate, rows_of
from benchmarks.plain import study
from lcc_rl.agents.factory import build_agent
from lcc_rl.evaluation.episodes import evaluate as play
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.io.files import write_parquet
from lcc_rl.policies import shared_policy


def evaluate(options: Namespace) -> list[Row]:
    """Seconds of a Monte Carlo evaluation of an untrained actor, its results written."""
    cfg, inputs = study(options.quick)
    agent = build_agent(cfg, inputs.population, options.device)
    strategy = Strategy("untrained", cfg, shared_policy(agent.policy))
    settings, drivers = cfg.evaluation, 2 if options.quick else cfg.evaluation.drivers
    how = (drivers, settings.batch_size, settings.seed, settings.sample_episodes, options.device)
    count = len(inputs.evaluation) * (drivers or len(inputs.population.time_gap))

    def run(folder: str) -> None:
        episodes, steps = play(strategy, inputs, *how)
        write_parquet(episodes, Path(folder, "episodes.parquet"))
        write_parquet(steps, Path(folder, "steps.parquet"))

    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as name:
        (spent,) = alternate({"run": partial(run, name)}, options.repeats).values()
    case, batch = f"{count} episodes of {cfg.scenario.horizon}", settings.batch_size
    rows = rows_of("evaluate", {case: spent}, "s", None, batch)
    return rows + rows_of("evaluate", {case: count / spent}, "episodes/s", None, batch)
