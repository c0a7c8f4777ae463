"""Study room: the ALCC study as tables, figures and one page, from its parquet files alone."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from lcc_rl import results
from lcc_rl.errors import ResultsError
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.results import figures as study_figures
from lcc_rl.results.calibration_figures import calibration_figure, joint_figure
from lcc_rl.results.drawing import save
from lcc_rl.results.report import Section, made, write_report
from lcc_rl.results.runs import CONFIG
from lcc_rl.studies.alcc import figures as alcc_figures
from lcc_rl.studies.alcc import tables as alcc_tables
from lcc_rl.studies.alcc.study import ABLATIONS, FILTERS
from lcc_rl.studies.runner import read_notes

log = logging.getLogger("lcc_rl")

TITLE = "Adaptive Leading Cruise Control: the study"
MAIN = Path("evaluation", "episodes.parquet")
ITSELF = "none (the recipe itself)"
NO_FILTER = "without"
Tables = list[tuple[str, pd.DataFrame]]
Figures = list[tuple[str, Path]]


class Page:
    """Collects the sections of a study's page, writing each table and figure beside it.

    Args:
        folder: the study's folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.sections: list[Section] = []

    def table(self, name: str, caption: str, frame: pd.DataFrame) -> tuple[str, pd.DataFrame]:
        """Keep a table as ``tables/<name>.parquet``."""
        write_parquet(frame, self.folder / "tables" / f"{name}.parquet")
        return caption, frame

    def figure(self, name: str, caption: str, figure: Figure) -> tuple[str, Path]:
        """Keep a figure as ``figures/<name>.png``."""
        return caption, save(figure, self.folder / "figures" / f"{name}.png", dpi=130)

    def add(self, heading: str, text: str, tables: Tables, figures: Figures | None = None) -> None:
        """Add a section."""
        self.sections.append(Section(heading, text, tables, figures or []))


def write_results(folder: str | Path) -> Path:
    """Write tables/*.parquet, figures/*.png and report.html from a study's parquet files alone.

    Sections whose runs do not exist are left out.

    Args:
        folder: a folder as ``tools/reproduce.py alcc`` leaves it.

    Returns:
        The page's path.

    Raises:
        ResultsError: if there is no evaluation in the folder, or a file cannot be read.
    """
    page = Page(Path(folder))
    parts: list[Callable[[Page], None]] = [
        _main,
        _filter,
        _learning,
        _ablations,
        _single,
        _followers,
        _people,
        _made,
    ]
    if not any(page.folder.glob("**/evaluation/episodes.parquet")):
        raise ResultsError(
            f"{folder}: no evaluation/episodes.parquet; python tools/reproduce.py alcc makes it"
        )
    for part in parts:
        part(page)
    return write_report(folder, TITLE, page.sections)


def _main(page: Page) -> None:
    """Add what the evaluation of the main runs says."""
    if not (page.folder / MAIN).exists():
        return
    episodes = read_parquet(page.folder / MAIN)
    size = _size(episodes)
    _headline(page, episodes, size)
    _constraints(page, episodes, size)
    if {"alcc", "reference"} <= set(episodes["strategy"]):
        _awareness(page, episodes, size)
        _generalization(page, episodes)
    _human(page, episodes, size)


def _size(episodes: pd.DataFrame) -> str:
    return (
        f"{episodes['profile_id'].nunique()} held-out profiles × "
        f"{episodes['driver_id'].nunique()} drivers"
    )


def _headline(page: Page, episodes: pd.DataFrame, size: str) -> None:
    seeds = episodes["training_seed"].nunique()
    sure = (
        "Intervals are 95 % percentile-bootstrap intervals over training seeds, each side of a "
        "comparison resampled on its own."
        if seeds > 1
        else "Every controller was trained with one seed only: no interval can be given, and "
        "single seeds differ by about as much as the controllers do."
    )
    text = (
        "alcc saves energy for itself and for the human driver behind; reference is the same "
        "without regard for the driver behind; own_energy is reference whose own energy counts "
        "as often as alcc's reward has terms of energy: what it saves is due to that weight, not "
        "to regard for others; idm is a human in the car's place; direct is the "
        "human driver directly behind the leader, without the car.\n\n"
        f"All meet the same {size} with the same noise. Energies are means per episode, over all "
        "seeds; savings are positive where energy is saved. Raw trip energy rewards ending slower "
        f"than one began, so energies net of the change in kinetic energy stand beside it. {sure}"
    )
    tables = [
        page.table("headline", f"Total energy saved, {size}", alcc_tables.headline(episodes)),
        page.table("energies", f"Energy per episode, {size}", alcc_tables.energies(episodes)),
    ]
    figures = [
        page.figure(
            "distributions",
            "Counterpart of Fig. 11: energy of controlled car and human driver by strategy; a "
            "driver's value is its mean over profiles and seeds.",
            alcc_figures.distributions(episodes),
        )
    ]
    figures += _episode(page)
    page.add("At a glance", text, tables, figures)


def _episode(page: Page) -> Figures:
    """Draw one held-out episode of the studied controller."""
    path = page.folder / "evaluation" / "steps.parquet"
    steps = read_parquet(path) if path.exists() else pd.DataFrame({"strategy": []})
    if not (steps["strategy"] == "alcc").any():
        return []
    figure = study_figures.sample_episode(steps, "alcc")
    caption = "Counterpart of Fig. 7: one held-out episode of alcc, first seed."
    return [page.figure("sample_episode", caption, figure)]


def _constraints(page: Page, episodes: pd.DataFrame, size: str) -> None:
    text = (
        "The study asks for no collision in any episode, time with TTC < 4 s of at most 0.1 %, "
        "and time with a time gap > 2.5 s of at most 1 %, for every seed. Columns: unsafe TTC is "
        "the share of time with TTC < 4 s, long time gap that with a time gap > 2.5 s; a least TTC "
        "of 1,000 s means that the car never closed in."
    )
    tables = [
        page.table("constraints", f"All episodes, {size}", alcc_tables.constraints(episodes)),
        page.table("constraints_by_seed", "Every seed", alcc_tables.constraints_by_seed(episodes)),
    ]
    page.add("Safety and efficiency", text, tables)


def _awareness(page: Page, episodes: pd.DataFrame, size: str) -> None:
    text = (
        "The paper's main claim: regard for the driver behind saves energy in total, alcc against "
        "reference. The paper shows one profile and 923 drivers; its best and worst driver are "
        "given as savings only."
    )
    tables = [
        page.table(
            "table_iv", f"Table IV beside this study ({size})", alcc_tables.table_iv(episodes)
        ),
        page.table("holistic", "Saving per driver", alcc_tables.holistic(episodes)),
    ]
    figures = [
        page.figure(
            "improvement",
            "Counterpart of Fig. 10: total energy saved behind every driver, mean over profiles "
            "and seeds.",
            study_figures.paired_improvement(episodes, "alcc", "reference"),
        )
    ]
    page.add("Does regard for the driver behind pay?", text, tables, figures)


def _generalization(page: Page, episodes: pd.DataFrame) -> None:
    table = alcc_tables.generalization(episodes)
    text = (
        "The paper tries its controller on four profiles it was not trained on. Here every profile "
        "is held out: no recording is in both training and evaluation. A percentage of a profile's "
        "small energy, as in a jam, says little; together is the saving of all profiles' energy."
    )
    tables = [
        page.table(
            "generalization_row",
            "Saving of alcc against reference over profiles, beside the paper's 4",
            alcc_tables.generalization_row(episodes),
        ),
        page.table("generalization", "Every held-out profile", table),
    ]
    figures = [
        page.figure(
            "generalization",
            "Counterpart of Fig. 12: saving on every held-out profile.",
            alcc_figures.generalization_figure(episodes),
        )
    ]
    page.add("Generalization", text, tables, figures)


def _human(page: Page, episodes: pd.DataFrame, size: str) -> None:
    text = (
        "Scenario A: the human driver follows a controlled car. Scenario B: the same driver "
        "directly follows the leader. In A the driver is one place further back, so part of the "
        "saving comes from the place and not from the controller: the row idm shows how much a "
        "human in the car's place saves."
    )
    tables = [
        page.table(
            "human_energy", f"Human driver's energy, {size}", alcc_tables.human_energy(episodes)
        )
    ]
    figures = [
        page.figure(
            f"human_energy_{name}",
            f"Counterpart of Fig. 9: human driver's energy behind {name}, and the saving of every "
            "driver, mean over profiles and seeds.",
            study_figures.human_energy(episodes, name),
        )
        for name in ("alcc", "reference")
        if (episodes["strategy"] == name).any()
    ]
    page.add("Human driver's energy, with and without the car", text, tables, figures)


def _learning(page: Page) -> None:
    if not any((page.folder / "train").rglob("training.parquet")):
        return
    training = results.load(page.folder / "train", "training")
    text = (
        "Rewards are sums per episode as played in training, where agents other than "
        "analytic add noise to their actions, mean over the episodes of a batch. drop: how far "
        "the mean of a tenth of the training ever falls below the best tenth before it."
    )
    tables = [page.table("learning", "Learning curves, every seed", alcc_tables.learning(training))]
    figures = [
        page.figure(
            "learning_curve",
            "Counterpart of Fig. 6: reward per episode over training.",
            study_figures.learning_curve(training),
        ),
        page.figure(
            "reward_terms",
            "Every reward term over training.",
            alcc_figures.reward_terms(training),
        ),
    ]
    page.add("Learning", text, tables, figures)


def _filter(page: Page) -> None:
    order = [f"full_speed_{value}" for value in FILTERS]
    frames = _evaluations(page.folder / "filter", "filter", order)
    if not frames:
        return
    episodes = _beside_main(page, frames, filter=NO_FILTER)
    first, size = frames[0], _size(frames[0])
    text = (
        "The same policies, with +filter=barrier between them and the car: nothing is trained. "
        "The filter keeps the time-to-collision above 4 s and, as far as that leaves room, the "
        "time gap below 2.45 s; at speeds below scenario.pieces.barrier.full_speed, in m/s, by "
        "which the lines differ, below proportionally less. The strategy barrier is the filter by "
        "itself, moving a car that always brakes a little: what the policies add is the difference "
        f"to it. The further tables are those of the default, {FILTERS[0]} m/s."
    )
    tables = [
        page.table(
            "filter",
            f"Without and with the filter, {size}",
            alcc_tables.comparison(episodes, "filter"),
        ),
        page.table("filter_headline", "Total energy saved", alcc_tables.headline(first)),
        page.table("filter_constraints", "All episodes", alcc_tables.constraints(first)),
        page.table("filter_by_seed", "Every seed", alcc_tables.constraints_by_seed(first)),
        page.table("filter_human", "Human driver's energy", alcc_tables.human_energy(first)),
    ]
    figures = [
        page.figure(
            "filter",
            "Energy, safety and efficiency without and with the filter.",
            alcc_figures.comparison_figure(episodes, "filter"),
        )
    ]
    page.add("A filter that keeps the time-to-collision", text, tables, figures)


def _ablations(page: Page) -> None:
    frames = _evaluations(page.folder / "ablations", "ablation", list(ABLATIONS))
    if not frames:
        return
    episodes = _beside_main(page, frames, ablation=ITSELF)
    text = (
        "Each line changes one thing of the recipe by an override and trains anew; savings are "
        "against the human in the same scenario, so that a change of the scenario (no "
        "recuperation) is compared with itself."
    )
    tables = [page.table("ablations", "Ablations", alcc_tables.comparison(episodes))]
    caption = "Energy, safety and efficiency under each change."
    figures = [page.figure("ablations", caption, alcc_figures.comparison_figure(episodes))]
    page.add("Ablations", text, tables, figures)


def _single(page: Page) -> None:
    frames = _evaluations(page.folder / "single", "study_profile")
    if not frames:
        return
    episodes = pd.concat(frames, ignore_index=True)
    episodes["study_profile"] = episodes["study_profile"].astype(int)
    text = (
        "The paper's probable protocol: the same stretch of one leader in training and evaluation. "
        "Each profile has its own controllers, trained on nothing else."
    )
    table = alcc_tables.single_profile(episodes)
    tables = [page.table("single_profile", "One profile for training and evaluation", table)]
    caption = "Total energy on the profile that was trained on: every seed, beside the human."
    figures = [page.figure("single_profile", caption, alcc_figures.single_profile_figure(episodes))]
    page.add("One profile for training and evaluation", text, tables, figures)


def _followers(page: Page) -> None:
    frames = _evaluations(page.folder / "followers", "followers")
    if not frames:
        return
    episodes = pd.concat(frames, ignore_index=True)
    episodes["followers"] = episodes["followers"].astype(int)
    episodes = episodes.sort_values("followers", kind="stable")
    text = (
        "Total energy is that of the controlled car and of all human drivers behind it. Unless "
        "the study's overrides say otherwise, the controllers learn by the gradient through the "
        "simulator (agent=analytic), which is more precise than DDPG, and are evaluated on every "
        f"held-out window ({_size(episodes)}). Time gaps and times-to-collision tell "
        "whether a saving is bought with distance or risk."
    )
    table = alcc_tables.comparison(episodes, "followers")
    tables = [page.table("followers", "Against the number of human drivers behind", table)]
    figures = []
    if {"alcc", "reference"} <= set(episodes["strategy"]):
        caption = (
            "Energy saved by regard for the human drivers behind (alcc) and by counting one's own "
            "energy as often (own_energy), against their number."
        )
        figure = alcc_figures.followers_figure(episodes)
        figures = [page.figure("followers", caption, figure)]
    page.add("More human drivers behind", text, tables, figures)


def _beside_main(page: Page, frames: Sequence[pd.DataFrame], **column: str) -> pd.DataFrame:
    """Join evaluations to that of the main part, where there is one; it gets the column."""
    path = page.folder / MAIN
    main = [read_parquet(path).assign(**column)] if path.exists() else []
    return pd.concat([*main, *frames], ignore_index=True)


def _evaluations(root: Path, column: str, order: Sequence[str] = ()) -> list[pd.DataFrame]:
    """Read the evaluation of every part below a folder, its name as a column; known ones first."""
    found = {path.parents[1].name: path for path in root.glob("*/evaluation/episodes.parquet")}
    names = [*(name for name in order if name in found), *sorted(found.keys() - set(order))]
    return [read_parquet(found[name]).assign(**{column: name}) for name in names]


def _people(page: Page) -> None:
    """Add the calibration and the power map: what all of it rests on."""
    figures = [
        page.figure(
            "power_map",
            "Counterpart of Fig. 2: the motor's power map (A2).",
            alcc_figures.power_map(),
        )
    ]
    path = page.folder / "calibration" / "drivers.parquet"
    text = "The motor's power map is the paper's polynomial."
    if path.exists():
        drivers = read_parquet(path)
        text += (
            " Drivers are calibrated on the study's trajectories; a third of them typically reach "
            "the upper bound of the desired speed, which congested traffic does not identify."
        )
        caption = "Counterpart of Fig. 4: calibration error and parameters."
        figures.append(page.figure("calibration", caption, calibration_figure(drivers)))
        caption = "Counterpart of Fig. 5: joint distribution of desired speed and time gap."
        figures.append(page.figure("joint_distribution", caption, joint_figure(drivers)))
    page.add("Drivers and power", text, [], figures)


def _made(page: Page) -> None:
    notes = read_notes(page.folder)
    problems = notes.get("problems", {})
    details = (
        [("Problems", "\n".join(f"{k}: {v}" for k, v in problems.items()))] if problems else []
    )
    configs = sorted((page.folder / "train").glob(f"*/*/{CONFIG}"))
    firsts = {path.parents[1].name: path for path in reversed(configs)}
    details += [
        (f"Configuration of {name}, {path.parent.name}", path.read_text())
        for name, path in sorted(firsts.items())
    ]
    section = made(notes.get("commands", []), details, page.folder.rglob("training.parquet"))
    seeds = [f"{p.parents[1].name}/{p.parent.name}" for p in configs]
    extra = f"\n\nTrainings behind the main part: {', '.join(seeds)}." if seeds else ""
    trouble = f"\n\n{len(problems)} runs failed or were left out, see below." if problems else ""
    page.sections.append(
        Section(
            section.heading, section.text + extra + trouble, section.tables, (), section.details
        )
    )
