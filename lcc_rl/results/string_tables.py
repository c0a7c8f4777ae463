"""Tables of the platoon study, from the rows of episodes.parquet (HCFS Tables IV–VI)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from rich.table import Table

from lcc_rl.errors import unknown_name
from lcc_rl.results import intervals
from lcc_rl.results.tables import strategies_side_by_side

COUNTS = ("switches", "clamps", "cap_interventions")


def case_table(episodes: pd.DataFrame, case: str) -> pd.DataFrame:
    """Summarise every strategy in one case, with the columns of the paper's Tables IV–VI.

    Args:
        episodes: rows of one or more evaluations, one per strategy, run and follower.
        case: name of the case; of ``"windows"`` the sums are means over the windows.

    Returns:
        One row per strategy, sums over all followers and frames: Σ|e_v(i,0)| and its standard
        deviation over them [m/s], Σ|jerk| likewise [m/s³], Σ reward; smallest gap [m], vehicles
        that touched the one ahead, peak jerk, worst ratio of speed-error energy from vehicle to
        vehicle, share of frames driven by the learned policy, switches and interventions. Of
        several trainings the mean over seeds, of the reward with its 95 % interval; extremes and
        collisions are those of all seeds.

    Raises:
        ConfigError: if there is no such case.
    """
    if case not in set(episodes["case"]):
        raise unknown_name("case", case, set(episodes["case"]))
    rows = episodes[episodes["case"] == case]
    return pd.DataFrame(
        [_row(str(name), group) for name, group in rows.groupby("strategy", sort=False)]
    )


def _row(strategy: str, rows: pd.DataFrame) -> dict[str, object]:
    # A group of a single training has no seed.
    seeds = rows["training_seed"].fillna(-1)
    runs = rows.groupby(seeds)["run_id"].nunique()

    def per_run(column: str) -> pd.Series:
        return rows.groupby(seeds)[column].sum() / runs

    frames = rows["frames"].sum()
    row: dict[str, object] = {"strategy": strategy, "trainings": len(runs)}
    for name, label in (("speed_error", "mps"), ("jerk", "mps3")):
        mean = rows[f"{name}_sum"].sum() / frames
        spread = rows[f"{name}_squares"].sum() / frames - mean**2
        row[f"{name}_sum_{label}"] = per_run(f"{name}_sum").mean()
        row[f"{name}_std_{label}"] = float(np.sqrt(max(spread, 0.0)))
    row |= intervals.mean(per_run("reward")).columns("reward")
    row["min_gap_m"] = rows["min_gap_m"].min()
    row["collisions"] = int(rows["collided"].sum())
    row["peak_jerk_mps3"] = rows["peak_jerk_mps3"].max()
    row["string_ratio"] = rows["energy_ratio"].max()
    hybrid = "learned_share" in rows and rows["learned_share"].notna().any()
    row["learned_share"] = rows["learned_share"].mean() if hybrid else np.nan
    for name in COUNTS:
        row[name] = per_run(name).mean() if hybrid else np.nan
    return row


def rewards(episodes: pd.DataFrame, strategy: str, case: str) -> pd.DataFrame:
    """Return Σ reward of every run, ``[runs × seeds]``; one column where nothing was learned."""
    rows = episodes[(episodes["strategy"] == strategy) & (episodes["case"] == case)]
    return rows.assign(training_seed=rows["training_seed"].fillna(-1)).pivot_table(
        index="profile", columns="training_seed", values="reward", aggfunc="sum"
    )


def win_rates(
    episodes: pd.DataFrame,
    of: str = "hcfs",
    against: Sequence[str] | None = None,
    case: str = "windows",
) -> pd.DataFrame:
    """Compare a strategy with others on the same windows.

    Args:
        episodes: rows of one or more evaluations.
        of: the strategy.
        against: those it is compared with; all others by default.
        case: where.

    Returns:
        One row per other strategy: share of the windows in which ``of`` earns more (a tie counts
        half) and the mean difference of Σ reward, each per seed and then averaged, with the 95 %
        interval over seeds. Learned parents are compared seed by seed.
    """
    own = rewards(episodes, of, case)
    names = [n for n in dict.fromkeys(episodes["strategy"]) if n != of]
    rows = []
    for name in names if against is None else against:
        other = rewards(episodes, name, case)
        if len(other.columns) == 1:
            other = pd.concat([other.iloc[:, 0]] * len(own.columns), axis=1, keys=own.columns)
        shared = own.columns.intersection(other.columns)
        difference = own[shared] - other[shared]
        wins = (difference > 1e-6) + 0.5 * (difference.abs() <= 1e-6)
        rows.append(
            {
                "strategy": of,
                "against": name,
                "trainings": len(shared),
                "windows": len(difference),
                **intervals.mean(wins.mean()).columns("wins_pct", 100.0),
                **intervals.mean(difference.mean()).columns("reward_gain"),
            }
        )
    return pd.DataFrame(rows)


ROWS = (
    ("Σ|e_v| [m/s]", "speed_error_sum_mps", "{:.2f}"),
    ("std |e_v| [m/s]", "speed_error_std_mps", "{:.3f}"),
    ("Σ|jerk| [m/s³]", "jerk_sum_mps3", "{:.1f}"),
    ("std |jerk| [m/s³]", "jerk_std_mps3", "{:.2f}"),
    ("Σ reward", "reward", "{:.2f}"),
    ("smallest gap [m]", "min_gap_m", "{:.2f}"),
    ("collisions", "collisions", "{:.0f}"),
    ("peak |jerk| [m/s³]", "peak_jerk_mps3", "{:.1f}"),
    ("string ratio, worst", "string_ratio", "{:.2f}"),
    ("share of DDPG", "learned_share", "{:.0%}"),
    ("switches", "switches", "{:.1f}"),
    ("jerk clamps", "clamps", "{:.1f}"),
    ("safe-cap interventions", "cap_interventions", "{:.1f}"),
)


def as_rich(table: pd.DataFrame, title: str) -> Table:
    """Draw a case's table for the terminal, a column per strategy."""
    caption = "sums over followers and frames, means over runs"
    return strategies_side_by_side(table, ROWS, title, caption)
