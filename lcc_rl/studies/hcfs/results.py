"""Tables and figures of the HCFS study from its parquet files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from lcc_rl.evaluation.cases import WINDOW_CASES
from lcc_rl.figures import platoon
from lcc_rl.figures.training import learning_curve
from lcc_rl.io.files import read_parquet
from lcc_rl.results.platoons import case_table
from lcc_rl.results.runs import EPISODES, STEPS
from lcc_rl.studies.hcfs import tables
from lcc_rl.studies.hcfs.study import TRAINING
from lcc_rl.studies.hcfs.tables import LEARNED
from lcc_rl.studies.study import StudyResults

LENGTHS = "lengths.parquet"  # rows of windows of studies with several lengths of training
SOURCES_FILE = "sources.parquet"  # rows of windows of other sources of leaders
HCFS_TITLE = "Hybrid Car-Following Strategy: the study"
# The paper's table and figures of each case: speeds, jerk, and the controller in use.
CASES = {
    "case 1": ("Table IV", 4, 5, 6),
    "case 2": ("Table V", 7, 8, 9),
    "case 3": ("Table VI", 10, 11, 12),
}
CACC_ROWS = ("cacc path", "cacc paper_like", "cacc tuned")
HYBRID_ROWS = ("hcfs", "hcfs oracle", "hcfs untuned")
PARENT_ROWS = ("cacc tuned", LEARNED)
STRATEGIES = (*CACC_ROWS, LEARNED, *HYBRID_ROWS, "deadbeat")
IN_CASES = ("cacc paper_like", "cacc tuned", LEARNED, "hcfs", "hcfs untuned", "deadbeat")
WHOLE_ROWS = ("cacc tuned", LEARNED, "hcfs", "hcfs literal", "deadbeat")


def study_results(folder: Path, formats: Iterable[str] = ()) -> StudyResults:
    """Write tables/*.parquet, figures/*.png and results.md from a study's parquet files.

    Args:
        folder: folder of ``lcc-rl reproduce hcfs`` with episodes.parquet, steps.parquet and
            training.parquet.
        formats: further formats of the figures.

    Raises:
        ResultsError: if a table is missing or cannot be read.
    """
    study = StudyResults(folder, formats)
    episodes, steps = (read_parquet(folder / name) for name in (EPISODES, STEPS))
    _windows(study, episodes)
    for case in CASES:
        _case(study, episodes, steps, case)
    study.table("table_iv", "Table IV as printed, on another record", tables.printed())
    study.table("weights", "Σ reward from Σ|e_v| and Σ|jerk| of Table IV", tables.weight_table())
    totals = tables.whole_records(episodes, WHOLE_ROWS)
    study.table("whole", "Σ reward over whole records (range of the trainings)", totals)
    gains = tables.whole_gains(episodes, PARENT_ROWS)
    study.table("whole_gains", "HCFS against its parents over whole records", gains)
    if (folder / SOURCES_FILE).exists():  # only with evaluations on other leaders
        runs = read_parquet(folder / SOURCES_FILE)
        shown = tables.sources(runs, ("cacc tuned", "hcfs", "hcfs first"))
        study.table("sources", "Windows of other sources of leaders", shown)
        study.table("sources_in_full", "The same for all strategies", tables.sources(runs))
    if (folder / LENGTHS).exists():  # only with several studies
        lengths = tables.lengths(read_parquet(folder / LENGTHS))
        study.table("lengths", "Σ reward per window by the length of the training", lengths)
    curve = learning_curve(read_parquet(folder / TRAINING))
    study.figure("learning_curve", "Learning curve of the DDPG parent", curve)
    study.write(HCFS_TITLE)
    return study


def _windows(study: StudyResults, episodes: pd.DataFrame) -> None:
    rivals = [name for name in STRATEGIES if name != "hcfs"]
    gained = tables.win_rates(episodes, "hcfs", [*rivals, "deadbeat oracle"])
    untuned = tables.win_rates(episodes, "hcfs untuned", ["cacc paper_like", LEARNED, "hcfs"])
    cases = tables.over_cases(episodes, tuple(CASES), IN_CASES)
    study.table("windows", "Σ reward per window", tables.windows(episodes, STRATEGIES))
    study.table("win_rates", "HCFS (rule: CACC tuned) against every other", gained)
    study.table("win_rates_untuned", "HCFS with the CACC of Table IV", untuned)
    study.table("windows_in_full", "Held-out windows: means", case_table(episodes, WINDOW_CASES))
    study.table("cases", "Σ reward in the cases of the paper", cases)


def _case(study: StudyResults, episodes: pd.DataFrame, steps: pd.DataFrame, case: str) -> None:
    stem, (table, speeds, jerk, use) = case.replace(" ", "_"), CASES[case]
    study.table(stem, f"{case} ({table} of the paper)", case_table(episodes, case))
    pictures = {
        ("velocities", f"speeds (Fig. {speeds})"): platoon.velocities(steps, case),
        ("jerk", f"jerk and its bound (Fig. {jerk})"): platoon.jerks(steps, case, 30.0),
        ("switching_hcfs", f"controller in use, hcfs (Fig. {use})"): platoon.switching(steps, case),
        ("switching_hcfs_oracle", "controller in use, hcfs oracle"): platoon.switching(
            steps, case, "hcfs oracle"
        ),
    }
    for (name, caption), figure in pictures.items():
        study.figure(f"{stem}_{name}", f"{case}: {caption}", figure)
