"""The ALCC study: calibration, trainings and evaluations."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lcc_rl.commands.evaluation import complete
from lcc_rl.commands.pipeline import (
    TRAJECTORIES,
    calibrate_once,
    known_settings,
    read_once,
    train_all,
)
from lcc_rl.config.compose import load, with_inputs
from lcc_rl.config.schemas import EvaluateConfig, PipelineConfig, TrainConfig
from lcc_rl.config.words import key_of, quoted, top_key
from lcc_rl.errors import require_known
from lcc_rl.studies.study import Study

TRAIN, EVALUATION_FOLDER = "train", "evaluation"
DRIVERS_FILE = Path("calibration/drivers.parquet")
STUDY_PARTS = ("main", "ablations")
OF_CALIBRATION = ("data", "calibration")  # overrides of the calibration only
# Overrides that are not passed to the calibration.
OF_TRAINING = ("drivers", "split", "scenario", "reward", "agent", "training", "evaluation")
STUDY_VARIANTS = ("alcc", "reference")
CONTROL = "own_energy"  # weight of its own energy as that of all vehicles in alcc
GAMMAS = (0.9, 0.95, 0.99, 0.995)
RECIPES = ("quickstart", "paper_alcc")  # length and batches of DDPG's training
SMOKE = "smoke"
WINDOWS = "paper_windows"  # recipe with the paper's windows only
OF_DDPG = ("short_training", *(f"recipe_{name}" for name in RECIPES))


@dataclass(frozen=True)
class Change:
    """The overrides, variants and recipes of one series of trainings."""

    overrides: tuple[str, ...] = ()
    variants: tuple[str, ...] = STUDY_VARIANTS
    recipes: tuple[str, ...] = ()


# One profile for training; evaluation on the profiles that the study's split holds out.
SINGLE_SPLIT = "split=single"
ONE_PROFILE = (
    SINGLE_SPLIT,
    "split.held_out={_target_: lcc_rl.data.profiles.Split, by: recording, evaluation_share: 0.34}",
)
MAIN = Change(variants=(*STUDY_VARIANTS, CONTROL))
ABLATIONS = {
    "no_safety": Change(("reward.terms.safety.weight=0",)),
    "no_efficiency": Change(("reward.terms.efficiency.weight=0",)),
    "no_cav_energy": Change(("reward.terms.cav_energy.weight=0",)),
    "no_hdv_energy": Change(("reward.terms.hdv_energy.weight=0",), ("alcc",)),
    "true_acceleration": Change(("reward.terms.hdv_energy.power=vehicles.power",), ("alcc",)),
    "population_mean": Change(("scenario.pieces.estimator.learning_time=null",), ("alcc",)),
    "no_recuperation": Change(("scenario.pieces.power.recuperation=false",)),
    "one_training_profile": Change((*ONE_PROFILE, "scenario.pieces.leader.start=first")),
    "constant_rate": Change(("agent.final_lr_fraction=1.0",)),
    "short_training": Change(("training.episodes=320",)),
    **{f"recipe_{name}": Change(recipes=(name,)) for name in RECIPES},
    **{f"gamma_{gamma:g}": Change((f"agent.gamma={gamma:g}",)) for gamma in GAMMAS},
}


def chosen_ablation(item: str) -> tuple[str, Change]:
    """Return name and change of an item of ``--ablations``: a name or ``name:override``."""
    name, _, override = item.partition(":")
    if override:
        return name, Change((override,))
    require_known("ablation", name, ABLATIONS)
    return name, ABLATIONS[name]


def default_recipe(overrides: Iterable[str]) -> str | None:
    """Return the recipe of the study: the paper's windows, and its learner without another."""
    agent = any(key_of(item) == "agent" for item in overrides)
    return WINDOWS if agent else "paper_alcc"


def settings_of_run(study: Study, entry: str, variant: str, change: Change, *own: str) -> Any:
    """Compose a run of recipe, inputs of the study, user's overrides, change and own overrides."""
    keys = {top_key(item) for item in study.overrides}
    shared = [
        item
        for item in study.overrides
        if top_key(item) not in OF_CALIBRATION or key_of(item).startswith("data.plausible")
    ]
    users, changed = known_settings(shared, entry), change.overrides
    if SINGLE_SPLIT in changed:  # the user's split then applies to ``held_out``
        moved = [x for x in users if key_of(x).startswith("split.")]
        users = [x for x in users if x not in moved]
        changed = (*changed, *(x.replace("split.", "split.held_out.", 1) for x in moved))
    drivers = ("drivers=calibrated", f"drivers.path={quoted(study.folder / DRIVERS_FILE)}")
    # A recipe of RECIPES replaces the study's; Hydra does not merge one file twice as a whole.
    own_recipe = [] if {*RECIPES} & {*change.recipes} else [study.recipe]
    recipes = [*filter(None, own_recipe), *change.recipes]
    options = [
        f"experiment=[{','.join(recipes)}]",
        f"variant={variant}",
        "data=episodes",
        f"data.path={quoted(study.folder / TRAJECTORIES)}",
        *(() if "drivers" in keys else drivers),
        *users,
        *changed,
        *own,
    ]
    return load(entry, options)


def alcc_trainings(study: Study, change: Change) -> dict[str, TrainConfig]:
    """Return a training per seed and variant by folder, all variants of a seed first."""
    return {
        f"{variant}/seed_{seed}": settings_of_run(study, "train", variant, change, f"seed={seed}")
        for seed in range(study.seeds)
        for variant in change.variants
    }


def run(study: Study, parts: Sequence[str] = STUDY_PARTS, ablations: Sequence[str] = ()) -> None:
    """Calibrate, train and evaluate; finished runs are skipped.

    Args:
        study: the settings.
        parts: parts of :data:`STUDY_PARTS`.
        ablations: names of :data:`ABLATIONS` or further ones as ``name:override``, e.g.
            ``early:reward.terms.safety.threshold=6``; empty: all.

    Raises:
        LccError: for any error in settings, data or files, in one line.
    """
    series = {
        folder: (change, alcc_trainings(study, change))
        for folder, change in _series(study, parts, ablations).items()
    }
    shared = [item for item in study.overrides if top_key(item) not in OF_TRAINING]
    calibration: PipelineConfig = load("pipeline", ["~experiment", "calibration=both", *shared])
    (_, runs), *_ = series.values()
    first, *_ = runs.values()
    calibration = calibration.with_(split=first.split, scenario=first.scenario)
    read_once(calibration, study.folder)
    calibrate_once(calibration, study.folder)
    for folder, (change, runs) in series.items():
        train_all(runs, folder, study.jobs)
        cfg: EvaluateConfig = settings_of_run(study, "evaluate", "alcc", change)
        target = study.folder if change is MAIN else folder
        complete(with_inputs(cfg.with_(compare=[str(folder)])), target / EVALUATION_FOLDER)


def _series(study: Study, parts: Sequence[str], ablations: Sequence[str]) -> dict[Path, Change]:
    """Return the series of trainings of the parts by their folders."""
    require_known("part", parts, STUDY_PARTS)
    series = {study.folder / TRAIN: MAIN} if "main" in parts else {}
    if "ablations" in parts:
        # Without ablations that change nothing, and in short runs without long trainings.
        gamma = settings_of_run(study, "train", "alcc", MAIN).agent.made().gamma
        left_out = {f"gamma_{gamma:g}", f"recipe_{study.recipe}"}
        if study.recipe in (WINDOWS, SMOKE):
            left_out |= set(OF_DDPG)
        chosen = ablations or tuple(name for name in ABLATIONS if name not in left_out)
        named = map(chosen_ablation, chosen)
        series |= {study.folder / "ablations" / name: change for name, change in named}
    return series
