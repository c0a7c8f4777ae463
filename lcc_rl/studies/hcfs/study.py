"""The HCFS study: trainings and evaluations."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from lcc_rl.commands.evaluation import evaluate_and_write, made_by
from lcc_rl.commands.pipeline import known_settings, train_all
from lcc_rl.config.compose import identity, load, with_inputs
from lcc_rl.config.schemas import StudyConfig, TrainConfig
from lcc_rl.config.words import quoted, top_key
from lcc_rl.envs import Inputs, load_inputs
from lcc_rl.evaluation.comparison import Comparison
from lcc_rl.evaluation.fit import check_policy
from lcc_rl.evaluation.strategies import Strategy, baselines, with_weights
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.results.policies import load_policy
from lcc_rl.results.runs import EPISODES, STEPS, save_config
from lcc_rl.runs.precision import prepare_torch
from lcc_rl.studies.hcfs.tables import LEARNED, per_run, rounded
from lcc_rl.studies.study import Study

log = logging.getLogger("lcc_rl")

RECIPE = "paper_hcfs"
BASELINES_FOLDER = "baselines"  # folder of the evaluation of untrained strategies
UNTUNED = "paper_like"
TRAINING = "training.parquet"
# A second whole record besides that of the default leader.
WLTC = "+leader.full_length.wltc={path: wltc_3b, scale: 0.5}"


def trainings(study: Study) -> dict[str, TrainConfig]:
    """Return a training of the DDPG parent per seed, by folder."""
    # Only the study's evaluation uses the full-length record.
    shared = (f"experiment={study.recipe}", f"variant={LEARNED}", *study.overrides)
    return {
        f"seed_{seed}": load("train", [*shared, "evaluation.full_length=false", f"seed={seed}"])
        for seed in range(study.seeds)
    }


def evaluation(study: Study, *own: str) -> StudyConfig:
    """Return the configuration of an evaluation of the hybrid."""
    shared = known_settings(list(study.overrides), "evaluate")
    leader = () if any(top_key(item) == "leader" for item in study.overrides) else (WLTC,)
    options = [f"experiment={study.recipe}", "variant=hcfs", *leader, *shared, *own]
    cfg: StudyConfig = load("evaluate", options)
    return cfg


def run(study: Study) -> None:
    """Train the DDPG parents and evaluate all strategies; finished runs are skipped.

    Raises:
        LccError: for any error in settings or files, in one line.
    """
    cfg, runs, parents = evaluation(study), trainings(study), study.folder / LEARNED
    train_all(runs, parents, study.jobs)
    prepare_torch(cfg)
    inputs = load_inputs(cfg)
    target = study.folder / "evaluation"
    _evaluate(baselines(cfg), cfg, inputs, target / BASELINES_FOLDER)
    done = [parents / name for name in runs]
    for folder in done:
        hybrid = evaluation(study, f"policy={quoted(folder)}")
        weights, trained = load_policy(folder)
        check_policy(hybrid, trained)
        hybrid = hybrid.with_(agent=trained.agent)
        learned = with_weights(hybrid, weights, trained.seed, str(folder), inputs.population)
        _evaluate(hybrid_strategies(hybrid, learned), hybrid, inputs, target / folder.name)
    keep(study.folder, done)


def keep(folder: Path, trainings: Sequence[Path]) -> None:
    """Write the tables of the page: a row per run, cases of the first training, and curves."""
    root = folder / "evaluation"
    seeds = [root / path.name for path in trainings]
    frames = [read_parquet(path / EPISODES) for path in (root / BASELINES_FOLDER, *seeds)]
    write_parquet(per_run(pd.concat(frames, ignore_index=True)), folder / EPISODES)
    frames = [read_parquet(path / STEPS) for path in (root / BASELINES_FOLDER, *seeds[:1])]
    write_parquet(rounded(pd.concat(frames, ignore_index=True)), folder / STEPS)
    frames = [
        read_parquet(path / TRAINING)[["episodes", "episode_reward"]].assign(
            variant=LEARNED, seed=int(path.name.removeprefix("seed_"))
        )
        for path in trainings
    ]
    write_parquet(rounded(pd.concat(frames, ignore_index=True)), folder / TRAINING)


def hybrid_strategies(cfg: StudyConfig, learned: Strategy) -> list[Strategy]:
    """Build the DDPG parent and the hybrids that the study compares.

    ``hcfs``: as configured, with the tuned rule; ``hcfs untuned``: with the paper-like rule;
    ``hcfs J=10``: jerk bound of 10 m/s³; ``hcfs literal``: as printed, without the clamp to that
    bound and without the safe cap; ``hcfs oracle``: with the leader's true next speed.

    Args:
        cfg: configuration of the evaluation of ``hcfs``.
        learned: the trained policy alone.
    """
    hybrid = cfg.deployed
    gains = load("evaluate", ["variant=cacc", f"gains={UNTUNED}"]).gains
    changes: dict[str, dict[str, Any]] = {
        "hcfs": {},
        "hcfs untuned": {"rule": hybrid.settings["rule"].changed(**gains)},
        "hcfs J=10": {"jerk_bound": 10.0},
        "hcfs literal": {"jerk_bound": 10.0, "clamp": False, "safe_cap": False},
        "hcfs oracle": {"lookahead": "oracle"},
    }
    alone = cfg.driven_by(cfg.scenario.controllers[AUTOMATED])
    return [
        replace(learned, name=LEARNED, cfg=alone),
        *(
            replace(learned, name=name, cfg=cfg.driven_by(hybrid.changed(**change)))
            for name, change in changes.items()
        ),
    ]


def _evaluate(
    strategies: Sequence[Strategy], cfg: StudyConfig, inputs: Inputs, folder: Path
) -> None:
    """Evaluate into a folder, unless this is done."""
    cfg = with_inputs(cfg)
    if made_by(folder / EPISODES) == identity(cfg):
        return
    log.info("evaluating %d strategies into %s", len(strategies), folder)
    comparison = Comparison(cfg, inputs, strategies)
    (folder / EPISODES).unlink(missing_ok=True)  # never with another configuration
    save_config(cfg, folder)
    evaluate_and_write(comparison, inputs, folder, quiet=True)
