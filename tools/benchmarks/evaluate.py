"""Benchmark of the Monte Carlo evaluation, its results written."""

from __future__ import annotations

from argparse import Namespace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.harness import Row, Run, endings, rates
from benchmarks.plain import study
from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.factory import build_agent
from lcc_rl.evaluation.episodes import Episodes, Plan
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.io.files import write_parquet


def evaluate(options: Namespace) -> list[Row]:
    """Return episodes per second of an untrained actor, rows and time series written."""
    cfg, inputs = study(options.quick)
    agent = build_agent(cfg, inputs.population)
    strategy = Strategy("untrained", cfg, shared_policy(agent.policy))
    settings, people = cfg.evaluation, len(inputs.population.time_gap)
    drivers = 2 if options.quick else settings.drivers
    plan = Plan(len(inputs.evaluation), people, drivers, settings.batch_size)
    how = (strategy, inputs, plan, settings.seed, settings.sample_episodes)
    rows: list[Row] = []
    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as name:
        for ending in endings(options):
            episodes = Episodes(*how, compiled=bool(ending))
            own = f"evaluation{ending}"
            run: Run = partial(written, episodes, Path(name))
            rows += rates(options, {own: run}, "episodes/s", {own: len(plan)}, {}, plan.size)
    return rows


def written(episodes: Episodes, folder: Path) -> None:
    """Play all episodes and write their rows and time series."""
    for block in episodes.plan.own:
        rows, steps = episodes.play(block)
        write_parquet(rows, folder / f"{block}.parquet")
        write_parquet(steps, folder / f"{block}_steps.parquet")
