"""Study room: the ALCC study, from trajectories to every run and evaluation that it needs."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from omegaconf import DictConfig

from lcc_rl import evaluate
from lcc_rl.config import load, require
from lcc_rl.data.episodes import read_episodes
from lcc_rl.data.profiles import leader_profiles
from lcc_rl.errors import ConfigError, unknown_name
from lcc_rl.pipeline import TRAJECTORIES, calibrate_once, known_settings, root_key
from lcc_rl.results.runs import identity, load_config
from lcc_rl.runs.sweeps import key_of
from lcc_rl.studies.runner import (
    FINISHED,
    Outcome,
    Run,
    differences,
    note,
    note_problems,
    quoted,
    run_all,
)

log = logging.getLogger("lcc_rl")

VARIANTS = ("alcc", "reference")
CONTROL = "own_energy"  # is it regard for others, or only that energy counts more?
PARTS = ("main", "filter", "ablations", "single", "followers")
DRIVERS = Path("calibration/drivers.parquet")
GAMMAS = (0.9, 0.95, 0.99, 0.995)
ROWS = "*/seed_*/episodes.parquet"
SMOKE = "smoke"
RECIPES = ("quickstart", "paper_alcc")  # how long, and with what batches, DDPG learns
OF_DDPG = ("short_training", *(f"recipe_{name}" for name in RECIPES))
# What the calibration takes in place of the trainings.
OF_CALIBRATION = ("data", "calibration")


# From which speed on the filter allows the longest time gap [m/s], its own first: how near the
# car is kept, at the price of energy.
FILTERS = (0, 6, 7, 8, 10, 12)
# How the part "followers" learns: DDPG's seeds differ by more than regard for followers brings.
PRECISE = ("agent=analytic",)
EVERY_WINDOW = ("evaluation.profiles=null",)


@dataclass(frozen=True)
class Change:
    """How a part differs from the main one: in overrides, variants, recipes, its evaluation."""

    overrides: tuple[str, ...] = ()
    variants: tuple[str, ...] = VARIANTS
    recipes: tuple[str, ...] = ()
    evaluation: tuple[str, ...] = ()


MAIN = Change(variants=(*VARIANTS, CONTROL))
ABLATIONS = {
    "no_safety": Change(("reward.terms.safety.weight=0",)),
    "no_efficiency": Change(("reward.terms.efficiency.weight=0",)),
    "no_cav_energy": Change(("reward.terms.cav_energy.weight=0",)),
    "no_hdv_energy": Change(("reward.terms.hdv_energy.weight=0",), ("alcc",)),
    "true_acceleration": Change(("reward.terms.hdv_energy.power=power",), ("alcc",)),
    "population_mean": Change(("scenario.pieces.estimator.learning_time=inf",), ("alcc",)),
    "no_recuperation": Change(("scenario.pieces.cav_power.recuperation=false",)),
    "one_training_profile": Change(("split=single_training", "scenario.pieces.leader.start=first")),
    "constant_rate": Change(("agent.final_share=1.0",)),
    "short_training": Change(("training.episodes=320",)),
    **{f"recipe_{name}": Change(recipes=(name,)) for name in RECIPES},
    **{f"gamma_{gamma:g}": Change((f"agent.gamma={gamma:g}",)) for gamma in GAMMAS},
}


@dataclass(frozen=True)
class Study:
    """What to run, and where.

    Args:
        folder: where everything goes.
        recipe: ``experiment`` of every training; None for the defaults of the agent.
        seeds: trainings of every variant, numbered from 0.
        overrides: further settings of every run, data and calibration included.
        jobs: trainings at a time.
        accept: settings in which a run found in the folder may differ.
        ablations: which to run: a name of :data:`ABLATIONS`, or one's own as
            ``name:override``, e.g. ``early:reward.terms.safety.threshold=6``; None for all.
        profiles: how many profiles the single-profile protocol is tried on.
        followers: numbers of human drivers behind the car in the part of that name.
    """

    folder: Path
    recipe: str | None = "paper_alcc"
    seeds: int = 8
    overrides: tuple[str, ...] = ()
    jobs: int = 2
    accept: tuple[str, ...] = ()
    ablations: tuple[str, ...] | None = None
    profiles: int = 4
    followers: tuple[int, ...] = (1, 2, 5, 10)

    def __post_init__(self) -> None:
        for name in ("seeds", "jobs", "profiles"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1")
        require(min(self.followers, default=0) >= 1, "followers must be at least 1")
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
            f"experiment=[{','.join([*filter(None, [self.recipe]), *recipes])}]",
            f"variant={variant}",
            "data=episodes",
            data,
            *(() if "drivers" in given else ("drivers=calibrated", drivers)),
            *known_settings(shared, entry),
            *own,
        ]

    def runs(
        self, folder: Path, change: Change = Change(), seeds: Iterable[int] | None = None
    ) -> list[Run]:
        """Return a training per seed and variant, seeds first so that all variants grow alike."""
        return [
            Run(
                folder / variant / f"seed_{seed}",
                tuple(
                    self.settings(
                        "train",
                        variant,
                        f"seed={seed}",
                        *change.overrides,
                        recipes=change.recipes,
                    )
                ),
            )
            for seed in (range(self.seeds) if seeds is None else seeds)
            for variant in change.variants
        ]

    def earlier(self, folder: Path, change: Change = Change()) -> list[Outcome]:
        """Return what an earlier command left of further seeds: finished, of the same settings."""
        found = {int(path.parent.name.removeprefix("seed_")) for path in folder.glob(ROWS)}
        runs = self.runs(folder, change, sorted(found - set(range(self.seeds))))
        return [
            Outcome(run, FINISHED)
            for run in runs
            if (run.folder / "episodes.parquet").exists()
            and not differences(run, run.compose(), self.accept)
        ]


def chosen_ablation(item: str) -> tuple[str, Change]:
    """Return the name and the ablation that an item of a command line stands for.

    Raises:
        ConfigError: if it is neither known nor says what to override.
    """
    name, _, override = item.partition(":")
    if override:
        return name, Change((override,))
    if name not in ABLATIONS:
        raise unknown_name("ablation", name, ABLATIONS)
    return name, ABLATIONS[name]


def run(study: Study, parts: Sequence[str] = PARTS, command: str = "") -> list[Outcome]:
    """Calibrate, train and evaluate; whatever is finished is skipped.

    Args:
        study: what to run.
        parts: ``main``, and what goes with it: ``filter`` needs its policies, all others none.
        command: what was typed, to be kept in the folder.

    Returns:
        What became of every training.

    Raises:
        LccError: one clear error for wrong settings, data or files.
    """
    for part in parts:
        if part not in PARTS:
            raise unknown_name("part", part, PARTS)
    wanted = study.runs(study.folder / "train")[0].compose()  # a typo must not cost a calibration
    if "filter" in parts and any(root_key(item) == "filter" for item in study.overrides):
        raise ConfigError(
            "the part filter puts +filter=barrier on trained policies: give the override "
            "or that part (--parts), not both"
        )
    if "followers" in parts:
        followers_study(study).runs(study.folder, followers_change(study, 1))[0].compose()
    if "ablations" in parts:
        for _, change in map(chosen_ablation, study.ablations or ()):
            study.runs(study.folder, change)[0].compose()
    if command:
        note(study.folder, "alcc", command)
    calibrate(study)
    steps = {
        "main": _main,
        "filter": _filter,
        "ablations": _ablations,
        "single": _single,
        "followers": _followers,
    }
    outcomes: dict[Path, Outcome] = {}  # the part filter has the trainings of the main one
    for part in (part for part in PARTS if part in parts):
        outcomes |= {outcome.run.folder: outcome for outcome in steps[part](study, wanted)}
    note_problems(study.folder, list(outcomes.values()))
    return list(outcomes.values())


def calibrate(study: Study) -> None:
    """Read the trajectories and calibrate drivers, both modes for the paper's Fig. 4; once."""
    if (study.folder / DRIVERS).exists() and (study.folder / TRAJECTORIES).exists():
        return
    skipped = ("drivers", "split", "scenario", "reward", "agent", "training", "evaluation")
    own = [item for item in study.overrides if root_key(item) not in skipped]
    calibrate_once(load("pipeline", ["calibration=both", *own]), study.folder)


def _main(study: Study, wanted: DictConfig) -> list[Outcome]:
    outcomes, usable = _trained(study)
    evaluate_all(study.settings("evaluate", "alcc"), usable, study.folder / "evaluation")
    return outcomes


def _trained(study: Study) -> tuple[list[Outcome], list[Outcome]]:
    """Train what is left of the main part; return its outcomes, and those with earlier seeds."""
    folder = study.folder / "train"
    outcomes = run_all(study.runs(folder, MAIN), study.jobs, study.accept)
    return outcomes, outcomes + study.earlier(folder, MAIN)


def _filter(study: Study, wanted: DictConfig) -> list[Outcome]:
    """Put the filter on the policies of the main part, with several settings."""
    outcomes, usable = _trained(study)
    # The variant barrier is evaluated, too: what the filter does by itself; it has no agent.
    kept = [item for item in study.overrides if root_key(item) != "agent"]
    alone = replace(study, overrides=tuple(kept))
    for speed in FILTERS:
        own = f"scenario.pieces.barrier.full_speed={speed}"
        folder = study.folder / "filter" / f"full_speed_{speed}" / "evaluation"
        evaluate_all(alone.settings("evaluate", "barrier", own), usable, folder, own=True)
    return outcomes


def _ablations(study: Study, wanted: DictConfig) -> list[Outcome]:
    # Those that change nothing are the main part itself; what is tried in seconds stays short.
    left_out = {f"gamma_{wanted.agent.gamma:g}", f"recipe_{study.recipe}"}
    if study.recipe in (None, SMOKE):
        left_out |= set(OF_DDPG)
    chosen = study.ablations or tuple(name for name in ABLATIONS if name not in left_out)
    folder = study.folder / "ablations"
    return _each(study, {folder / n: c for n, c in map(chosen_ablation, chosen)})


def _single(study: Study, wanted: DictConfig) -> list[Outcome]:
    chosen = spread_profiles(study.folder / TRAJECTORIES, wanted, study.profiles)
    folder, recipes = study.folder / "single", ("single_profile",)
    return _each(
        study,
        {folder / str(n): Change((f"split.profile={n}",), recipes=recipes) for n in chosen},
    )


def _followers(study: Study, wanted: DictConfig) -> list[Outcome]:
    changes = {
        study.folder / "followers" / str(number): followers_change(study, number)
        for number in sorted(set(study.followers))
    }
    first, *others = changes
    # What the reference learns does not depend on how many drive behind it: it learns once.
    for folder in others:
        changes[folder] = replace(changes[folder], variants=("alcc", CONTROL))
    return _each(followers_study(study), changes, shared=first / "reference")


def chooses_agent(overrides: Iterable[str]) -> bool:
    """Whether the user asks for an agent other than the recipe's."""
    return any(key_of(item) == "agent" for item in overrides)


def followers_study(study: Study) -> Study:
    """Return the study as its part ``followers`` learns, with an agent of its own.

    Recipes (but smoke) and overrides of agent and training are DDPG's and do not count there,
    unless the user chooses the agent.
    """
    if chooses_agent(study.overrides):
        return study
    kept = [item for item in study.overrides if root_key(item) not in ("agent", "training")]
    recipe = SMOKE if study.recipe == SMOKE else None
    return replace(study, recipe=recipe, overrides=tuple(kept))


def followers_change(study: Study, number: int) -> Change:
    """Return what makes a training one of the part ``followers``, where the user says no other."""
    given = {key_of(item) for item in study.overrides}
    learner, windows = (
        tuple(item for item in items if key_of(item) not in given)
        for items in (PRECISE, EVERY_WINDOW)
    )
    own = (*learner, f"scenario.followers={number}")
    return Change(own, MAIN.variants, evaluation=windows)


def _each(
    study: Study, changes: Mapping[Path, Change], shared: Path | None = None
) -> list[Outcome]:
    """Train and evaluate every change of the recipe in a folder of its own.

    Args:
        study: what to run.
        changes: by folder.
        shared: folder of a variant of one of them whose trainings all are compared with.

    Returns:
        What became of every training.
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


def spread_profiles(table: Path, cfg: DictConfig, count: int) -> list[int]:
    """Choose profiles for the single-profile protocol, spread evenly over all of them."""
    scenario = cfg.scenario
    profiles = leader_profiles(read_episodes(table), scenario.time_step).at_least(scenario.horizon)
    # Midpoints of equal parts: one profile is the middle one, more never cluster at the ends.
    places = (np.arange(min(count, len(profiles))) + 0.5) / min(count, len(profiles))
    return [int(place * len(profiles)) for place in places]


def evaluate_all(
    settings: Sequence[str], outcomes: Sequence[Outcome], folder: Path, own: bool = False
) -> None:
    """Evaluate every finished policy beside the humans, unless that is done already.

    Args:
        settings: overrides of the entry point ``evaluate``.
        outcomes: trainings in ``<variant>/seed_<n>``; those that did not finish are left out.
        folder: where the evaluation goes.
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
    if not _up_to_date(cfg, folder, runs):
        log.info("evaluating %d policies into %s", len(runs), folder)
        evaluate.run(cfg, folder, own=own, quiet=True)


def _up_to_date(cfg: DictConfig, folder: Path, runs: Sequence[Path]) -> bool:
    table = folder / "episodes.parquet"
    if not table.exists():
        return False
    done = load_config(folder)
    newest = max((path / "policy.pt").stat().st_mtime for path in runs)
    same = identity(done) == identity(cfg) and list(done.compare) == list(cfg.compare)
    return same and table.stat().st_mtime >= newest


__all__ = ["ABLATIONS", "FINISHED", "PARTS", "Study", "run"]
