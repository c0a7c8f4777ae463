"""Sections of the ALCC page about the main evaluation: energy, safety, profiles and drivers."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from lcc_rl.io.files import read_parquet
from lcc_rl.results import figures as run_figures
from lcc_rl.results.savings import LEADER
from lcc_rl.results.tables import leader_too_fast
from lcc_rl.studies.alcc import figures, paper_tables, tables
from lcc_rl.studies.alcc.paper_tables import PAPER_HUMAN, PAPER_TABLE_IV
from lcc_rl.studies.page import Page

MAIN = Path("evaluation", "episodes.parquet")


def add_main(page: Page) -> None:
    """Add the sections of the main evaluation, where the folder holds one."""
    if not (page.folder / MAIN).exists():
        return
    episodes = read_parquet(page.folder / MAIN)
    _headline(page, episodes)
    _constraints(page, episodes)
    if {"alcc", "reference"} <= set(episodes["strategy"]):
        _awareness(page, episodes)
        _generalization(page, episodes)
    _human(page, episodes)


def size(episodes: pd.DataFrame) -> str:
    """Return the number of profiles and drivers of an evaluation, in words."""
    return (
        f"{episodes['profile_id'].nunique()} held-out profiles × "
        f"{episodes['driver_id'].nunique()} drivers"
    )


def _headline(page: Page, episodes: pd.DataFrame) -> None:
    sure = (
        "Intervals of savings are 95 % intervals of a bootstrap that resamples held-out windows "
        "(with all drivers, the same for both sides) and training seeds (of each side on its own); "
        "other intervals are over seeds only."
    )
    if episodes["training_seed"].nunique() < 2:
        sure += (
            " Every controller was trained with one seed only: intervals are over windows, and "
            "single seeds differ by about as much as the controllers do."
        )
    text = (
        "alcc saves energy for itself and for the human driver behind; reference is the same "
        "without regard for the driver behind; own_energy is reference whose own energy counts "
        "as often as alcc's reward has terms of energy: what it saves is due to that weight, not "
        "to regard for others; idm is one human driver in the car's place, human are drivers of "
        "the population in that place, without noise of their own; direct is the human driver "
        "directly behind the leader, without the car.\n\n"
        f"All meet the same {size(episodes)} with the same noise. Energies are means per episode, "
        "over all seeds; savings are positive where energy is saved. Path energy is what the "
        "speeds driven take and accelerating loses; energy as drawn (the paper's) also counts what "
        "the last speed stores more than the first, and so rewards ending slower than one began. "
        f"{sure}" + "".join(f"\n\nWarning: {line}." for line in leader_too_fast(episodes))
    )
    drawn = [
        (
            "distributions",
            "Counterpart of Fig. 11: path energy of controlled car and human driver by strategy; a "
            "driver's value is its mean over profiles and seeds.",
            figures.distributions(episodes),
        )
    ]
    path = page.folder / "evaluation" / "steps.parquet"
    steps = read_parquet(path) if path.exists() else pd.DataFrame({"strategy": []})
    if (steps["strategy"] == "alcc").any():
        caption = "Counterpart of Fig. 7: one held-out episode of alcc, first seed."
        drawn.append(("sample_episode", caption, run_figures.sample_episode(steps, "alcc")))
    shown = [
        ("headline", f"Energy of both saved, {size(episodes)}", tables.headline(episodes)),
        ("energies", f"Energy per episode, {size(episodes)}", tables.energies(episodes)),
    ]
    if set(LEADER) <= set(episodes):
        caption = "Path energy saved in thirds of the windows, by the leader's energy and speed"
        shown.append(("strata", caption, tables.strata(episodes)))
    page.add("At a glance", text, shown, drawn)


def _constraints(page: Page, episodes: pd.DataFrame) -> None:
    text = (
        "The study asks for no collision in any episode, time with TTC < 4 s of at most 0.1 %, "
        "and time with a time gap > 2.5 s of at most 1 %, for every seed. Columns: unsafe TTC is "
        "the share of time with TTC < 4 s, long time gap that with a time gap > 2.5 s, also only "
        "above 1 m/s, where it is not a matter of a few metres in a jam; no least TTC means that "
        "the car never closed in."
    )
    shown = [
        ("constraints", f"All episodes, {size(episodes)}", tables.constraints(episodes)),
        ("constraints_by_seed", "Every seed", tables.constraints_by_seed(episodes)),
    ]
    page.add("Safety and efficiency", text, shown)


def _awareness(page: Page, episodes: pd.DataFrame) -> None:
    text = (
        "The paper's main claim: regard for the driver behind saves energy in total, alcc against "
        "reference. The paper shows one profile and 923 drivers, energy as drawn. Its reference is "
        f"weak: the car draws {PAPER_TABLE_IV['mean', 'reference'][0]} kJ, where a human driver "
        f"behind the same leader draws {PAPER_HUMAN['B']} kJ (Fig. 9)."
    )
    beside = f"Table IV beside this study ({size(episodes)})"
    shown = [
        ("table_iv", beside, paper_tables.table_iv(episodes)),
        ("holistic", "Saving per driver", paper_tables.holistic(episodes)),
    ]
    caption = (
        "Counterpart of Fig. 10: path energy of both vehicles, and its saving, with every driver "
        "behind, mean over profiles and seeds."
    )
    figure = run_figures.paired_improvement(episodes, "alcc", "reference")
    heading = "Does regard for the driver behind pay?"
    page.add(heading, text, shown, [("improvement", caption, figure)])


def _generalization(page: Page, episodes: pd.DataFrame) -> None:
    text = (
        "The paper tries its controller on four profiles it was not trained on. Here every profile "
        "is held out: no recording is in both training and evaluation. A percentage of a profile's "
        "small energy as drawn, as in a jam, says little; together is the saving of all profiles' "
        "energy."
    )
    caption = "Saving of alcc against reference over profiles, beside the paper's 4"
    table = paper_tables.generalization(episodes)
    shown = [
        ("generalization_row", caption, paper_tables.generalization_row(episodes)),
        ("generalization", "Every held-out profile", table),
    ]
    caption = "Counterpart of Fig. 12: energies and saving on every held-out profile."
    figure = figures.generalization_figure(episodes)
    page.add("Generalization", text, shown, [("generalization", caption, figure)])


def _human(page: Page, episodes: pd.DataFrame) -> None:
    text = (
        "Scenario A: the human driver follows a controlled car. Scenario B: the same driver "
        "directly follows the leader. In A the driver is one place further back, so part of the "
        "saving comes from the place and not from the controller: the rows idm and human show how "
        "much a human in the car's place saves."
    )
    table = paper_tables.human_energy(episodes)
    drawn = [
        (
            f"human_energy_{name}",
            f"Counterpart of Fig. 9: human driver's path energy behind {name}, and the saving of "
            "every driver, mean over profiles and seeds.",
            run_figures.human_energy(episodes, name),
        )
        for name in ("alcc", "reference")
        if (episodes["strategy"] == name).any()
    ]
    shown = [("human_energy", f"Human driver's energy, {size(episodes)}", table)]
    page.add("Human driver's energy, with and without the car", text, shown, drawn)
