"""The page of the HCFS study: tables and figures from the study's parquet files alone."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from lcc_rl.evaluation.cases import WINDOWS
from lcc_rl.figures import platoon
from lcc_rl.figures.page import Page
from lcc_rl.figures.training import learning_curve
from lcc_rl.io.files import read_parquet
from lcc_rl.results.runs import EPISODES, STEPS
from lcc_rl.results.string_tables import case_table
from lcc_rl.studies.hcfs import tables
from lcc_rl.studies.hcfs.study import TRAINING
from lcc_rl.studies.hcfs.tables import LEARNED
from lcc_rl.studies.runner import read_notes

LENGTHS = "lengths.parquet"  # rows of the windows of studies with trainings of several lengths
SOURCES = "sources.parquet"  # rows of the windows of other sources of leaders
TITLE = "Hybrid Car-Following Strategy: the study"
# The paper's table and figures of each case: speeds, jerk, and who drives.
CASES = {
    "case 1": ("Table IV", 4, 5, 6),
    "case 2": ("Table V", 7, 8, 9),
    "case 3": ("Table VI", 10, 11, 12),
}
LIKE = "counterpart of the paper's Fig."
RULES = ("cacc path", "cacc paper_like", "cacc tuned")
HYBRIDS = ("hcfs", "hcfs oracle", "hcfs untuned")
PARENTS = ("cacc tuned", LEARNED)
STRATEGIES = (*RULES, LEARNED, *HYBRIDS, "deadbeat")
IN_CASES = ("cacc paper_like", "cacc tuned", LEARNED, "hcfs", "hcfs untuned", "deadbeat")
WHOLE = ("cacc tuned", LEARNED, "hcfs", "hcfs literal", "deadbeat")


def write_results(
    folder: str | Path, formats: Iterable[str] = (), page: Path | None = None
) -> Path:
    """Write tables/*.parquet, figures/*.png and report.html from a study's parquet files alone.

    Args:
        folder: holds episodes.parquet, steps.parquet and training.parquet, written by
            ``lcc-rl reproduce hcfs``.
        formats: further formats of the figures.
        page: Markdown file whose marked tables are written anew, too.

    Returns:
        The path of report.html.

    Raises:
        ResultsError: if a table is missing or cannot be read.
    """
    made = Page(folder, formats)
    episodes, steps = (read_parquet(made.folder / name) for name in (EPISODES, STEPS))
    _windows(made, episodes)
    for case in CASES:
        _case(made, episodes, steps, case)
    _whole(made, episodes)
    _sources(made)
    _training(made)
    text = """The weights of the reward are not printed. Table IV determines them: the sums of
        errors and jerks printed there give its sums of reward within 0.1."""
    shown = ("weights", "Σ reward from Σ|e_v| and Σ|jerk|", tables.weights())
    made.add("Weights of the reward", text, [shown])
    if page is not None:
        made.fill(page)
    return made.write(TITLE, read_notes(made.folder).get("commands", ()))


def _windows(made: Page, episodes: pd.DataFrame) -> None:
    others = [name for name in STRATEGIES if name != "hcfs"]
    gained = tables.win_rates(episodes, "hcfs", [*others, "deadbeat oracle"])
    seeds = int(gained["trainings"].max())
    text = f"""The paper reports that HCFS beats both its parents six times over in case 1. Here
        are {int(gained["windows"].max())} windows of 20 s of cycles never trained on, in which the
        leader changes its speed by at least 2 m/s in total, with six followers each and {seeds}
        trainings of the DDPG parent. A tie counts as half a win. Intervals are over windows and
        seeds, the seeds of HCFS and of its parent drawn together.

        Dead-beat control learns nothing and takes the leader's speed as predicted from its present
        acceleration; it bounds what a causal controller can be expected to earn. The oracle knows
        the leader's next speed."""
    untuned = tables.win_rates(episodes, "hcfs untuned", ["cacc paper_like", LEARNED, "hcfs"])
    cases = tables.over_cases(episodes, tuple(CASES), IN_CASES)
    listed = [
        ("windows", "Σ reward per window", tables.windows(episodes, STRATEGIES)),
        ("win_rates", "HCFS (rule: CACC tuned) against every other", gained),
        ("win_rates_untuned", "HCFS with the CACC of Table IV", untuned),
        ("windows_in_full", "Held-out windows: means", case_table(episodes, WINDOWS)),
        ("cases", "Σ reward in the cases of the paper", cases),
    ]
    made.add("HCFS against its parents", text, listed)


def _case(made: Page, episodes: pd.DataFrame, steps: pd.DataFrame, case: str) -> None:
    stem, (table, speeds, jerk, who) = case.replace(" ", "_"), CASES[case]
    followers = int(steps[steps["case"] == case]["follower"].max())
    listed = [(stem, f"{case} ({table} of the paper)", case_table(episodes, case))]
    if case == "case 1":
        listed.append(("table_iv", "Table IV as printed, on another record", tables.printed()))
    pictures = {
        ("velocities", f"speeds; {LIKE} {speeds}"): platoon.velocities(steps, case),
        ("jerk", f"jerk and its bound; {LIKE} {jerk}"): platoon.jerks(steps, case, 30.0),
        ("switching_hcfs", f"who drives, hcfs; {LIKE} {who}"): platoon.switching(steps, case),
        ("switching_hcfs_oracle", "who drives, hcfs oracle"): platoon.switching(
            steps, case, "hcfs oracle"
        ),
    }
    drawn = [(f"{stem}_{name}", f"{case}: {x}", figure) for (name, x), figure in pictures.items()]
    text = f"""{followers} followers, 20 s. Sums run over all followers and frames and are means
        over trainings; the figures show the first training. The record is not the paper's, which
        is unpublished."""
    made.add(case, text, listed, drawn)


def _whole(made: Page, episodes: pd.DataFrame) -> None:
    text = """Whole held-out records, six followers. In brackets the least and the most of the
        trainings; gap and string ratio are those of the worst vehicle. The string ratio is the
        energy of the speed error to the predecessor over that of the vehicle ahead: above 1 a
        disturbance grows along the string. The literal rule has neither the clamp to the jerk
        bound of 10 m/s³ nor the safe cap."""
    listed = [
        ("whole", "Σ reward over whole records", tables.whole_records(episodes, WHOLE)),
        ("whole_gains", "HCFS against its parents", tables.whole_gains(episodes, PARENTS)),
    ]
    made.add("Whole records", text, listed)


def _sources(made: Page) -> None:
    if not (made.folder / SOURCES).exists():  # only where platoons drove behind other leaders, too
        return
    text = """HCFS as printed, and as the first vehicle decides for all and broadcasts what it adds
        to CACC."""
    runs, title = read_parquet(made.folder / SOURCES), "Windows of other sources of leaders"
    listed = [
        ("sources", title, tables.sources(runs, ("cacc tuned", "hcfs", "hcfs first"))),
        ("sources_in_full", "All strategies", tables.sources(runs)),
    ]
    made.add("Other leaders", text, listed)


def _training(made: Page) -> None:
    text, listed = "", []
    if (made.folder / LENGTHS).exists():  # only where several studies were put side by side
        text = "The same study with trainings of other lengths; intervals over windows and seeds."
        table = tables.lengths(read_parquet(made.folder / LENGTHS))
        listed.append(("lengths", "Σ reward per window by the length of the training", table))
    curve = learning_curve(read_parquet(made.folder / TRAINING))
    drawn = [("learning_curve", "Learning curve", curve)]
    made.add("Training of the DDPG parent", text, listed, drawn)
