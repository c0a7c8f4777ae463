"""Tables and figures of the ALCC study from its parquet files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from lcc_rl import results
from lcc_rl.errors import ResultsError
from lcc_rl.evaluation.named import TUNED
from lcc_rl.figures import evaluation as run_figures
from lcc_rl.figures.calibration import calibration_figure, joint_figure
from lcc_rl.figures.training import learning_curve
from lcc_rl.io.files import read_parquet
from lcc_rl.results.names import in_words
from lcc_rl.results.runs import EPISODES, STEPS
from lcc_rl.results.windows import LEADER_COLUMNS, WINDOWS, Means
from lcc_rl.studies.alcc import figures, paper_tables, tables
from lcc_rl.studies.alcc.paper_tables import PAIR
from lcc_rl.studies.alcc.study import ABLATIONS, DRIVERS_FILE, EVALUATION_FOLDER
from lcc_rl.studies.study import StudyResults

ALCC_TITLE = "Adaptive Leading Cruise Control: the study"
CURVES = "training.parquet"  # learning curves of the main trainings, if their folders are missing
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
    if (study.folder / CURVES).exists():
        training = read_parquet(study.folder / CURVES)
    elif any((study.folder / "train").rglob("training.parquet")):
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
