"""Study room: the HCFS study, from drive cycles to every training and evaluation that it needs."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from omegaconf import DictConfig

from lcc_rl.config import load, require
from lcc_rl.envs.factory import Inputs, build_policy, load_inputs
from lcc_rl.evaluation.monte_carlo import Strategy
from lcc_rl.evaluation.platoon_cases import (
    LEARNED,
    changed,
    evaluate_and_write,
    load_learned,
    named_gains,
    yardsticks,
)
from lcc_rl.pipeline import known_settings
from lcc_rl.results.runs import identity, load_config, save_config
from lcc_rl.runs.cli import prepare_torch
from lcc_rl.studies.runner import FINISHED, Outcome, Run, note, note_problems, run_all
from lcc_rl.train import EPISODES

log = logging.getLogger("lcc_rl")

YARDSTICKS = "yardsticks"
UNTUNED = "paper_like"


@dataclass(frozen=True)
class Study:
    """What to run, and where.

    Args:
        folder: where everything goes.
        recipe: ``experiment`` of every training.
        seeds: trainings of the DDPG parent, numbered from 0.
        overrides: further settings of every run.
        jobs: trainings at a time.
        accept: settings in which a run found in the folder may differ.
    """

    folder: Path
    recipe: str = "paper_hcfs"
    seeds: int = 8
    overrides: tuple[str, ...] = ()
    jobs: int = 2
    accept: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("seeds", "jobs"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1")

    def runs(self) -> list[Run]:
        """Return a training of the DDPG parent per seed."""
        # Every strategy drives the whole record in the evaluation; a training need not.
        own = (f"experiment={self.recipe}", f"variant={LEARNED}", *self.overrides)
        return [
            Run(
                self.folder / LEARNED / f"seed_{seed}",
                (*own, "evaluation.full_length=false", f"seed={seed}"),
            )
            for seed in range(self.seeds)
        ]

    def evaluation(self, *own: str) -> DictConfig:
        """Return the configuration of an evaluation of the hybrid."""
        shared = known_settings(list(self.overrides), "evaluate")
        return load("evaluate", [f"experiment={self.recipe}", "variant=hcfs", *shared, *own])


def run(study: Study, command: str = "") -> list[Outcome]:
    """Train the DDPG parents and evaluate every strategy; whatever is finished is skipped.

    Args:
        study: what to run.
        command: what was typed, to be kept in the folder.

    Returns:
        What became of every training.

    Raises:
        LccError: one clear error for wrong settings or files.
    """
    cfg = study.evaluation()
    if command:
        note(study.folder, "hcfs", command)
    outcomes = run_all(study.runs(), study.jobs, study.accept)
    note_problems(study.folder, outcomes)
    prepare_torch(cfg)
    inputs = load_inputs(cfg)
    target = study.folder / "evaluation"
    _evaluate(yardsticks(cfg), cfg, inputs, target / YARDSTICKS, None)
    done = [outcome.run.folder for outcome in outcomes if outcome.status == FINISHED]
    for number, folder in enumerate(sorted(done)):
        # The whole record is long: the first training drives it for all.
        own = study.evaluation(
            f"policy='{folder}'", *(() if number == 0 else ("evaluation.full_length=false",))
        )
        agent, learned = load_learned(own, inputs)
        strategies = hybrid_strategies(own, agent.policy, learned.seed)
        _evaluate(strategies, own, inputs, target / folder.name, folder)
    return outcomes


def hybrid_strategies(cfg: DictConfig, learned: object, seed: int) -> list[Strategy]:
    """Build the DDPG parent and every hybrid of it that the study compares.

    ``hcfs``: as configured, with the tuned rule; ``hcfs untuned``: with the paper-like rule;
    ``hcfs J=10``: a jerk bound that binds; ``hcfs literal``: without the clamp to that bound and
    without the safe cap, as printed; ``hcfs oracle``: knows the leader's next speed.
    """
    untuned = cfg.copy()
    for name, gain in named_gains(UNTUNED).items():
        untuned.controller.rule[name] = gain
    kinds = {
        "hcfs": cfg,
        "hcfs untuned": untuned,
        "hcfs J=10": changed(cfg, jerk_bound=10.0),
        "hcfs literal": changed(cfg, jerk_bound=10.0, clamp=False, safe_cap=False),
        "hcfs oracle": changed(cfg, lookahead="oracle"),
    }
    return [
        Strategy(LEARNED, cfg, learned, seed),
        *(Strategy(name, own, build_policy(own, learned), seed) for name, own in kinds.items()),
    ]


def _evaluate(
    strategies: Sequence[Strategy],
    cfg: DictConfig,
    inputs: Inputs,
    folder: Path,
    trained: Path | None,
) -> pd.DataFrame | None:
    """Evaluate into a folder, unless it holds the same already."""
    if _up_to_date(cfg, folder, trained):
        return None
    log.info("evaluating %d strategies into %s", len(strategies), folder)
    (folder / EPISODES).unlink(missing_ok=True)  # never beside another configuration
    save_config(cfg, folder)
    return evaluate_and_write(list(strategies), cfg, inputs, folder, quiet=True)


def _up_to_date(cfg: DictConfig, folder: Path, trained: Path | None) -> bool:
    table = folder / EPISODES
    if not table.exists() or identity(load_config(folder)) != identity(cfg):
        return False
    newest = 0.0 if trained is None else (trained / "policy.pt").stat().st_mtime
    return table.stat().st_mtime >= newest
