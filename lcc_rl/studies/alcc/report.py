"""The page of the ALCC study: tables and figures from the study's parquet files alone."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from lcc_rl import results
from lcc_rl.errors import ResultsError
from lcc_rl.figures import evaluation as run_figures
from lcc_rl.figures.calibration import calibration_figure, joint_figure
from lcc_rl.figures.page import Page
from lcc_rl.figures.training import learning_curve
from lcc_rl.io.files import read_parquet
from lcc_rl.results.headline import few_windows
from lcc_rl.results.means import WINDOWS, Means
from lcc_rl.results.names import in_words
from lcc_rl.results.runs import CONFIG, EPISODES
from lcc_rl.results.savings import LEADER
from lcc_rl.results.tables import leader_too_fast
from lcc_rl.studies.alcc import figures, paper_tables, tables
from lcc_rl.studies.alcc.paper_tables import PAPER_HUMAN, PAPER_TABLE_IV
from lcc_rl.studies.alcc.study import ABLATIONS
from lcc_rl.studies.runner import read_notes

TITLE = "Adaptive Leading Cruise Control: the study"
MAIN = Path("evaluation")
CURVES = "training.parquet"  # learning curves of the main trainings, if these are not there
SHARES = [
    f"{which}_{name}"
    for name in ("unsafe_ttc_pct", tables.LONG)
    for which in ("mean", "worst_seed")
]
TUNED = ("idm_acc", "acc")
ITSELF = "this study"
BOTH = {"alcc", "reference"}


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
    if not any(map(_finished, page.folder.glob("**/evaluation"))):
        raise ResultsError(f"{folder}: no evaluation/{EPISODES}; lcc-rl reproduce alcc makes it")
    main = Means.read(page.folder / MAIN) if _finished(page.folder / MAIN) else None
    if main is None and target is not None:
        raise ResultsError(f"{folder}: {target} shows the main part, which is not there")
    if main is not None:
        add_main(page, main)
    _learning(page)
    _ablations(page, main)
    _people(page)
    if target is not None:
        page.tables |= _narrow(page.tables)
        page.fill(target)
    return _made(page)


def _narrow(shown: dict[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """Return tables that fit the width of a page of the documentation, by name."""
    energies, human, shares = (
        table[~table.iloc[:, 0].isin(TUNED)]
        for table in (shown["energies"], shown["human_energy"], shown["constraints"])
    )
    human = human[human["energy"] == paper_tables.NAMES[""]]
    parts = ["strategy", "total_path_energy_kj", "total_path_energy_kj_low"]
    parts += ["total_path_energy_kj_high", "total_energy_kj", *tables.PARTS]
    return {
        "parts": energies.loc[energies["strategy"] != "direct", parts],
        "behind": human.drop(columns=["energy", "least_driver_pct", "most_driver_pct"]),
        "shares": shares[["strategy", "collisions", *SHARES]],
    }


def add_main(page: Page, means: Means) -> None:
    """Add the sections of the main evaluation."""
    windows = means.windows
    _headline(page, means)
    text = """The study asks for no collision in any episode, time with TTC < 4 s of at most 0.1 %,
        and time with a time gap > 2.5 s of at most 1 %, for every seed. Columns: unsafe TTC is the
        share of time with TTC < 4 s, long time gap that with a time gap > 2.5 s, also only above
        1 m/s, where it is not a matter of a few metres in a jam; no least TTC means that the car
        never closed in."""
    shown = [
        ("constraints", f"All episodes, {means.size()}", tables.constraints(windows)),
        ("constraints_by_seed", "Every seed", tables.constraints_by_seed(windows)),
    ]
    page.add("Safety and efficiency", text, shown)
    if set(windows["strategy"]) >= BOTH:
        _awareness(page, means)
        _generalization(page, windows)
    _human(page, means)


def _headline(page: Page, means: Means) -> None:
    windows = means.windows
    text = f"""The network for all (alcc) saves energy for itself and for the human driver behind;
        the network for itself (reference) is the same without regard for the driver behind; the
        weighted network for itself (own_energy) is that one, whose own energy counts as often as
        alcc's reward has terms of energy: what it saves is due to that weight, not to regard for
        others. One driver (idm) is one human in the car's place, simulated drivers (human) are
        those of the population in that place, with the noise of all human drivers; without an
        automated car (direct), the human driver is directly behind the leader.

        All meet the same {means.size()} with the same noise. Energies are means per episode,
        over all seeds; savings are positive where energy is saved. Path energy is what the speeds
        driven take and accelerating loses; energy as drawn (the paper's) also counts what the last
        speed stores more than the first, and so rewards ending slower than one began. Intervals of
        savings are 95 % intervals of a bootstrap that resamples held-out windows (with all drivers,
        the same for both sides) and training seeds (of each side on its own); other intervals are
        over seeds only."""
    if windows["training_seed"].nunique() < 2:
        text += """ Every controller was trained with one seed only: intervals are over windows,
            and single seeds differ by about as much as the controllers do."""
    warnings = [*leader_too_fast(windows), few_windows(windows["profile_id"].nunique())]
    text += "".join(f"\n\nWarning: {line}." for line in warnings if line)
    caption = """Counterpart of Fig. 11: path energy of controlled car and human driver by strategy;
        a driver's value is its mean over profiles and seeds."""
    drawn = [("distributions", caption, figures.distributions(means.drivers))]
    path = page.folder / "evaluation" / "steps.parquet"
    steps = read_parquet(path) if path.exists() else pd.DataFrame({"strategy": []})
    if (steps["strategy"] == "alcc").any():
        caption = "Counterpart of Fig. 7: one held-out episode of the network for all, first seed."
        drawn.append(("sample_episode", caption, run_figures.sample_episode(steps, "alcc")))
    shown = [
        ("headline", f"Energy of both saved, {means.size()}", tables.headline(windows)),
        ("energies", f"Energy per episode, {means.size()}", tables.energies(windows)),
    ]
    if set(LEADER) <= set(windows):
        caption = "Path energy saved in thirds of the windows, by the leader's energy and speed"
        shown.append(("strata", caption, tables.strata(windows)))
    page.add("At a glance", text, shown, drawn)


def _awareness(page: Page, means: Means) -> None:
    text = f"""The paper's main claim: regard for the driver behind saves energy in total, alcc
        against reference. The paper shows one profile and 923 drivers, energy as drawn. Its
        reference is weak: the car draws {PAPER_TABLE_IV["mean", "reference"][0]} kJ, where a human
        driver behind the same leader draws {PAPER_HUMAN["scenario_B_kj"]} kJ (Fig. 9)."""
    beside = f"Table IV beside this study ({means.size()})"
    shown = [
        ("table_iv", beside, paper_tables.table_iv(means.drivers)),
        ("holistic", "Saving per driver", paper_tables.holistic(means)),
    ]
    caption = """Counterpart of Fig. 10: path energy of both vehicles, and its saving, with every
        driver behind, mean over profiles and seeds."""
    figure = run_figures.paired_improvement(means, "alcc", "reference")
    heading = "Does regard for the driver behind pay?"
    page.add(heading, text, shown, [("improvement", caption, figure)])


def _generalization(page: Page, windows: pd.DataFrame) -> None:
    text = """The paper tries its controller on four profiles it was not trained on. Here every
        profile is held out: no recording is in both training and evaluation. A percentage of a
        profile's small energy as drawn, as in a jam, says little; together is the saving of all
        profiles' energy."""
    caption = "Saving of alcc against reference over profiles, beside the paper's 4"
    shown = [
        ("generalization_row", caption, paper_tables.generalization_row(windows)),
        ("generalization", "Every held-out window", paper_tables.generalization(windows)),
    ]
    caption = "Counterpart of Fig. 12: energies and saving on every held-out window."
    figure = figures.generalization_figure(windows)
    page.add("Generalization", text, shown, [("generalization", caption, figure)])


def _human(page: Page, means: Means) -> None:
    text = """Scenario A: the human driver follows a controlled car. Scenario B: the same driver
        directly follows the leader. In A the driver is one place further back, so part of the
        saving comes from the place and not from the controller: the rows of one driver and of
        simulated drivers show how much a human in the car's place saves."""
    table = paper_tables.human_energy(means)
    caption = """Counterpart of Fig. 9: human driver's path energy behind {}, and the saving of
        every driver, mean over profiles and seeds."""
    drawn = [
        (
            f"human_energy_{name}",
            caption.format(in_words(name)),
            run_figures.human_energy(means, name),
        )
        for name in ("alcc", "reference")
        if (means.windows["strategy"] == name).any()
    ]
    shown = [("human_energy", f"Human driver's energy, {means.size()}", table)]
    page.add("Human driver's energy, with and without the car", text, shown, drawn)


def _learning(page: Page) -> None:
    if (page.folder / CURVES).exists():
        training = read_parquet(page.folder / CURVES)
    elif any((page.folder / "train").rglob("training.parquet")):
        training = results.load(page.folder / "train", "training", strict=True)
    else:
        return
    text = """Rewards are sums per episode as played in training, where agents other than analytic
        add noise to their actions, mean over the episodes of a batch. drop: how far the mean of a
        tenth of the training ever falls below the best tenth before it."""
    shown = [("learning", "Learning curves, every seed", tables.learning(training))]
    caption = "Counterpart of Fig. 6: reward per episode over training."
    drawn = [
        ("learning_curve", caption, learning_curve(training)),
        ("reward_terms", "Every reward term over training.", figures.reward_terms(training)),
    ]
    page.add("Learning", text, shown, drawn)


def _ablations(page: Page, main: Means | None) -> None:
    found = {
        path.parent.name: Means.read(path)
        for path in page.folder.glob("ablations/*/evaluation")
        if _finished(path)
    }
    if not found:
        return
    order = [*(name for name in ABLATIONS if name in found), *sorted(found.keys() - ABLATIONS)]
    parts = {ITSELF: main} if main is not None else {}
    parts |= {name: found[name] for name in order}
    windows = pd.concat(
        [means.windows.assign(ablation=name) for name, means in parts.items()], ignore_index=True
    )
    text = """Each line changes the recipe and trains anew; savings are against controllers in the
        same scenario, so that a change of the scenario (no recuperation) is compared with itself.
        Intervals are over windows and seeds. The paper prints a saving of 4.38 % of alcc against
        its reference, energy as drawn (A2)."""
    caption = "Energy, safety and efficiency under each change."
    shown = [
        ("series", "Energy as drawn of both vehicles", tables.series(windows)),
        ("ablations", "Path energy, safety and efficiency", tables.comparison(windows)),
    ]
    drawn = [("ablations", caption, figures.comparison_figure(windows))]
    page.add("Other trainings", text, shown, drawn)


def _people(page: Page) -> None:
    """Add the calibration and the power map."""
    caption = "Counterpart of Fig. 2: the motor's power map (A2)."
    drawn = [("power_map", caption, figures.power_map())]
    path = page.folder / "calibration" / "drivers.parquet"
    text = "The motor's power map is the paper's polynomial."
    if path.exists():
        drivers = read_parquet(path)
        local = drivers[drivers["mode"] == "local"]
        share = local["desired_speed_at_bound"].mean()
        text += f""" Drivers are calibrated on the study's trajectories; one by one, {share:.0%} of
            them reach a bound of the desired speed, which congested traffic does not identify."""
        caption = "Counterpart of Fig. 4: calibration error and parameters."
        drawn.append(("calibration", caption, calibration_figure(drivers)))
        caption = "Counterpart of Fig. 5: joint distribution of desired speed and time gap."
        drawn.append(("joint_distribution", caption, joint_figure(drivers)))
    page.add("Drivers and power", text, figures=drawn)


def _finished(evaluation: Path) -> bool:
    return any((evaluation / name).exists() for name in (WINDOWS, EPISODES))


def _made(page: Page) -> Path:
    """Write the page, with the configurations and problems of the study."""
    notes = read_notes(page.folder)
    problems = notes.get("problems", {})
    listed = "\n".join(f"{name}: {problem}" for name, problem in problems.items())
    details = [("Problems", listed)] if problems else []
    configs = sorted((page.folder / "train").glob(f"*/*/{CONFIG}"))
    firsts = {path.parents[1].name: path for path in reversed(configs)}
    details += [
        (f"Configuration of {name}, {path.parent.name}", path.read_text(encoding="utf-8"))
        for name, path in sorted(firsts.items())
    ]
    seeds = [f"{p.parents[1].name}/{p.parent.name}" for p in configs]
    more = f"\n\nTrainings behind the main part: {', '.join(seeds)}." if seeds else ""
    more += f"\n\n{len(problems)} runs failed or were left out, see below." if problems else ""
    return page.write(TITLE, notes.get("commands", ()), details, more)
