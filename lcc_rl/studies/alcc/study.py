"""The ALCC study: calibration, trainings, evaluations, tables and figures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from lcc_rl import results
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
from lcc_rl.errors import ResultsError, require_known
from lcc_rl.evaluation.named import TUNED
from lcc_rl.figures import evaluation as run_figures
from lcc_rl.figures.calibration import calibration_figure, joint_figure
from lcc_rl.figures.training import learning_curve
from lcc_rl.io.files import read_parquet
from lcc_rl.results.names import in_words
from lcc_rl.results.runs import EPISODES, RECORD, STEPS
from lcc_rl.results.windows import LEADER_COLUMNS, WINDOWS, Means
from lcc_rl.studies.alcc import figures, paper_tables, tables
from lcc_rl.studies.alcc.paper_tables import PAIR
from lcc_rl.studies.study import Study, StudyResults

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
PAPER_WINDOWS = "paper_windows"  # recipe with the paper's windows only
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
    return PAPER_WINDOWS if agent else "paper_alcc"


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
        if study.recipe in (PAPER_WINDOWS, SMOKE):
            left_out |= set(OF_DDPG)
        chosen = ablations or tuple(name for name in ABLATIONS if name not in left_out)
        named = map(chosen_ablation, chosen)
        series |= {study.folder / "ablations" / name: change for name, change in named}
    return series


# -- tables and figures from the parquet files -----------------------------------------------------

ALCC_TITLE = "Adaptive Leading Cruise Control: the study"
ITSELF = "this study"
SHARE_COLUMNS = [
    f"{which}_{name}"
    for name in ("unsafe_ttc_pct", tables.LONG)
    for which in ("mean", "worst_seed")
]


def study_results(folder: Path, formats: Iterable[str] = ()) -> StudyResults:
    """Write tables/*.parquet, figures/*.png and results.md from a study's parquet files.

    Parts without runs are left out.

    Args:
        folder: a study's folder of ``lcc-rl reproduce alcc``, or the stored part of it.
        formats: further formats of the figures.

    Raises:
        ResultsError: if there is no evaluation in the folder, or a file cannot be read.
    """
    study = StudyResults(folder, formats)
    if not any(map(_finished, folder.glob(f"**/{EVALUATION_FOLDER}"))):
        raise ResultsError(
            f"{folder}: no {EVALUATION_FOLDER}/{EPISODES}; run lcc-rl reproduce alcc"
        )
    main = Means.read(folder / EVALUATION_FOLDER) if _finished(folder / EVALUATION_FOLDER) else None
    if main is not None:
        add_main(study, main)
    _learning(study)
    _ablations(study, main)
    _people(study)
    study.write(ALCC_TITLE)
    return study


def narrow(shown: dict[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """Return tables that fit a page of the documentation, by name."""
    energies, human, shares = (
        table[~table.iloc[:, 0].isin(TUNED)]
        for table in (shown["energies"], shown["human_energy"], shown["constraints"])
    )
    human = human[human["energy"] == paper_tables.ENERGY_WORDS[""]]
    columns = ["strategy", "total_path_energy_kj", "total_path_energy_kj_low"]
    columns += ["total_path_energy_kj_high", "total_energy_kj", *tables.ENERGY_PARTS]
    return {
        "parts": energies.loc[energies["strategy"] != "direct", columns],
        "behind": human.drop(columns=["energy", "least_driver_pct", "most_driver_pct"]),
        "shares": shares[["strategy", "collisions", *SHARE_COLUMNS]],
    }


def add_main(found: StudyResults, means: Means) -> None:
    """Add the tables and figures of the main evaluation."""
    windows, size = means.windows, means.size
    found.table("headline", f"Savings of the total energy, {size}", tables.headline_rows(windows))
    found.table("energies", f"Energy per episode, {size}", tables.energies(windows))
    if set(LEADER_COLUMNS) <= set(windows):
        caption = "Path energy saved in thirds of the windows, by the leader's energy and speed"
        found.table("strata", caption, tables.strata(windows))
    caption = "Path energy of controlled car and human driver by strategy (Fig. 11)"
    found.figure("distributions", caption, figures.distributions(means.drivers))
    path = found.folder / EVALUATION_FOLDER / STEPS
    if path.exists() and ((steps := read_parquet(path))["strategy"] == "alcc").any():
        caption = "One held-out episode of the network, first seed (Fig. 7)"
        found.figure("sample_episode", caption, run_figures.sample_episode(steps, "alcc"))
    found.table("constraints", f"Safety and efficiency, {size}", tables.constraints(windows))
    found.table("constraints_by_seed", "Every seed", tables.constraints_by_seed(windows))
    if set(windows["strategy"]) >= {*PAIR}:
        _awareness(found, means)
        _generalization(found, windows)
    table = paper_tables.human_energy(means)
    found.table("human_energy", f"Human driver's energy with and without the car, {size}", table)
    for name in sorted({*PAIR} & set(windows["strategy"])):
        caption = f"Human driver's path energy behind {in_words(name)} (Fig. 9)"
        found.figure(f"human_energy_{name}", caption, run_figures.human_energy_figure(means, name))


def _awareness(study: StudyResults, means: Means) -> None:
    caption = f"Table IV and this study, {means.size}"
    study.table("table_iv", caption, paper_tables.table_iv(means.drivers))
    study.table("holistic", "Saving per driver", paper_tables.holistic(means))
    caption = "Path energy of both vehicles and its saving, by driver behind (Fig. 10)"
    figure = run_figures.paired_improvement(means, *PAIR)
    study.figure("improvement", caption, figure)


def _generalization(study: StudyResults, windows: pd.DataFrame) -> None:
    caption = "Saving of alcc against reference over profiles and on the 4 of the paper"
    study.table("generalization_row", caption, paper_tables.generalization_row(windows))
    study.table("generalization", "Every held-out window", paper_tables.generalization(windows))
    caption = "Energies and saving on every held-out window (Fig. 12)"
    study.figure("generalization", caption, figures.generalization_figure(windows))


def _learning(study: StudyResults) -> None:
    if (study.folder / RECORD).exists():  # of the main trainings, if their folders are missing
        training = read_parquet(study.folder / RECORD)
    elif any((study.folder / "train").rglob(RECORD)):
        training = results.load(study.folder / "train", "training", strict=True)
    else:
        return
    study.table("learning", "Learning curves, every seed", tables.learning(training))
    study.figure("learning_curve", "Reward over training (Fig. 6)", learning_curve(training))
    study.figure("reward_terms", "Every reward term", figures.reward_terms(training))


def _ablations(study: StudyResults, main: Means | None) -> None:
    means = {
        path.parent.name: Means.read(path)
        for path in study.folder.glob(f"ablations/*/{EVALUATION_FOLDER}")
        if _finished(path)
    }
    if not means:
        return
    order = [*(name for name in ABLATIONS if name in means), *sorted(means.keys() - ABLATIONS)]
    series = {ITSELF: main} if main is not None else {}
    series |= {name: means[name] for name in order}
    windows = pd.concat(
        [one.windows.assign(ablation=name) for name, one in series.items()], ignore_index=True
    )
    study.table("series", "Energy as drawn of both vehicles", tables.series(windows))
    study.table("ablations", "Path energy, safety and efficiency", tables.comparison(windows))
    caption = "Energy, safety and efficiency under each change"
    study.figure("ablations", caption, figures.comparison_figure(windows))


def _people(study: StudyResults) -> None:
    study.figure("power_map", "The motor's power map (A2; Fig. 2)", figures.power_map())
    if (study.folder / DRIVERS_FILE).exists():
        drivers = read_parquet(study.folder / DRIVERS_FILE)
        study.figure("calibration", "Calibration (Fig. 4)", calibration_figure(drivers))
        caption = "Joint distribution of desired speed and time gap (Fig. 5)"
        study.figure("joint_distribution", caption, joint_figure(drivers))


def _finished(evaluation: Path) -> bool:
    return any((evaluation / name).exists() for name in (WINDOWS, EPISODES))
