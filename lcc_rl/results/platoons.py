"""Tables of tracking error, jerk and reward of a platoon."""

from __future__ import annotations

import numpy as np
import pandas as pd

from lcc_rl.errors import require_known
from lcc_rl.results import intervals
from lcc_rl.results.measures import COUNT, Measure, Shown
from lcc_rl.results.names import with_drivers
from lcc_rl.results.report import ALL, Report, shortened

PER_RUN = ("switches", "clamps", "cap_interventions")


def case_table(episodes: pd.DataFrame, case: str) -> pd.DataFrame:
    """Summarise every strategy in one case, with the columns of Tables IV–VI of the HCFS paper.

    Args:
        episodes: rows of one or more evaluations, one per strategy, run and follower.
        case: name of the case; for ``"windows"`` sums are means over the windows.

    Returns:
        One row per strategy. Means over seeds of sums over automated followers and steps:
        Σ|e_v(i,0)| and its standard deviation [m/s], Σ|jerk| and its standard deviation [m/s³],
        Σ reward with its 95 % interval over seeds, switches and interventions. Over all seeds:
        smallest gap, largest gap error as received [m], collided vehicles, peak jerk [m/s³], worst
        error ratio and the share of steps of the learned policy.

    Raises:
        ConfigError: if there is no such case.
    """
    require_known("case", case, set(episodes["case"]))
    rows = episodes[episodes["case"] == case]
    return pd.DataFrame(
        [_row(str(name), group) for name, group in rows.groupby("strategy", sort=False)]
    )


def _row(strategy: str, rows: pd.DataFrame) -> dict[str, object]:
    seeds = rows["training_seed"].fillna(-1)  # without training there is no seed
    runs = rows.groupby(seeds)["run_id"].nunique()

    def per_run(column: str) -> pd.Series:
        return rows.groupby(seeds)[column].sum() / runs

    frames = rows["frames"][rows["jerk_sum"].notna()].sum()
    row: dict[str, object] = {"strategy": strategy, "seeds": rows["training_seed"].nunique()}
    for name, label in (("speed_error", "mps"), ("jerk", "mps3")):
        mean = rows[f"{name}_sum"].sum() / frames
        spread = rows[f"{name}_squares"].sum() / frames - mean**2
        row[f"{name}_sum_{label}"] = per_run(f"{name}_sum").mean()
        row[f"{name}_std_{label}"] = float(np.sqrt(max(spread, 0.0)))
    row |= intervals.mean(per_run("reward")).columns("reward")
    rows = rows.assign(episodes=1.0)
    row |= {one.key: one.value(rows) for one in PLATOON if one.key not in row}
    hybrid = "learned_share" in rows and rows["learned_share"].notna().any()
    return row | {name: per_run(name).mean() if hybrid else np.nan for name in PER_RUN}


PLATOON = [
    Measure("speed_error_sum_mps", "Σ|e_v|", unit="m/s", short="Σ|e_v|\n[m/s]"),
    Measure("speed_error_std_mps", "std |e_v|", unit="m/s", form="{:.3f}"),
    Measure("jerk_sum_mps3", "Σ|jerk|", unit="m/s³", form="{:.1f}", short="Σ|jerk|\n[m/s³]"),
    Measure("jerk_std_mps3", "std |jerk|", unit="m/s³"),
    Measure("reward", "Σ reward", short="Σ reward"),
    Measure("min_gap_m", "smallest gap", unit="m", aggregate="min", short="least\ngap [m]"),
    Measure("max_gap_error_m", "largest gap error, as received", unit="m", aggregate="max"),
    Measure(
        "error_ratio",
        "error ratio, worst",
        of="energy_ratio",
        aggregate="max",
        short="error\nratio",
    ),
    Measure(
        "collisions",
        "collisions",
        form=COUNT,
        of="collided",
        aggregate="sum",
        short="colli-\nsions",
    ),
    Measure("peak_jerk_mps3", "peak |jerk|", unit="m/s³", form="{:.1f}", aggregate="max"),
    Measure("learned_share", "share of DDPG", form="{:.0%}"),
    Measure("switches", "switches", form="{:.1f}"),
    Measure("clamps", "jerk clamps", form="{:.1f}"),
    Measure("cap_interventions", "safe-cap interventions", form="{:.1f}"),
]
BELOW = "sums over automated followers and frames, means over runs; collisions: cars in all runs"


def case_report(rows: pd.DataFrame, case: str, of: str) -> Report:
    """Return the report of a case of a platoon, from rows of episodes.parquet."""
    table = with_drivers(case_table(rows, case)).astype({"collisions": int})
    shown = [Shown(one.key, one.short) for one in PLATOON if one.short]
    short = shortened(table, shown)
    caption = f"{BELOW}; {ALL}"
    return Report(of, table, *short, PLATOON, caption, BELOW)
