"""Study room: the HCFS study as tables, figures and one page, from its parquet files alone."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import torch

from lcc_rl.errors import ResultsError
from lcc_rl.functional.cacc import PlatoonReward
from lcc_rl.io.files import read_parquet
from lcc_rl.results import string_figures as platoon_figures
from lcc_rl.results.figures import learning_curve
from lcc_rl.results.report import made, write_report
from lcc_rl.results.runs import CONFIG
from lcc_rl.results.string_tables import case_table, win_rates
from lcc_rl.studies.alcc.report import Page
from lcc_rl.studies.hcfs.study import LEARNED, YARDSTICKS
from lcc_rl.studies.runner import read_notes

TITLE = "Hybrid Car-Following Strategy: the study"
# What the paper prints in Table IV (case 1): Σ|e_v|, its std, Σ|jerk|, Σ reward.
TABLE_IV = {
    "CACC": (159.39, 0.22, 720.06, -59.70),
    "DDPG": (146.22, 0.16, 2344.60, -56.81),
    "HCFS": (25.26, 0.04, 192.19, -9.64),
}
CASES = {"case 1": "Table IV", "case 2": "Table V", "case 3": "Table VI"}
PARENTS = ("cacc tuned", "cacc paper_like", "cacc path", LEARNED)
BOUNDS = ("deadbeat", "hcfs oracle", "deadbeat oracle")


def write_results(folder: str | Path) -> Path:
    """Write tables/*.parquet, figures/*.png and report.html from a study's parquet files alone.

    Args:
        folder: a folder as ``tools/reproduce.py hcfs`` leaves it.

    Returns:
        The page's path.

    Raises:
        ResultsError: if there is no evaluation in the folder, or a file cannot be read.
    """
    page = Page(Path(folder))
    episodes = read_evaluations(page.folder, "episodes")
    _headline(page, episodes)
    for case in (name for name in dict.fromkeys(episodes["case"]) if name in CASES):
        _case(page, episodes, case)
    _windows(page, episodes)
    _learning(page)
    _weights(page)
    configs = [
        (str(path.parent.relative_to(page.folder)), path.read_text())
        for path in sorted((page.folder / "evaluation").glob(f"seed_*/{CONFIG}"))[:1]
    ]
    commands = read_notes(page.folder).get("commands", [])
    page.sections.append(made(commands, configs, page.folder.rglob("training.parquet")))
    return write_report(page.folder, TITLE, page.sections)


def read_evaluations(folder: Path, table: str) -> pd.DataFrame:
    """Read one table of the yardsticks and of every seed.

    Raises:
        ResultsError: if there is none, or one cannot be read.
    """
    root = folder / "evaluation"
    seeds = sorted(root.glob(f"seed_*/{table}.parquet"), key=lambda p: int(p.parent.name[5:]))
    paths = [root / YARDSTICKS / f"{table}.parquet", *seeds]
    if not seeds:
        raise ResultsError(f"{folder}: no evaluation; python tools/reproduce.py hcfs makes it")
    return pd.concat([read_parquet(path) for path in paths], ignore_index=True)


def _headline(page: Page, episodes: pd.DataFrame) -> None:
    table = win_rates(episodes, "hcfs", (*PARENTS, *BOUNDS))
    untuned = win_rates(episodes, "hcfs untuned", (*PARENTS, "hcfs"))
    windows = int(table["windows"].max())
    best = max(PARENTS[:1] + PARENTS[-1:], key=lambda name: _mean_reward(episodes, name))
    own, other = _mean_reward(episodes, "hcfs"), _mean_reward(episodes, best)
    text = f"""The paper reports that HCFS beats both its parents six times over in case 1.
        On {windows} held-out windows of cycles never trained on, with {_trainings(episodes)}
        trainings of the DDPG parent, HCFS with the tuned CACC earns {own:.2f} a window on average;
        the better of its two parents, {best}, earns {other:.2f}. The share of windows in which HCFS
        earns more than each is below; a tie counts half. Intervals are over trainings.

        Dead-beat control without any learning, which simply takes the leader's speed predicted from
        its present acceleration, bounds what a causal controller can be expected to earn; the
        oracle knows the leader's next speed."""
    page.add(
        "What comes out",
        text,
        [
            page.table("win_rates", "HCFS (rule: CACC tuned) against every other", table),
            page.table("win_rates_untuned", "HCFS with the under-damped CACC", untuned),
        ],
    )


def _mean_reward(episodes: pd.DataFrame, strategy: str) -> float:
    table = case_table(episodes, "windows").set_index("strategy")
    return float(table["reward"][strategy])


def _trainings(episodes: pd.DataFrame) -> int:
    return int(episodes["training_seed"].nunique())


def _case(page: Page, episodes: pd.DataFrame, case: str) -> None:
    stem, table = case.replace(" ", "_"), case_table(episodes, case)
    steps = read_evaluations(page.folder, "steps")
    # Figures show the first training.
    steps = steps.drop_duplicates(["strategy", "case", "time_s", "follower"])
    followers = int(steps[steps["case"] == case]["follower"].max())
    tables = [page.table(stem, f"{case} ({CASES[case]} of the paper)", table)]
    if case == "case 1":
        columns = ["strategy", "speed_error_sum", "speed_error_std", "jerk_sum", "reward"]
        printed = pd.DataFrame([(n, *v) for n, v in TABLE_IV.items()], columns=columns)
        tables.append(page.table("table_iv", "Table IV as printed, on another record", printed))
    drawn = [
        page.figure(
            f"{stem}_velocities", f"{case}: speeds", platoon_figures.velocities(steps, case)
        ),
        page.figure(
            f"{stem}_jerk", f"{case}: jerk and its bound", platoon_figures.jerks(steps, case, 30.0)
        ),
    ]
    drawn += [
        page.figure(
            f"{stem}_switching_{name.replace(' ', '_')}",
            f"{case}: who drives, {name}",
            platoon_figures.switching(steps, case, name),
        )
        for name in ("hcfs", "hcfs oracle")
    ]
    text = f"""{followers} followers, 20 s. Sums run over all followers and frames, means over
        trainings where there are several. The record is not the paper's, which is unpublished."""
    page.add(case, text, tables, drawn)


def _windows(page: Page, episodes: pd.DataFrame) -> None:
    tables = [page.table("windows", "Held-out windows: means", case_table(episodes, "windows"))]
    if "full length" in set(episodes["case"]):
        table = case_table(episodes, "full length")
        tables.append(page.table("full_length", "A whole record, first training", table))
    literal = episodes[episodes["strategy"] == "hcfs literal"]
    short = literal[literal["case"] != "full length"]["peak_jerk_mps3"].max()
    whole = literal["peak_jerk_mps3"].max()
    text = f"""Every window of 20 s of the held-out records in which the leader changes its
        speed by at least 2 m/s in total, six followers each; and one record from end to end. The
        string ratio is the energy of the speed error to the predecessor over that of the vehicle
        ahead, the worst of all; above 1 a disturbance grows along the string.

        The literal rule has neither the clamp to the jerk bound of 10 m/s³ nor the safe cap. Its
        peak jerk is {short:.1f} m/s³ in cases and windows and {whole:.1f} m/s³ anywhere; a random
        actor in the place of DDPG violates the bound at every turn, as the tests show."""
    page.add("Held-out windows and a whole record", text, tables)


def _learning(page: Page) -> None:
    paths = sorted((page.folder / LEARNED).glob("seed_*/training.parquet"))
    frames = [
        read_parquet(path).assign(variant=LEARNED, seed=int(path.parent.name[5:])) for path in paths
    ]
    if frames:
        figure = page.figure(
            "learning_curve", "Learning curve", learning_curve(pd.concat(frames, ignore_index=True))
        )
        page.add("Training of the DDPG parent", "", [], [figure])


def _weights(page: Page) -> None:
    reward = PlatoonReward()
    rows = [
        (name, error, jerk, printed, float(reward(torch.tensor(error), torch.tensor(jerk))))
        for name, (error, _, jerk, printed) in TABLE_IV.items()
    ]
    columns = ["strategy", "speed_error_sum", "jerk_sum", "reward_printed", "reward_computed"]
    text = """The weights of the reward are not printed. Table IV determines them: the sums of
        errors and jerks printed there give its sums of reward within 0.1."""
    table = page.table(
        "weights", "Σ reward from Σ|e_v| and Σ|jerk|", pd.DataFrame(rows, columns=columns)
    )
    page.add("Weights of the reward", text, [table])
