"""The page of the HCFS study: tables and figures from the study's parquet files alone."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from lcc_rl.errors import ResultsError
from lcc_rl.io.files import read_parquet
from lcc_rl.results import string_figures
from lcc_rl.results.runs import CONFIG
from lcc_rl.results.string_tables import case_table
from lcc_rl.results.training_figures import learning_curve
from lcc_rl.studies.hcfs.study import BASELINES, LEARNED
from lcc_rl.studies.hcfs.tables import printed, weights, win_rates
from lcc_rl.studies.page import Page

TITLE = "Hybrid Car-Following Strategy: the study"
CASES = {"case 1": "Table IV", "case 2": "Table V", "case 3": "Table VI"}
PARENTS = ("cacc tuned", "cacc paper_like", "cacc path", LEARNED)
BOUNDS = ("deadbeat", "hcfs oracle", "deadbeat oracle")


def write_results(folder: str | Path, formats: Iterable[str] = ()) -> Path:
    """Write tables/*.parquet, figures/*.png and report.html from a study's parquet files alone.

    Args:
        folder: a study's folder, written by ``lcc-rl reproduce hcfs``.
        formats: further formats of the figures.

    Returns:
        The page's path.

    Raises:
        ResultsError: if there is no evaluation in the folder, or a file cannot be read.
    """
    page = Page(folder, formats)
    episodes = read_evaluations(page.folder, "episodes")
    _headline(page, episodes)
    for case in (name for name in dict.fromkeys(episodes["case"]) if name in CASES):
        _case(page, episodes, case)
    _windows(page, episodes)
    _learning(page)
    text = """The weights of the reward are not printed. Table IV determines them: the sums of
        errors and jerks printed there give its sums of reward within 0.1."""
    table = ("weights", "Σ reward from Σ|e_v| and Σ|jerk|", weights())
    page.add("Weights of the reward", text, [table])
    configs = [
        (str(path.parent.relative_to(page.folder)), path.read_text())
        for path in sorted((page.folder / "evaluation").glob(f"seed_*/{CONFIG}"))[:1]
    ]
    return page.write(TITLE, configs)


def read_evaluations(folder: Path, table: str) -> pd.DataFrame:
    """Read one table of the baselines and of every seed.

    Raises:
        ResultsError: if there is none, or one cannot be read.
    """
    root = folder / "evaluation"
    seeds = sorted(root.glob(f"seed_*/{table}.parquet"), key=lambda p: int(p.parent.name[5:]))
    paths = [root / BASELINES / f"{table}.parquet", *seeds]
    if not seeds:
        raise ResultsError(f"{folder}: no evaluation; lcc-rl reproduce hcfs makes it")
    return pd.concat([read_parquet(path) for path in paths], ignore_index=True)


def _headline(page: Page, episodes: pd.DataFrame) -> None:
    table = win_rates(episodes, "hcfs", (*PARENTS, *BOUNDS))
    untuned = win_rates(episodes, "hcfs untuned", (*PARENTS, "hcfs"))
    windows = int(table["windows"].max())
    seeds = episodes["training_seed"].nunique()
    reward = case_table(episodes, "windows").set_index("strategy")["reward"]
    best = max((PARENTS[0], LEARNED), key=lambda name: float(reward[name]))
    text = f"""The paper reports that HCFS beats both its parents six times over in case 1.
        On {windows} held-out windows of cycles never trained on, with {seeds} trainings of the DDPG
        parent, HCFS with the tuned CACC earns {reward["hcfs"]:.2f} a window on average; the better
        of its two parents, {best}, earns {reward[best]:.2f}. The share of windows in which HCFS
        earns more than each is below; a tie counts half. Intervals are over trainings.

        Dead-beat control without any learning, which simply takes the leader's speed predicted from
        its present acceleration, bounds what a causal controller can be expected to earn; the
        oracle knows the leader's next speed."""
    tables = [
        ("win_rates", "HCFS (rule: CACC tuned) against every other", table),
        ("win_rates_untuned", "HCFS with the under-damped CACC", untuned),
    ]
    page.add("What comes out", text, tables)


def _case(page: Page, episodes: pd.DataFrame, case: str) -> None:
    stem, table = case.replace(" ", "_"), case_table(episodes, case)
    steps = read_evaluations(page.folder, "steps")
    # Figures show the first training.
    steps = steps.drop_duplicates(["strategy", "case", "time_s", "follower"])
    followers = int(steps[steps["case"] == case]["follower"].max())
    tables = [(stem, f"{case} ({CASES[case]} of the paper)", table)]
    if case == "case 1":
        tables.append(("table_iv", "Table IV as printed, on another record", printed()))
    speeds, jerks = string_figures.velocities(steps, case), string_figures.jerks(steps, case, 30.0)
    drawn = [
        (f"{stem}_velocities", f"{case}: speeds", speeds),
        (f"{stem}_jerk", f"{case}: jerk and its bound", jerks),
    ]
    for name in ("hcfs", "hcfs oracle"):
        figure = string_figures.switching(steps, case, name)
        stem_of = f"{stem}_switching_{name.replace(' ', '_')}"
        drawn.append((stem_of, f"{case}: who drives, {name}", figure))
    text = f"""{followers} followers, 20 s. Sums run over all followers and frames, means over
        trainings where there are several. The record is not the paper's, which is unpublished."""
    page.add(case, text, tables, drawn)


def _windows(page: Page, episodes: pd.DataFrame) -> None:
    tables = [("windows", "Held-out windows: means", case_table(episodes, "windows"))]
    if "full length" in set(episodes["case"]):
        table = case_table(episodes, "full length")
        tables.append(("full_length", "A whole record, first training", table))
    literal = episodes[episodes["strategy"] == "hcfs literal"]
    text = """Every window of 20 s of the held-out records in which the leader changes its
        speed by at least 2 m/s in total, six followers each; and one record from end to end. The
        string ratio is the energy of the speed error to the predecessor over that of the vehicle
        ahead, the worst of all; above 1 a disturbance grows along the string."""
    text += "" if literal.empty else f"\n\n{_literal_rule(literal)}"
    page.add("Held-out windows and a whole record", text, tables)


def _literal_rule(rows: pd.DataFrame) -> str:
    """Describe the peak jerk of the literal rule."""
    short = rows[rows["case"] != "full length"]["peak_jerk_mps3"].max()
    whole = rows["peak_jerk_mps3"].max()
    return f"""The literal rule has neither the clamp to the jerk bound of 10 m/s³ nor the safe cap.
        Its peak jerk is {short:.1f} m/s³ in cases and windows and {whole:.1f} m/s³ anywhere; a
        random actor in the place of DDPG violates the bound at every turn, as the tests show."""


def _learning(page: Page) -> None:
    paths = sorted((page.folder / LEARNED).glob("seed_*/training.parquet"))
    frames = [
        read_parquet(path).assign(variant=LEARNED, seed=int(path.parent.name[5:])) for path in paths
    ]
    if frames:
        figure = learning_curve(pd.concat(frames, ignore_index=True))
        drawn = [("learning_curve", "Learning curve", figure)]
        page.add("Training of the DDPG parent", "", figures=drawn)
