"""The page of the ALCC study: tables and figures from the study's parquet files alone."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd

from lcc_rl import results
from lcc_rl.errors import ResultsError
from lcc_rl.io.files import read_parquet
from lcc_rl.results.calibration_figures import calibration_figure, joint_figure
from lcc_rl.results.runs import CONFIG
from lcc_rl.results.training_figures import learning_curve
from lcc_rl.studies.alcc import figures, tables
from lcc_rl.studies.alcc.comparison_figures import (
    comparison_figure,
    followers_figure,
    single_profile_figure,
)
from lcc_rl.studies.alcc.paper_tables import human_energy
from lcc_rl.studies.alcc.report_main import MAIN, add_main, size
from lcc_rl.studies.alcc.settings import ABLATIONS, FILTERS
from lcc_rl.studies.page import Page
from lcc_rl.studies.runner import read_notes

TITLE = "Adaptive Leading Cruise Control: the study"
ITSELF = "none (the recipe itself)"
NO_FILTER = "without"


def write_results(
    folder: str | Path, formats: Iterable[str] = (), target: Path | None = None
) -> Path:
    """Write tables/*.parquet, figures/*.png and report.html from a study's parquet files alone.

    Sections whose runs do not exist are left out.

    Args:
        folder: a study's folder, written by ``lcc-rl reproduce alcc``.
        formats: further formats of the figures.
        target: Markdown file whose marked tables are written anew, too.

    Returns:
        The page's path.

    Raises:
        ResultsError: if there is no evaluation in the folder, or a file cannot be read.
    """
    page = Page(folder, formats)
    if not any(page.folder.glob("**/evaluation/episodes.parquet")):
        raise ResultsError(
            f"{folder}: no evaluation/episodes.parquet; lcc-rl reproduce alcc makes it"
        )
    for add in (add_main, _filter, _learning, _ablations, _single, _followers, _people):
        add(page)
    if target is not None:
        page.fill(target)
    return _made(page)


def _filter(page: Page) -> None:
    order = [f"full_speed_{value}" for value in FILTERS]
    frames = _evaluations(page.folder / "filter", "filter", order)
    if not frames:
        return
    episodes, first = _beside_main(page, frames, filter=NO_FILTER), frames[0]
    text = (
        "The same policies, with +filter=cbf between them and the car: nothing is trained. "
        "The filter keeps the time-to-collision above 4 s and, as far as that leaves room, the "
        "time gap below 2.45 s; at speeds below scenario.filters.automated.full_speed, in m/s, by "
        "which the lines differ, below proportionally less. The strategy cbf is the filter by "
        "itself, moving a car that always brakes a little: what the policies add is the difference "
        f"to it. The further tables are those of the default, {FILTERS[0]} m/s."
    )
    caption = f"Without and with the filter, {size(first)}"
    shown = [
        ("filter", caption, tables.comparison(episodes, "filter")),
        ("filter_headline", "Energy of both saved", tables.headline(first)),
        ("filter_constraints", "All episodes", tables.constraints(first)),
        ("filter_by_seed", "Every seed", tables.constraints_by_seed(first)),
        ("filter_human", "Human driver's energy", human_energy(first)),
    ]
    caption = "Energy, safety and efficiency without and with the filter."
    drawn = [("filter", caption, comparison_figure(episodes, "filter"))]
    page.add("A filter that keeps the time-to-collision", text, shown, drawn)


def _learning(page: Page) -> None:
    if not any((page.folder / "train").rglob("training.parquet")):
        return
    training = results.load(page.folder / "train", "training", strict=True)
    text = (
        "Rewards are sums per episode as played in training, where agents other than "
        "analytic add noise to their actions, mean over the episodes of a batch. drop: how far "
        "the mean of a tenth of the training ever falls below the best tenth before it."
    )
    shown = [("learning", "Learning curves, every seed", tables.learning(training))]
    caption = "Counterpart of Fig. 6: reward per episode over training."
    drawn = [
        ("learning_curve", caption, learning_curve(training)),
        ("reward_terms", "Every reward term over training.", figures.reward_terms(training)),
    ]
    page.add("Learning", text, shown, drawn)


def _ablations(page: Page) -> None:
    frames = _evaluations(page.folder / "ablations", "ablation", list(ABLATIONS))
    if not frames:
        return
    episodes = _beside_main(page, frames, ablation=ITSELF)
    text = (
        "Each line changes one thing of the recipe by an override and trains anew; savings are "
        "against the humans in the same scenario, so that a change of the scenario (no "
        "recuperation) is compared with itself."
    )
    caption = "Energy, safety and efficiency under each change."
    shown = [("ablations", "Ablations", tables.comparison(episodes))]
    page.add("Ablations", text, shown, [("ablations", caption, comparison_figure(episodes))])


def _single(page: Page) -> None:
    episodes = _numbered(page.folder / "single", "study_profile")
    if episodes is None:
        return
    text = (
        "The paper's probable protocol: the same stretch of one leader in training and evaluation. "
        "Each profile has its own controllers, trained on nothing else."
    )
    heading = "One profile for training and evaluation"
    shown = [("single_profile", heading, tables.single_profile(episodes))]
    caption = "Total energy on the profile that was trained on: every seed, beside the human."
    drawn = [("single_profile", caption, single_profile_figure(episodes))]
    page.add(heading, text, shown, drawn)


def _followers(page: Page) -> None:
    episodes = _numbered(page.folder / "followers", "followers")
    if episodes is None:
        return
    text = (
        "Energies are those of the controlled car and of all human drivers behind it. Unless "
        "the study's overrides say otherwise, the controllers learn by the gradient through the "
        "simulator (agent=analytic), which is more precise than DDPG, and are evaluated on every "
        f"held-out window ({size(episodes)}). Time gaps and times-to-collision tell "
        "whether a saving is bought with distance or risk."
    )
    table = tables.comparison(episodes, "followers")
    shown = [("followers", "Against the number of human drivers behind", table)]
    drawn = []
    if {"alcc", "reference"} <= set(episodes["strategy"]):
        caption = (
            "Energy saved by regard for the human drivers behind (alcc) and by counting one's own "
            "energy as often (own_energy), against their number."
        )
        drawn.append(("followers", caption, followers_figure(episodes)))
    page.add("More human drivers behind", text, shown, drawn)


def _beside_main(page: Page, frames: Sequence[pd.DataFrame], **column: str) -> pd.DataFrame:
    """Join evaluations to that of the main part, where there is one."""
    path = page.folder / MAIN
    main = [read_parquet(path).assign(**column)] if path.exists() else []
    return pd.concat([*main, *frames], ignore_index=True)


def _evaluations(root: Path, column: str, order: Sequence[str] = ()) -> list[pd.DataFrame]:
    """Read the evaluation of every part below a folder, with its name as a column."""
    found = {path.parents[1].name: path for path in root.glob("*/evaluation/episodes.parquet")}
    names = [*(name for name in order if name in found), *sorted(found.keys() - set(order))]
    return [read_parquet(found[name]).assign(**{column: name}) for name in names]


def _numbered(root: Path, column: str) -> pd.DataFrame | None:
    """Join the evaluations of parts whose names are numbers, in their order; None without any."""
    frames = _evaluations(root, column)
    if not frames:
        return None
    episodes = pd.concat(frames, ignore_index=True)
    episodes[column] = episodes[column].astype(int)
    return episodes.sort_values(column, kind="stable")


def _people(page: Page) -> None:
    """Add the calibration and the power map."""
    caption = "Counterpart of Fig. 2: the motor's power map (A2)."
    drawn = [("power_map", caption, figures.power_map())]
    path = page.folder / "calibration" / "drivers.parquet"
    text = "The motor's power map is the paper's polynomial."
    if path.exists():
        drivers = read_parquet(path)
        text += (
            " Drivers are calibrated on the study's trajectories; a third of them typically reach "
            "the upper bound of the desired speed, which congested traffic does not identify."
        )
        caption = "Counterpart of Fig. 4: calibration error and parameters."
        drawn.append(("calibration", caption, calibration_figure(drivers)))
        caption = "Counterpart of Fig. 5: joint distribution of desired speed and time gap."
        drawn.append(("joint_distribution", caption, joint_figure(drivers)))
    page.add("Drivers and power", text, figures=drawn)


def _made(page: Page) -> Path:
    """Write the page, with the configurations and problems of the study."""
    problems = read_notes(page.folder).get("problems", {})
    listed = "\n".join(f"{name}: {problem}" for name, problem in problems.items())
    details = [("Problems", listed)] if problems else []
    configs = sorted((page.folder / "train").glob(f"*/*/{CONFIG}"))
    firsts = {path.parents[1].name: path for path in reversed(configs)}
    details += [
        (f"Configuration of {name}, {path.parent.name}", path.read_text())
        for name, path in sorted(firsts.items())
    ]
    seeds = [f"{p.parents[1].name}/{p.parent.name}" for p in configs]
    more = f"\n\nTrainings behind the main part: {', '.join(seeds)}." if seeds else ""
    more += f"\n\n{len(problems)} runs failed or were left out, see below." if problems else ""
    return page.write(TITLE, details, more)
