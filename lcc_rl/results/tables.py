"""Tables of energies, savings and safety per strategy, from the rows of episodes.parquet."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pandas as pd
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from lcc_rl.results.savings import (
    BASELINES,
    KINDS,
    NOTHING,
    paired,
    per_window,
    savings,
    worse_off,
)

LOST, PATH = "total_acceleration_loss_kj", "total_path_energy_kj"
FASTER = "share_leader_faster"
WIDEST = 10_000  # characters
MOSTLY = 0.2  # share of time; drivers of I-80 behind its own leaders have 0.02, of the stream 0.06

CAR_COLUMNS = (
    *(f"{v}_{kind}" for v in ("cav", "total") for kind in ("energy_kj", "net_energy_kj")),
    LOST,
    PATH,
    "cav_distance_m",
    "min_ttc_s",
    "share_ttc_unsafe",
    "share_ttc_unpromised",
    "share_time_gap_long",
    "share_time_gap_long_moving",
    "rms_jerk_mps3",
    FASTER,
)
SHOWN = CAR_COLUMNS[CAR_COLUMNS.index("share_ttc_unsafe") :]  # as means
HUMAN_COLUMNS = ("hdv_energy_kj", "hdv_net_energy_kj", "hdv_distance_m")


def summary(episodes: pd.DataFrame) -> pd.DataFrame:
    """Summarise every strategy.

    Args:
        episodes: rows of one or more evaluations on the same profiles and drivers.

    Returns:
        One row per strategy: mean energies [kJ] and energy per kilometre, savings against each of
        :data:`BASELINES` as shares, positive where energy is saved, that of the path energy with
        its interval; shares of (window, driver) pairs and of drivers whose path takes more; and
        the safety measures; missing where a strategy has none.
    """
    # A string without automated vehicles, or without others, has no energies of them.
    lacking = [column for column in (*CAR_COLUMNS, *HUMAN_COLUMNS) if column not in episodes]
    episodes = episodes.assign(**dict.fromkeys(lacking, float("nan")))
    windows = per_window(episodes, [f"total_{column}" for column in KINDS.values()])
    path = paired(episodes, PATH)
    rows = []
    for strategy, group in episodes.groupby("strategy", sort=False):
        row: dict[str, object] = {"strategy": strategy, "episodes": len(group)}
        for vehicle in ("cav", "hdv", "total"):
            for kind in ("energy_kj", "net_energy_kj"):
                row[f"{vehicle}_{kind}"] = group[f"{vehicle}_{kind}"].mean()
        row |= {name: group[name].mean() for name in (PATH, LOST)}
        kilometres = group[["cav_distance_m", "hdv_distance_m"]].sum().sum() / 1e3
        energy = group["total_energy_kj"].fillna(group["hdv_energy_kj"])
        row["kj_per_km"] = energy.sum() / kilometres
        for baseline in BASELINES:
            row |= _against(windows, path, str(strategy), baseline)
        row["collisions"] = int(group["collided"].sum())
        row["min_ttc_s"] = group["min_ttc_s"].min()
        for column in SHOWN:
            row[column] = group[column].mean()
        rows.append(row)
    return pd.DataFrame(rows)


def _against(
    windows: pd.DataFrame, path: pd.DataFrame, strategy: str, baseline: str
) -> dict[str, float]:
    """Savings of a strategy over a baseline, paired by window and driver."""
    row: dict[str, float] = {}
    for kind, column in KINDS.items():
        known = strategy != baseline
        found = savings(windows, f"total_{column}", strategy, baseline) if known else NOTHING
        row |= found.columns(f"{kind}saving_vs_{baseline}")
    worse = worse_off(path, strategy, baseline)
    return row | {f"{name}_worse_than_{baseline}": share for name, share in worse.items()}


def _rows_against(baseline: str) -> tuple[tuple[str, str, str], ...]:
    name = f"saving_vs_{baseline}"
    return (
        (f"path energy saved against {baseline}", f"path_{name}", "{:+.1%}"),
        ("  95 % interval, low", f"path_{name}_low", "{:+.1%}"),
        ("    high", f"path_{name}_high", "{:+.1%}"),
        ("  energy as drawn", name, "{:+.1%}"),
        ("  pairs worse off", f"pairs_worse_than_{baseline}", "{:.0%}"),
        ("  drivers worse off", f"drivers_worse_than_{baseline}", "{:.0%}"),
    )


ROWS = (
    ("path energy [kJ]", PATH, "{:.1f}"),
    ("  lost to accelerating [kJ]", LOST, "{:.1f}"),
    ("energy as drawn [kJ]", "total_energy_kj", "{:.1f}"),
    ("  CAV [kJ]", "cav_energy_kj", "{:.1f}"),
    ("  HDV [kJ]", "hdv_energy_kj", "{:.1f}"),
    ("  per vehicle and km [kJ]", "kj_per_km", "{:.0f}"),
    *(row for baseline in BASELINES for row in _rows_against(baseline)),
    ("collisions", "collisions", "{:d}"),
    ("minimum time-to-collision [s]", "min_ttc_s", "{:.2f}"),
    ("time with TTC < 4 s", "share_ttc_unsafe", "{:.2%}"),
    ("  of it outside the filter's promise", "share_ttc_unpromised", "{:.2%}"),
    ("time with time gap > 2.5 s", "share_time_gap_long", "{:.2%}"),
    ("  above 1 m/s", "share_time_gap_long_moving", "{:.2%}"),
    ("RMS jerk [m/s³]", "rms_jerk_mps3", "{:.2f}"),
    ("time with a leader faster than v0", FASTER, "{:.1%}"),
    ("episodes", "episodes", "{:d}"),
)


def leader_too_fast(episodes: pd.DataFrame) -> list[str]:
    """Return a warning for every human baseline whose desired speed the leaders mostly exceed.

    A driver who would not keep up with the leader by choice drops back, whoever drives ahead:
    energies then compare distances, not ways of driving.

    Args:
        episodes: rows of an evaluation.
    """
    if FASTER not in episodes:
        return []
    remedies = {
        "direct": "drivers=highway, or drivers calibrated on such traffic",
        "idm": "variant=idm scenario.controllers.automated.desired_speed=45 'compare=[<run>]'",
    }
    shares = episodes.groupby("strategy")[FASTER].mean()
    return [
        f"the leaders drive faster than the desired speed of {name} for {shares[name]:.0%} of the "
        f"time (more than {MOSTLY:.0%}): savings against it mean little. Raise v0: {remedy}"
        for name, remedy in remedies.items()
        if shares.get(name, 0.0) > MOSTLY
    ]


def as_rich(table: pd.DataFrame, title: str) -> Table:
    """Return a summary as a table for the terminal, a column per strategy."""
    caption = (
        "energies: mean per episode; direct: no controlled car; path energy: without what the "
        "motion stores; intervals: over held-out windows and training seeds; pairs: of a window "
        "and a driver"
    )
    return strategies_side_by_side(table, ROWS, title, caption)


def strategies_side_by_side(
    table: pd.DataFrame, rows: Iterable[tuple[str, str, str]], title: str, caption: str
) -> Table:
    """Return a table for the terminal with a column per strategy.

    Args:
        table: one row per strategy, named in the column ``strategy``.
        rows: label, column of ``table`` and number format of what is shown, in order; columns
            without any value are left out.
        title: above the table.
        caption: below it.
    """
    drawn = Table(title=escape(title), caption=caption)
    drawn.add_column("")
    for strategy in table["strategy"]:
        drawn.add_column(str(strategy), justify="right")
    for label, key, form in rows:
        if table[key].notna().any():
            known = np.isfinite(table[key].astype(float))
            cells = (form.format(x) if k else "–" for x, k in zip(table[key], known, strict=True))
            drawn.add_row(escape(label), *cells)
    return drawn


def show(table: Table) -> None:
    """Print a table, as wide as the terminal or, without one, as its content."""
    console = Console()
    if not console.is_terminal:
        wide = Console(width=WIDEST).measure(table).maximum  # a console measures within its width
        console = Console(width=max(wide, console.width))
    console.print(table)
