"""Settings of the ALCC study: ablations, what each part changes, and the runs that follow."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lcc_rl.commands.pipeline import TRAJECTORIES, known_settings, root_key
from lcc_rl.errors import require, unknown_name
from lcc_rl.runs.sweeps import key_of
from lcc_rl.studies.runner import (
    EPISODES,
    FINISHED,
    BaseStudy,
    Outcome,
    Run,
    differences,
    quoted,
)

DRIVERS = Path("calibration/drivers.parquet")
ROWS = f"*/seed_*/{EPISODES}"
SMOKE = "smoke"
OF_CALIBRATION = ("data", "calibration")  # overrides that only the calibration takes
VARIANTS = ("alcc", "reference")
CONTROL = "own_energy"  # weighs its own energy as much as alcc weighs that of all
GAMMAS = (0.9, 0.95, 0.99, 0.995)
RECIPES = ("quickstart", "paper_alcc")  # length and batches of DDPG's training
OF_DDPG = ("short_training", *(f"recipe_{name}" for name in RECIPES))
# Speeds from which the filter allows the longest time gap [m/s], the default first.
FILTERS = (0, 6, 7, 8, 10, 12)
# The part "followers": DDPG's seeds differ by more than regard for followers saves.
PRECISE = ("agent=analytic",)
EVERY_WINDOW = ("evaluation.profiles=null",)


@dataclass(frozen=True)
class Change:
    """The overrides, variants, recipes and settings of the evaluation of one part."""

    overrides: tuple[str, ...] = ()
    variants: tuple[str, ...] = VARIANTS
    recipes: tuple[str, ...] = ()
    evaluation: tuple[str, ...] = ()


UNCHANGED = Change()
# One profile for training, the usual held-out recordings for evaluation.
ONE_PROFILE = (
    "split=single",
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


def followers_change(overrides: Iterable[str], number: int) -> Change:
    """Return the change of the part ``followers``, with ``number`` human drivers behind the car.

    Settings among the study's overrides are kept.
    """
    given = {key_of(item) for item in overrides}
    learner, windows = (
        tuple(item for item in items if key_of(item) not in given)
        for items in (PRECISE, EVERY_WINDOW)
    )
    return Change(
        (*learner, f"scenario.string='automated human*{number}'"), MAIN.variants, evaluation=windows
    )


@dataclass(frozen=True)
class Study(BaseStudy):
    """The settings of the ALCC study.

    Attributes:
        ablations: names of :data:`ABLATIONS` or further ones as ``name:override``, e.g.
            ``early:reward.terms.safety.threshold=6``; None for all.
        profiles: number of profiles of the part ``single``.
        followers: numbers of human drivers behind the car in the part ``followers``.
    """

    recipe: str | None = "paper_alcc"
    ablations: tuple[str, ...] | None = None
    profiles: int = 4
    followers: tuple[int, ...] = (1, 2, 5, 10)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.profiles >= 1, "profiles must be at least 1")
        require(min(self.followers, default=0) >= 1, "followers must be at least 1")
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
        self, folder: Path, change: Change = UNCHANGED, seeds: Iterable[int] | None = None
    ) -> list[Run]:
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

    def earlier(self, folder: Path, change: Change = UNCHANGED) -> list[Outcome]:
        """Return finished trainings of further seeds with the same settings."""
        found = {int(path.parent.name.removeprefix("seed_")) for path in folder.glob(ROWS)}
        runs = self.runs(folder, change, sorted(found - set(range(self.seeds))))
        return [
            Outcome(run, FINISHED)
            for run in runs
            if run.finished and not differences(run, run.compose(), self.accept)
        ]


def followers_study(study: Study) -> Study:
    """Return the study of the part ``followers``, which has an agent of its own.

    Recipes (except smoke) and overrides of agent and training are DDPG's and are dropped, unless
    the user chooses the agent.
    """
    if chooses_agent(study.overrides):
        return study
    kept = [item for item in study.overrides if root_key(item) not in ("agent", "training")]
    recipe = SMOKE if study.recipe == SMOKE else None
    return replace(study, recipe=recipe, overrides=tuple(kept))
