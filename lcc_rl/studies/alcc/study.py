"""The ALCC study: calibration, trainings and evaluations from trajectories to parquet files."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lcc_rl.commands import evaluation
from lcc_rl.commands.pipeline import TRAJECTORIES, calibrate_once, root_key
from lcc_rl.config import load
from lcc_rl.config.schemas import PipelineConfig, StudyConfig
from lcc_rl.data.episodes import read_episodes
from lcc_rl.data.profiles import leader_profiles
from lcc_rl.errors import ConfigError, unknown_name
from lcc_rl.studies.alcc.settings import (
    ABLATIONS,
    CONTROL,
    DRIVERS,
    FILTERS,
    MAIN,
    OF_DDPG,
    SMOKE,
    Change,
    Study,
    chosen_ablation,
    followers_change,
    followers_study,
)
from lcc_rl.studies.runner import FINISHED, Outcome, note, note_problems, run_all, up_to_date

log = logging.getLogger("lcc_rl")


def run(study: Study, parts: Sequence[str] | None = None, command: str = "") -> list[Outcome]:
    """Calibrate, train and evaluate; finished runs are skipped.

    Args:
        study: the settings.
        parts: names of :data:`PARTS`; all by default. ``filter`` trains what ``main`` trains.
        command: the command line, stored in the folder's notes.

    Returns:
        The outcome of every training.

    Raises:
        LccError: one clear error for wrong settings, data or files.
    """
    parts = list(PARTS) if parts is None else parts
    wanted = check(study, parts)
    if command:
        note(study.folder, "alcc", command)
    calibrate(study)
    outcomes: dict[Path, Outcome] = {}  # main and filter share their trainings
    for name, part in PARTS.items():
        if name in parts:
            outcomes |= {outcome.run.folder: outcome for outcome in part(study, wanted)}
    note_problems(study.folder, list(outcomes.values()))
    return list(outcomes.values())


def check(study: Study, parts: Sequence[str]) -> StudyConfig:
    """Check settings before any work, and return the configuration of a main training."""
    for part in parts:
        if part not in PARTS:
            raise unknown_name("part", part, PARTS)
    _calibration(study)
    wanted = study.runs(study.folder / "train")[0].compose()
    if "filter" in parts and any(root_key(item) == "filter" for item in study.overrides):
        raise ConfigError(
            "the part filter puts +filter=cbf on trained policies: give the override "
            "or that part (--parts), not both"
        )
    if "followers" in parts:
        change = followers_change(study.overrides, 1)
        followers_study(study).runs(study.folder, change)[0].compose()
    if "ablations" in parts:
        for _, change in map(chosen_ablation, study.ablations or ()):
            study.runs(study.folder, change)[0].compose()
    return wanted


def calibrate(study: Study) -> None:
    """Read the trajectories and calibrate drivers in both modes, unless that is done."""
    if (study.folder / DRIVERS).exists() and (study.folder / TRAJECTORIES).exists():
        return
    calibrate_once(_calibration(study), study.folder)


def _calibration(study: Study) -> PipelineConfig:
    skipped = ("drivers", "split", "scenario", "reward", "agent", "training", "evaluation")
    own = [item for item in study.overrides if root_key(item) not in skipped]
    cfg: PipelineConfig = load("pipeline", ["calibration=both", *own])
    return cfg


def _main(study: Study, wanted: StudyConfig) -> list[Outcome]:
    outcomes, usable = _trained(study)
    evaluate_all(study.settings("evaluate", "alcc"), usable, study.folder / "evaluation")
    return outcomes


def _trained(study: Study) -> tuple[list[Outcome], list[Outcome]]:
    """Train the main part; return its outcomes, and those with seeds of earlier commands."""
    folder = study.folder / "train"
    outcomes = run_all(study.runs(folder, MAIN), study.jobs, study.accept)
    return outcomes, outcomes + study.earlier(folder, MAIN)


def _filter(study: Study, wanted: StudyConfig) -> list[Outcome]:
    """Put the filter on the policies of the main part, with several settings."""
    outcomes, usable = _trained(study)
    # The variant cbf, the filter without a policy, is evaluated too; it learns nothing.
    kept = [item for item in study.overrides if root_key(item) not in ("agent", "training")]
    alone = replace(study, overrides=tuple(kept))
    for speed in FILTERS:
        own = f"scenario.filters.automated.full_speed={speed}"
        folder = study.folder / "filter" / f"full_speed_{speed}" / "evaluation"
        evaluate_all(alone.settings("evaluate", "cbf", own), usable, folder, own=True)
    return outcomes


def _ablations(study: Study, wanted: StudyConfig) -> list[Outcome]:
    # Ablations that change nothing are left out, and of short runs those that train long.
    left_out = {f"gamma_{wanted.agent['gamma']:g}", f"recipe_{study.recipe}"}
    if study.recipe in (None, SMOKE):
        left_out |= set(OF_DDPG)
    chosen = study.ablations or tuple(name for name in ABLATIONS if name not in left_out)
    folder = study.folder / "ablations"
    return _each(study, {folder / n: c for n, c in map(chosen_ablation, chosen)})


def _single(study: Study, wanted: StudyConfig) -> list[Outcome]:
    chosen = spread_profiles(study.folder / TRAJECTORIES, wanted, study.profiles)
    folder, recipes = study.folder / "single", ("single_profile",)
    return _each(
        study,
        {folder / str(n): Change((f"split.profile={n}",), recipes=recipes) for n in chosen},
    )


def _followers(study: Study, wanted: StudyConfig) -> list[Outcome]:
    changes = {
        study.folder / "followers" / str(number): followers_change(study.overrides, number)
        for number in sorted(set(study.followers))
    }
    first, *others = changes
    # The training of the reference does not depend on the number of followers.
    for folder in others:
        changes[folder] = replace(changes[folder], variants=("alcc", CONTROL))
    return _each(followers_study(study), changes, shared=first / "reference")


def _each(
    study: Study, changes: Mapping[Path, Change], shared: Path | None = None
) -> list[Outcome]:
    """Train and evaluate every change in its folder.

    Every evaluation includes the variant in the folder ``shared``.
    """
    runs = [run for folder, change in changes.items() for run in study.runs(folder, change)]
    outcomes = run_all(runs, study.jobs, study.accept)
    found = outcomes + [x for item in changes.items() for x in study.earlier(*item)]
    for folder, change in changes.items():
        of_it = [x for x in found if {folder, shared} & set(x.run.folder.parents)]
        own = (*change.overrides, *change.evaluation)
        settings = study.settings("evaluate", "alcc", *own, recipes=change.recipes)
        evaluate_all(settings, of_it, folder / "evaluation")
    return outcomes


def spread_profiles(table: Path, cfg: StudyConfig, count: int) -> list[int]:
    """Choose profiles for the single-profile protocol, spread evenly over all of them."""
    scenario = cfg.scenario
    profiles = leader_profiles(read_episodes(table), scenario.time_step).at_least(scenario.horizon)
    # Midpoints of equal parts: one profile is the middle one, more never cluster at the ends.
    places = (np.arange(min(count, len(profiles))) + 0.5) / min(count, len(profiles))
    return [int(place * len(profiles)) for place in places]


def evaluate_all(
    settings: Sequence[str], outcomes: Sequence[Outcome], folder: Path, own: bool = False
) -> None:
    """Evaluate every finished policy beside the human baselines, unless that is done.

    Args:
        settings: overrides of the entry point ``evaluate``.
        outcomes: trainings in ``<variant>/seed_<n>``; those that did not finish are left out.
        folder: folder of the evaluation.
        own: evaluate the variant of the settings, too.
    """
    runs = sorted(
        (outcome.run.folder for outcome in outcomes if outcome.status == FINISHED),
        key=lambda path: (path.parent.name, int(path.name.removeprefix("seed_"))),
    )
    if not runs:
        log.warning("%s: nothing trained to evaluate", folder)
        return
    cfg = load("evaluate", settings)
    cfg.compare = [str(path) for path in runs]
    if not up_to_date(cfg, folder, runs):
        log.info("evaluating %d policies into %s", len(runs), folder)
        evaluation.run(cfg, folder, own=own, quiet=True, replace=True)


PARTS = {
    "main": _main,
    "filter": _filter,
    "ablations": _ablations,
    "single": _single,
    "followers": _followers,
}
