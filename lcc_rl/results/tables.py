"""Tables of energies, savings and safety per strategy, from the rows of episodes.parquet."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pandas as pd
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from lcc_rl.results.intervals import Estimate, saving, share_saved

KEYS = ["profile_id", "driver_id"]
LOST, PATH = "total_acceleration_loss_kj", "total_path_energy_kj"
BASELINES = ("idm", "reference")
HUMANS = ("direct", "idm")  # not trained: one value, known exactly
FASTER = "share_leader_faster"
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
SHOWN = CAR_COLUMNS[-5:]  # as means
HUMAN_COLUMNS = ("hdv_energy_kj", "hdv_net_energy_kj", "hdv_distance_m")


def paired(episodes: pd.DataFrame, column: str) -> pd.DataFrame:
    """Return a column per strategy and a row per (profile, driver), the mean over seeds."""
    return episodes.pivot_table(index=KEYS, columns="strategy", values=column, aggfunc="mean")


def by_driver(episodes: pd.DataFrame, column: str) -> pd.DataFrame:
    """Return a column per strategy and a row per driver, the mean over profiles and seeds."""
    return paired(episodes, column).groupby("driver_id").mean()


def driver_savings(episodes: pd.DataFrame, column: str, strategy: str, baseline: str) -> pd.Series:
    """Return the share of a baseline's mean energy that a strategy saves, by driver."""
    energy = by_driver(episodes, column)
    return share_saved(energy[strategy], energy[baseline])


def per_seed(episodes: pd.DataFrame, column: str) -> dict[str, pd.Series]:
    """Return, for each strategy, the mean of a column over the episodes of each training seed."""
    found = {}
    for strategy, rows in episodes.groupby("strategy", sort=False):
        values = rows.groupby("training_seed", dropna=False)[column].mean()
        if values.notna().any():
            found[str(strategy)] = values
    return found


def savings(episodes: pd.DataFrame, column: str, strategy: str, baseline: str) -> Estimate:
    """Return the share of a strategy's mean energy saved against a baseline."""
    values = per_seed(episodes, column)
    if strategy not in values or baseline not in values:
        return Estimate(np.nan, np.nan, np.nan)
    return saving(values[strategy], values[baseline], exact=baseline in HUMANS)


def summary(episodes: pd.DataFrame) -> pd.DataFrame:
    """Summarise every strategy.

    Args:
        episodes: rows of one or more evaluations on the same profiles and drivers.

    Returns:
        One row per strategy: mean energies [kJ] and energy per kilometre, savings against the
        baselines ``idm`` and ``reference`` as shares, positive where energy is saved, share of
        drivers worse off, and the safety measures; missing where a strategy has none.
    """
    # A string without automated vehicles, or without others, has no energies of them.
    lacking = [column for column in (*CAR_COLUMNS, *HUMAN_COLUMNS) if column not in episodes]
    episodes = episodes.assign(**dict.fromkeys(lacking, float("nan")))
    total, net = paired(episodes, "total_energy_kj"), paired(episodes, "total_net_energy_kj")
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
            row |= _against(total, net, str(strategy), baseline)
        row["collisions"] = int(group["collided"].sum())
        row["min_ttc_s"] = group["min_ttc_s"].min()
        for column in SHOWN:
            row[column] = group[column].mean()
        rows.append(row)
    return pd.DataFrame(rows)


def _against(
    total: pd.DataFrame, net: pd.DataFrame, strategy: str, baseline: str
) -> dict[str, float]:
    """Savings of a strategy over a baseline, paired by profile and driver."""
    names = [f"saving_vs_{baseline}", f"net_saving_vs_{baseline}", f"worse_than_{baseline}"]
    if not {strategy, baseline} <= set(total.columns) or strategy == baseline:
        return dict.fromkeys(names, float("nan"))
    shares = [share_saved(x[strategy].mean(), x[baseline].mean()) for x in (total, net)]
    drivers = total.groupby("driver_id")[[strategy, baseline]].mean()
    worse = float((drivers[strategy] > drivers[baseline]).mean())
    return dict(zip(names, (*shares, worse), strict=True))


ROWS = (
    ("CAV energy [kJ]", "cav_energy_kj", "{:.1f}"),
    ("HDV energy [kJ]", "hdv_energy_kj", "{:.1f}"),
    ("total energy [kJ]", "total_energy_kj", "{:.1f}"),
    ("  net of kinetic energy [kJ]", "total_net_energy_kj", "{:.1f}"),
    ("  path energy [kJ]", PATH, "{:.1f}"),
    ("  of it lost to accelerating [kJ]", LOST, "{:.1f}"),
    ("  per vehicle-kilometre [kJ/km]", "kj_per_km", "{:.0f}"),
    ("saving against idm", "saving_vs_idm", "{:+.1%}"),
    ("  net of kinetic energy", "net_saving_vs_idm", "{:+.1%}"),
    ("  drivers worse off", "worse_than_idm", "{:.0%}"),
    ("saving against reference", "saving_vs_reference", "{:+.1%}"),
    ("  net of kinetic energy", "net_saving_vs_reference", "{:+.1%}"),
    ("  drivers worse off", "worse_than_reference", "{:.0%}"),
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
        "direct": "drivers=fixed drivers.desired_speed=45, or drivers calibrated on such traffic",
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
    caption = "energies: mean per episode; direct: no controlled car"
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
        console = Console(width=max(console.measure(table).maximum, console.width))
    console.print(table)
