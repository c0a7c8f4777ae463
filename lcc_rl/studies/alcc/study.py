"""The ALCC study: calibration, trainings and evaluations from trajectories to parquet files."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lcc_rl.commands import evaluation
from lcc_rl.commands.pipeline import TRAJECTORIES, calibrate_once, known_settings, read_once
from lcc_rl.config import key_of, load, root_key
from lcc_rl.config.schemas import PipelineConfig, StudyConfig
from lcc_rl.errors import unknown_name
from lcc_rl.studies.runner import (
    EPISODES,
    FINISHED,
    BaseStudy,
    Outcome,
    Run,
    check_accepted,
    differences,
    note,
    note_problems,
    quoted,
    run_all,
    up_to_date,
)

log = logging.getLogger("lcc_rl")

DRIVERS = Path("calibration/drivers.parquet")
ROWS = f"*/seed_*/{EPISODES}"
PARTS = ("main", "ablations")
OF_CALIBRATION = ("data", "calibration")  # overrides that only the calibration takes
# Overrides that the calibration does not take.
OF_TRAINING = ("drivers", "split", "scenario", "reward", "agent", "training", "evaluation")
VARIANTS = ("alcc", "reference")
CONTROL = "own_energy"  # weighs its own energy as much as alcc weighs that of all
GAMMAS = (0.9, 0.95, 0.99, 0.995)
RECIPES = ("quickstart", "paper_alcc")  # length and batches of DDPG's training
SMOKE = "smoke"
OF_DDPG = ("short_training", *(f"recipe_{name}" for name in RECIPES))


@dataclass(frozen=True)
class Change:
    """The overrides, variants and recipes of one series of trainings."""

    overrides: tuple[str, ...] = ()
    variants: tuple[str, ...] = VARIANTS
    recipes: tuple[str, ...] = ()


# One profile for training; evaluation is on what the study's own split holds out.
SINGLE = "split=single"
ONE_PROFILE = (
    SINGLE,
    "split.held_out={_target_: lcc_rl.data.profiles.Split, by: recording, evaluation_share: 0.34}",
)
MAIN = Change(variants=(*VARIANTS, CONTROL))
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
    """Return the name and the change of an item of ``--ablations``: a name or ``name:override``."""
    name, _, override = item.partition(":")
    if override:
        return name, Change((override,))
    if name not in ABLATIONS:
        raise unknown_name("ablation", name, ABLATIONS)
    return name, ABLATIONS[name]


def chooses_agent(overrides: Iterable[str]) -> bool:
    """Whether overrides choose an agent other than the recipe's."""
    return any(key_of(item) == "agent" for item in overrides)


@dataclass(frozen=True)
class Study(BaseStudy):
    """The settings of the ALCC study.

    Attributes:
        ablations: names of :data:`ABLATIONS` or further ones as ``name:override``, e.g.
            ``early:reward.terms.safety.threshold=6``; None for all.
    """

    recipe: str | None = "paper_alcc"
    ablations: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for item in self.ablations or ():
            chosen_ablation(item)

    def settings(
        self, entry: str, variant: str, *own: str, recipes: Sequence[str] = ()
    ) -> list[str]:
        """Return the overrides of a run: recipe, the study's inputs, the user's, its own."""
        given = {root_key(item) for item in self.overrides}
        data = f"data.path={quoted(self.folder / TRAJECTORIES)}"
        drivers = f"drivers.path={quoted(self.folder / DRIVERS)}"
        shared = [
            item
            for item in self.overrides
            if root_key(item) not in OF_CALIBRATION or key_of(item).startswith("data.plausible")
        ]
        settings = known_settings(shared, entry)
        if SINGLE in own:  # the user's split is then that of ``held_out``
            moved = [x for x in settings if key_of(x).startswith("split.")]
            settings = [x for x in settings if x not in moved]
            own = (*own, *(x.replace("split.", "split.held_out.", 1) for x in moved))
        return [
            f"experiment=[{','.join([*filter(None, [self.recipe]), *recipes])}]",
            f"variant={variant}",
            "data=episodes",
            data,
            *(() if "drivers" in given else ("drivers=calibrated", drivers)),
            *settings,
            *own,
        ]

    def runs(self, folder: Path, change: Change, seeds: Iterable[int] | None = None) -> list[Run]:
        """Return a training per seed and variant, all variants of a seed first."""
        numbers = range(self.seeds) if seeds is None else seeds
        own, recipes = change.overrides, change.recipes
        return [
            Run(
                folder / variant / f"seed_{seed}",
                tuple(self.settings("train", variant, f"seed={seed}", *own, recipes=recipes)),
            )
            for seed in numbers
            for variant in change.variants
        ]

    def earlier(self, folder: Path, change: Change) -> list[Outcome]:
        """Return finished trainings of further seeds with the same settings."""
        found = {int(path.parent.name.removeprefix("seed_")) for path in folder.glob(ROWS)}
        runs = self.runs(folder, change, sorted(found - set(range(self.seeds))))
        return [
            Outcome(run, FINISHED)
            for run in runs
            if run.finished and not differences(run, run.compose(), self.accept)
        ]


def run(study: Study, parts: Sequence[str] = PARTS, command: str = "") -> list[Outcome]:
    """Calibrate, train and evaluate; finished runs are skipped.

    Args:
        study: the settings.
        parts: some of :data:`PARTS`.
        command: the command line, stored in the folder's notes.

    Returns:
        The outcome of every training.

    Raises:
        LccError: one clear error for wrong settings, data or files.
    """
    series = _series(study, parts)
    composed = [study.runs(folder, change)[0].compose() for folder, change in series.items()]
    for cfg in composed:  # before any work
        check_accepted(study.accept, cfg)
    calibration = _calibration(study, composed[0])
    read_once(calibration, study.folder)
    if command:
        note(study.folder, "alcc", command)
    calibrate_once(calibration, study.folder)
    outcomes = []
    for folder, change in series.items():
        trained = run_all(study.runs(folder, change), study.jobs, study.accept)
        settings = study.settings("evaluate", "alcc", *change.overrides, recipes=change.recipes)
        evaluated = study.folder if change is MAIN else folder
        found = trained + study.earlier(folder, change)
        _evaluate(settings, found, evaluated / "evaluation")
        outcomes += trained
    note_problems(study.folder, outcomes)
    return outcomes


def _series(study: Study, parts: Sequence[str]) -> dict[Path, Change]:
    """Return the series of trainings of the parts by their folders."""
    for part in parts:
        if part not in PARTS:
            raise unknown_name("part", part, PARTS)
    found = {study.folder / "train": MAIN} if "main" in parts else {}
    if "ablations" in parts:
        # Ablations that change nothing are left out, and of short runs those that train long.
        gamma = study.runs(study.folder, MAIN)[0].compose().agent["gamma"]
        left_out = {f"gamma_{gamma:g}", f"recipe_{study.recipe}"}
        if study.recipe in (None, SMOKE):
            left_out |= set(OF_DDPG)
        chosen = study.ablations or tuple(name for name in ABLATIONS if name not in left_out)
        ablations = map(chosen_ablation, chosen)
        found |= {study.folder / "ablations" / name: change for name, change in ablations}
    return found


def _calibration(study: Study, training: StudyConfig) -> PipelineConfig:
    """Return the settings of the calibration, whose data are divided as those of a training."""
    own = [item for item in study.overrides if root_key(item) not in OF_TRAINING]
    cfg: PipelineConfig = load("pipeline", ["~experiment", "calibration=both", *own])
    cfg.split, cfg.scenario = training.split, training.scenario
    return cfg


def _evaluate(settings: Sequence[str], outcomes: Sequence[Outcome], folder: Path) -> None:
    """Evaluate every finished policy beside the human baselines, unless that is done.

    Args:
        settings: overrides of the entry point ``evaluate``.
        outcomes: trainings in ``<variant>/seed_<n>``; those that did not finish are left out.
        folder: folder of the evaluation.
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
        evaluation.run(cfg, folder, own=False, quiet=True, replace=True)
