"""The HCFS study: trainings, evaluations, tables and figures."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
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
from lcc_rl.evaluation.cases import WINDOW_CASES
from lcc_rl.evaluation.comparison import Comparison
from lcc_rl.evaluation.fit import check_policy
from lcc_rl.evaluation.strategies import Strategy, baselines, with_weights
from lcc_rl.figures import platoon
from lcc_rl.figures.training import learning_curve
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.results.platoons import case_table
from lcc_rl.results.policies import load_policy
from lcc_rl.results.runs import EPISODES, RECORD, STEPS, save_config
from lcc_rl.runs.precision import prepare_torch
from lcc_rl.studies.hcfs import tables
from lcc_rl.studies.hcfs.tables import LEARNED, per_run, rounded
from lcc_rl.studies.study import Study, StudyResults

log = logging.getLogger("lcc_rl")

RECIPE = "paper_hcfs"
BASELINES_FOLDER = "baselines"  # folder of the evaluation of untrained strategies
UNTUNED = "paper_like"
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
        read_parquet(path / RECORD)[["episodes", "episode_reward"]].assign(
            variant=LEARNED, seed=int(path.name.removeprefix("seed_"))
        )
        for path in trainings
    ]
    write_parquet(rounded(pd.concat(frames, ignore_index=True)), folder / RECORD)


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


# -- tables and figures from the parquet files -----------------------------------------------------

LENGTHS = "lengths.parquet"  # rows of windows of studies with several lengths of training
SOURCES_FILE = "sources.parquet"  # rows of windows of other sources of leaders
HCFS_TITLE = "Hybrid Car-Following Strategy: the study"
# The paper's table and figures of each case: speeds, jerk, and the controller in use.
CASES = {
    "case 1": ("Table IV", 4, 5, 6),
    "case 2": ("Table V", 7, 8, 9),
    "case 3": ("Table VI", 10, 11, 12),
}
CACC_ROWS = ("cacc path", "cacc paper_like", "cacc tuned")
HYBRID_ROWS = ("hcfs", "hcfs oracle", "hcfs untuned")
PARENT_ROWS = ("cacc tuned", LEARNED)
STRATEGIES = (*CACC_ROWS, LEARNED, *HYBRID_ROWS, "deadbeat")
IN_CASES = ("cacc paper_like", "cacc tuned", LEARNED, "hcfs", "hcfs untuned", "deadbeat")
WHOLE_ROWS = ("cacc tuned", LEARNED, "hcfs", "hcfs literal", "deadbeat")


def study_results(folder: Path, formats: Iterable[str] = ()) -> StudyResults:
    """Write tables/*.parquet, figures/*.png and results.md from a study's parquet files.

    Args:
        folder: folder of ``lcc-rl reproduce hcfs`` with episodes.parquet, steps.parquet and
            training.parquet.
        formats: further formats of the figures.

    Raises:
        ResultsError: if a table is missing or cannot be read.
    """
    study = StudyResults(folder, formats)
    episodes, steps = (read_parquet(folder / name) for name in (EPISODES, STEPS))
    _windows(study, episodes)
    for case in CASES:
        _case(study, episodes, steps, case)
    study.table("table_iv", "Table IV as printed, on another record", tables.printed())
    study.table("weights", "Σ reward from Σ|e_v| and Σ|jerk| of Table IV", tables.weight_table())
    totals = tables.whole_records(episodes, WHOLE_ROWS)
    study.table("whole", "Σ reward over whole records (range of the trainings)", totals)
    gains = tables.whole_gains(episodes, PARENT_ROWS)
    study.table("whole_gains", "HCFS against its parents over whole records", gains)
    if (folder / SOURCES_FILE).exists():  # only with evaluations on other leaders
        runs = read_parquet(folder / SOURCES_FILE)
        shown = tables.sources(runs, ("cacc tuned", "hcfs", "hcfs first"))
        study.table("sources", "Windows of other sources of leaders", shown)
        study.table("sources_in_full", "The same for all strategies", tables.sources(runs))
    if (folder / LENGTHS).exists():  # only with several studies
        lengths = tables.lengths(read_parquet(folder / LENGTHS))
        study.table("lengths", "Σ reward per window by the length of the training", lengths)
    curve = learning_curve(read_parquet(folder / RECORD))
    study.figure("learning_curve", "Learning curve of the DDPG parent", curve)
    study.write(HCFS_TITLE)
    return study


def _windows(study: StudyResults, episodes: pd.DataFrame) -> None:
    rivals = [name for name in STRATEGIES if name != "hcfs"]
    gained = tables.win_rates(episodes, "hcfs", [*rivals, "deadbeat oracle"])
    untuned = tables.win_rates(episodes, "hcfs untuned", ["cacc paper_like", LEARNED, "hcfs"])
    cases = tables.over_cases(episodes, tuple(CASES), IN_CASES)
    study.table("windows", "Σ reward per window", tables.windows(episodes, STRATEGIES))
    study.table("win_rates", "HCFS (rule: CACC tuned) against every other", gained)
    study.table("win_rates_untuned", "HCFS with the CACC of Table IV", untuned)
    study.table("windows_in_full", "Held-out windows: means", case_table(episodes, WINDOW_CASES))
    study.table("cases", "Σ reward in the cases of the paper", cases)


def _case(study: StudyResults, episodes: pd.DataFrame, steps: pd.DataFrame, case: str) -> None:
    stem, (table, speeds, jerk, use) = case.replace(" ", "_"), CASES[case]
    study.table(stem, f"{case} ({table} of the paper)", case_table(episodes, case))
    pictures = {
        ("velocities", f"speeds (Fig. {speeds})"): platoon.velocities(steps, case),
        ("jerk", f"jerk and its bound (Fig. {jerk})"): platoon.jerks(steps, case, 30.0),
        ("switching_hcfs", f"controller in use, hcfs (Fig. {use})"): platoon.switching(steps, case),
        ("switching_hcfs_oracle", "controller in use, hcfs oracle"): platoon.switching(
            steps, case, "hcfs oracle"
        ),
    }
    for (name, caption), figure in pictures.items():
        study.figure(f"{stem}_{name}", f"{case}: {caption}", figure)
