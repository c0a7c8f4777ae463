"""Study room: the ALCC study, from trajectories to every run and evaluation that it needs."""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from omegaconf import DictConfig

from lcc_rl import evaluate
from lcc_rl.config import load, require
from lcc_rl.data.episodes import read_episodes
from lcc_rl.data.profiles import leader_profiles
from lcc_rl.errors import unknown_name
from lcc_rl.pipeline import TRAJECTORIES, calibrate_once, known_settings, root_key
from lcc_rl.results.runs import identity, load_config
from lcc_rl.studies.runner import FINISHED, FOREIGN, Outcome, Run, note_problems, quoted, run_all

log = logging.getLogger("lcc_rl")

VARIANTS = ("alcc", "reference")
PARTS = ("main", "ablations", "single")
DRIVERS = Path("calibration/drivers.parquet")
GAMMAS = (0.9, 0.95, 0.99, 0.995)
# What the calibration takes in place of the trainings.
OF_CALIBRATION = ("data", "calibration")


@dataclass(frozen=True)
class Ablation:
    """A change of the main recipe: its overrides, and the variants that it concerns."""

    overrides: tuple[str, ...]
    variants: tuple[str, ...] = VARIANTS


ABLATIONS = {
    "no_safety": Ablation(("reward.terms.safety.weight=0",)),
    "no_efficiency": Ablation(("reward.terms.efficiency.weight=0",)),
    "no_cav_energy": Ablation(("reward.terms.cav_energy.weight=0",)),
    "no_hdv_energy": Ablation(("reward.terms.hdv_energy.weight=0",), ("alcc",)),
    "true_acceleration": Ablation(("reward.terms.hdv_energy.power=power",), ("alcc",)),
    "population_mean": Ablation(("scenario.pieces.estimator.learning_time=.inf",), ("alcc",)),
    "no_recuperation": Ablation(("scenario.pieces.cav_power.recuperation=false",)),
    "one_training_profile": Ablation(
        ("split=single_training", "scenario.pieces.leader.start=first")
    ),
    **{f"gamma_{gamma:g}": Ablation((f"agent.gamma={gamma:g}",)) for gamma in GAMMAS},
}


@dataclass(frozen=True)
class Study:
    """What to run, and where.

    Args:
        folder: where everything goes.
        recipe: ``experiment`` of every training.
        seeds: trainings of every variant, numbered from 0.
        overrides: further settings of every run, data and calibration included.
        jobs: trainings at a time.
        accept: settings in which a run found in the folder may differ.
        ablations: which to run: a name of :data:`ABLATIONS`, or one's own as
            ``name:override``, e.g. ``early:reward.terms.safety.threshold=6``; None for all.
        profiles: how many profiles the single-profile protocol is tried on.
    """

    folder: Path
    recipe: str = "paper_alcc"
    seeds: int = 8
    overrides: tuple[str, ...] = ()
    jobs: int = 2
    accept: tuple[str, ...] = ()
    ablations: tuple[str, ...] | None = None
    profiles: int = 4

    def __post_init__(self) -> None:
        for name in ("seeds", "jobs", "profiles"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1")
        for item in self.ablations or ():
            chosen_ablation(item)

    def settings(
        self, entry: str, variant: str, *own: str, recipes: Sequence[str] = ()
    ) -> list[str]:
        """Return the overrides of a part: recipe, the study's inputs, the user's, its own."""
        given = {root_key(item) for item in self.overrides}
        data = f"data.path={quoted(self.folder / TRAJECTORIES)}"
        drivers = f"drivers.path={quoted(self.folder / DRIVERS)}"
        shared = [item for item in self.overrides if root_key(item) not in OF_CALIBRATION]
        return [
            f"experiment=[{','.join([self.recipe, *recipes])}]",
            f"variant={variant}",
            "data=episodes",
            data,
            *(() if "drivers" in given else ("drivers=calibrated", drivers)),
            *known_settings(shared, entry),
            *own,
        ]

    def runs(
        self, folder: Path, own: Sequence[str], variants: Sequence[str], recipes: Sequence[str] = ()
    ) -> list[Run]:
        """Return a training per seed and variant, seeds first so that all variants grow alike."""
        return [
            Run(
                folder / variant / f"seed_{seed}",
                tuple(self.settings("train", variant, f"seed={seed}", *own, recipes=recipes)),
            )
            for seed in range(self.seeds)
            for variant in variants
        ]


def chosen_ablation(item: str) -> tuple[str, Ablation]:
    """Return the name and the ablation that an item of a command line stands for.

    Raises:
        ConfigError: if it is neither known nor says what to override.
    """
    name, _, override = item.partition(":")
    if override:
        return name, Ablation((override,))
    if name not in ABLATIONS:
        raise unknown_name("ablation", name, ABLATIONS)
    return name, ABLATIONS[name]


def run(study: Study, parts: Sequence[str] = PARTS) -> list[Outcome]:
    """Calibrate, train and evaluate; whatever is finished is skipped.

    Args:
        study: what to run.
        parts: ``main``, ``ablations`` and ``single``, independent of each other.

    Returns:
        What became of every training.

    Raises:
        LccError: one clear error for wrong settings, data or files.
    """
    for part in parts:
        if part not in PARTS:
            raise unknown_name("part", part, PARTS)
    main = study.runs(study.folder / "train", (), VARIANTS)
    wanted = main[0].compose()  # a typo must not cost a calibration
    calibrate(study)
    steps = {"main": _main, "ablations": _ablations, "single": _single}
    outcomes = []
    for part in (part for part in PARTS if part in parts):
        outcomes += steps[part](study, wanted)
    note_problems(study.folder, outcomes)
    return outcomes


def calibrate(study: Study) -> None:
    """Read the trajectories and calibrate drivers, both modes for the paper's Fig. 4; once."""
    if (study.folder / DRIVERS).exists() and (study.folder / TRAJECTORIES).exists():
        return
    skipped = ("drivers", "split", "scenario", "reward", "agent", "training", "evaluation")
    own = [item for item in study.overrides if root_key(item) not in skipped]
    calibrate_once(load("pipeline", ["calibration=both", *own]), study.folder)


def _main(study: Study, wanted: DictConfig) -> list[Outcome]:
    folder = study.folder / "train"
    outcomes = run_all(study.runs(folder, (), VARIANTS), study.jobs, study.accept)
    settings = study.settings("evaluate", "alcc")
    evaluate_all(settings, folder, study.folder / "evaluation", foreign(outcomes))
    return outcomes


def _ablations(study: Study, wanted: DictConfig) -> list[Outcome]:
    chosen = study.ablations or tuple(
        name for name in ABLATIONS if name != f"gamma_{wanted.agent.gamma:g}"
    )
    changes = dict(chosen_ablation(item) for item in chosen)
    folders = {name: study.folder / "ablations" / name for name in changes}
    runs = [
        run
        for name, folder in folders.items()
        for run in study.runs(folder, changes[name].overrides, changes[name].variants)
    ]
    outcomes = run_all(runs, study.jobs, study.accept)
    for name, folder in folders.items():
        settings = study.settings("evaluate", "alcc", *changes[name].overrides)
        evaluate_all(settings, folder, folder / "evaluation", foreign(outcomes))
    return outcomes


def _single(study: Study, wanted: DictConfig) -> list[Outcome]:
    recipes = ("single_profile",)
    chosen = spread_profiles(study.folder / TRAJECTORIES, wanted, study.profiles)
    folders = {number: study.folder / "single" / str(number) for number in chosen}
    runs = [
        run
        for number, folder in folders.items()
        for run in study.runs(folder, (f"split.profile={number}",), VARIANTS, recipes)
    ]
    outcomes = run_all(runs, study.jobs, study.accept)
    for number, folder in folders.items():
        own = f"split.profile={number}"
        settings = study.settings("evaluate", "alcc", own, recipes=recipes)
        evaluate_all(settings, folder, folder / "evaluation", foreign(outcomes))
    return outcomes


def spread_profiles(table: Path, cfg: DictConfig, count: int) -> list[int]:
    """Choose profiles for the single-profile protocol, spread evenly over all of them."""
    scenario = cfg.scenario
    profiles = leader_profiles(read_episodes(table), scenario.time_step).at_least(scenario.horizon)
    # Midpoints of equal parts: one profile is the middle one, more never cluster at the ends.
    places = (np.arange(min(count, len(profiles))) + 0.5) / min(count, len(profiles))
    return [int(place * len(profiles)) for place in places]


def foreign(outcomes: Sequence[Outcome]) -> set[Path]:
    """Return the folders of runs that were made with other settings."""
    return {outcome.run.folder for outcome in outcomes if outcome.status == FOREIGN}


def evaluate_all(
    settings: Sequence[str], trained: Path, folder: Path, excluded: Collection[Path] = ()
) -> None:
    """Evaluate every finished policy of a folder beside the humans, unless that is done already.

    Args:
        settings: overrides of the entry point ``evaluate``.
        trained: holds ``<variant>/seed_<n>``.
        folder: where the evaluation goes.
        excluded: runs to leave out.
    """
    finished = {path.parent for path in trained.glob("*/seed_*/episodes.parquet")}
    runs = sorted(
        finished - set(excluded),
        key=lambda path: (path.parent.name, int(path.name.removeprefix("seed_"))),
    )
    if not runs:
        log.warning("%s: nothing trained to evaluate", trained)
        return
    cfg = load("evaluate", settings)
    cfg.compare = [str(path) for path in runs]
    if not _up_to_date(cfg, folder, runs):
        log.info("evaluating %d policies into %s", len(runs), folder)
        evaluate.run(cfg, folder, own=False, quiet=True)


def _up_to_date(cfg: DictConfig, folder: Path, runs: Sequence[Path]) -> bool:
    table = folder / "episodes.parquet"
    if not table.exists():
        return False
    done = load_config(folder)
    newest = max((path / "policy.pt").stat().st_mtime for path in runs)
    same = identity(done) == identity(cfg) and list(done.compare) == list(cfg.compare)
    return same and table.stat().st_mtime >= newest


__all__ = ["ABLATIONS", "FINISHED", "PARTS", "Study", "run"]
