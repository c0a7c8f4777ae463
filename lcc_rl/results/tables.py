"""Tables of energies, savings and safety per strategy, from the rows of episodes.parquet."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import pandas as pd
from rich.console import Group
from rich.markup import escape
from rich.table import Table

from lcc_rl.io.files import Rows
from lcc_rl.results.names import FILTERED, in_words
from lcc_rl.results.savings import BASELINES, DRIVE, NOTHING, WAYS, Windows
from lcc_rl.results.totals import Totals, frames
from lcc_rl.runs.output import PLAIN

LOST, PATH = "total_acceleration_loss_kj", "total_path_energy_kj"
PER_KM = "path_energy_kj_per_km"  # and vehicle; who falls back gains nothing by it
FASTER = "share_leader_faster"
WIDTH, LEAST = 80, len("automated")  # of all strategies beside each other, and of one
BROKEN = "share_promise_broken"
REACH = ("cav_share_infeasible", "hdv_share_infeasible")
MUCH = 0.01  # share of time beyond the reach of an energy model that tables and log name
MOSTLY = 0.2  # share of time; drivers of I-80 behind its own leaders have 0.02, of the stream 0.06

CAR_COLUMNS = (
    *(f"{v}_{kind}" for v in ("cav", "total") for kind in ("energy_kj", "net_energy_kj")),
    LOST,
    PATH,
    "cav_distance_m",
    "min_ttc_s",
    "share_ttc_unsafe",
    "share_ttc_unpromised",
    "share_turned_unsafe",
    BROKEN,
    "share_filter_acts",
    "share_time_gap_long",
    "share_time_gap_long_moving",
    "rms_jerk_mps3",
    FASTER,
)
SHOWN = CAR_COLUMNS[CAR_COLUMNS.index("share_ttc_unsafe") :]  # as means
HUMAN_COLUMNS = ("hdv_energy_kj", "hdv_net_energy_kj", "hdv_path_energy_kj", "hdv_distance_m")


def summary(episodes: Rows, source: str = "") -> pd.DataFrame:
    """Summarise every strategy.

    Args:
        episodes: rows of one or more evaluations on the same profiles and drivers; one block of a
            dataset is in memory at a time, and strategies are paired within blocks.
        source: of the leaders whose rows count; empty for all.

    Returns:
        One row per strategy: mean energies [kJ] and energy per vehicle and km; savings against
        each of :data:`BASELINES` as shares, positive if energy is saved, with their intervals:
        of path energy per km (``km_saving_vs_…``) and of the energy drawn in an episode
        (``saving_vs_…``); shares of (window, driver) pairs and of drivers whose path takes more
        per km; and the safety measures.
        Values that a strategy does not have are NaN.
    """
    # A string without automated vehicles, or without others, has no energies of them.
    columns = [*CAR_COLUMNS, *HUMAN_COLUMNS, *REACH, "collided"]
    found = Totals(episodes, columns, ["min_ttc_s"], PATH, BASELINES, source)
    windows, every, sums = found.per_window(), found.mean(), found.sums()
    by_window = {"km_": Windows.of(windows, PATH, WAYS), "": Windows.of(windows, "total_energy_kj")}
    rows = []
    kinds = {"windows": "profile_id", "drives": DRIVE, "seeds": "training_seed"}
    drives = windows.get(DRIVE, windows["profile_id"])
    counts = windows.assign(**{DRIVE: drives}).groupby("strategy")[list(kinds.values())].nunique()
    for strategy in found.strategies:
        mean, total = every.loc[strategy].to_dict(), sums.loc[strategy].to_dict()
        row: dict[str, object] = {"strategy": strategy, "episodes": int(total["rows"])}
        row |= {name: int(counts[key][strategy]) for name, key in kinds.items()}
        for vehicle in ("cav", "hdv", "total"):
            for kind in ("energy_kj", "net_energy_kj"):
                row[f"{vehicle}_{kind}"] = mean[f"{vehicle}_{kind}"]
        row |= {name: mean[name] for name in (PATH, LOST)}
        kilometres = (total["cav_distance_m"] + total["hdv_distance_m"]) / 1e3
        whose = "hdv" if np.isnan(mean["total_energy_kj"]) else "total"
        row["kj_per_km"] = total[f"{whose}_energy_kj"] / kilometres if kilometres else np.nan
        row[PER_KM] = total[f"{whose}_path_energy_kj"] / kilometres if kilometres else np.nan
        row["distance_m"] = 1e3 * kilometres / total["rows"]
        for baseline in BASELINES:
            for kind, energy in by_window.items():
                share = energy.saving(strategy, baseline) if strategy != baseline else NOTHING
                row |= share.columns(f"{kind}saving_vs_{baseline}")
            worse = found.worse_off(strategy, baseline)
            row |= {f"{name}_worse_than_{baseline}": share for name, share in worse.items()}
        row["collisions"] = int(total["collided"])
        row["min_ttc_s"] = found.low("min_ttc_s", strategy)
        row |= {column: mean[column] for column in SHOWN}
        row["share_infeasible"] = every.loc[strategy, list(REACH)].max()
        rows.append(row)
    return pd.DataFrame(rows)


def _rows_against(baseline: str) -> tuple[tuple[str, str, str], ...]:
    name = f"saving_vs_{baseline}"
    return (
        (f"saved against {in_words(baseline)}", f"km_{name}", "{:+.1%}"),
        ("  95 % interval, low", f"km_{name}_low", "{:+.1%}"),
        ("    high", f"km_{name}_high", "{:+.1%}"),
        ("  as drawn, per episode", name, "{:+.1%}"),
        ("  pairs worse off", f"pairs_worse_than_{baseline}", "{:.0%}"),
        ("  drivers worse off", f"drivers_worse_than_{baseline}", "{:.0%}"),
    )


ROWS = (
    ("path energy [kJ]", PATH, "{:.1f}"),
    ("  lost to accelerating [kJ]", LOST, "{:.1f}"),
    ("  path energy per vehicle and km [kJ]", PER_KM, "{:.1f}"),
    ("distance of all vehicles [m]", "distance_m", "{:.0f}"),
    ("energy as drawn [kJ]", "total_energy_kj", "{:.1f}"),
    ("  CAV [kJ]", "cav_energy_kj", "{:.1f}"),
    ("  HDV [kJ]", "hdv_energy_kj", "{:.1f}"),
    ("  as drawn, per vehicle and km [kJ]", "kj_per_km", "{:.0f}"),
    *(row for baseline in BASELINES for row in _rows_against(baseline)),
    ("collisions", "collisions", "{:d}"),
    ("minimum time-to-collision [s]", "min_ttc_s", "{:.2f}"),
    ("time with TTC < 4 s", "share_ttc_unsafe", "{:.2%}"),
    ("  of it outside the filter's promise", "share_ttc_unpromised", "{:.2%}"),
    ("steps that turn unsafe", "share_turned_unsafe", "{:.2%}"),
    ("  of them promised by the filter", BROKEN, "{:.2%}"),
    ("time in which the filter acts", "share_filter_acts", "{:.1%}"),
    ("time with time gap > 2.5 s", "share_time_gap_long", "{:.2%}"),
    ("  above 1 m/s", "share_time_gap_long_moving", "{:.2%}"),
    ("RMS jerk [m/s³]", "rms_jerk_mps3", "{:.2f}"),
    ("time with a leader faster than v0", FASTER, "{:.1%}"),
    ("time beyond the energy model's reach", "share_infeasible", "{:.1%}"),
    ("windows", "windows", "{:d}"),
    ("drives", "drives", "{:d}"),
    ("training seeds", "seeds", "{:d}"),
    ("episodes", "episodes", "{:d}"),
)


def remarks(episodes: Rows, source: str = "") -> list[str]:
    """Return sentences on what limits the numbers of an evaluation behind a source's leaders."""
    means, found = _means(episodes, [*REACH, BROKEN], source), []

    def named(shares: pd.Series, least: float) -> str:
        large = shares[shares > least].items()
        return ", ".join(f"{in_words(str(name))} {share:.2%}" for name, share in large)

    if names := named(means[list(REACH)].max(axis=1), MUCH):
        found.append(
            "Vehicles accelerate harder, or hold a higher speed, than their energy model allows "
            f"for more than {MUCH:.0%} of the time ({names}): their energies are lower bounds."
        )
    if names := named(means[BROKEN], 0.0):
        found.append(
            f"Steps turn unsafe though the safety filter promises them ({names}): brakes, delays "
            "or sensors are not as scenario.actuators and scenario.sensors declare."
        )
    return found


def _means(episodes: Rows, columns: Sequence[str], source: str = "") -> pd.DataFrame:
    """Return the means of columns by strategy; NaN where no row has a value."""
    sums, counts = [], []
    for frame in frames(episodes, ["strategy", *columns], source):
        groups = frame.reindex(columns=["strategy", *columns]).groupby("strategy", sort=False)
        sums.append(groups.sum())
        counts.append(groups.count())
    total, count = (pd.concat(x).groupby(level=0, sort=False).sum() for x in (sums, counts))
    return total / count


def leader_too_fast(episodes: Rows, of_task: bool = False) -> list[str]:
    """Return a warning for every driver whose desired speed the leaders mostly exceed.

    Such a driver drops back, whoever drives ahead: energies then compare distances, not ways of
    driving. Behind a safety filter a desired speed means other things; networks have none of
    their own, and the share of the drivers behind them.

    Args:
        episodes: rows of an evaluation.
        of_task: whether a task is evaluated, which chooses the strategies to compare.
    """
    remedies = {
        "direct": "drivers=highway, or drivers calibrated on such traffic",
        "idm": "variant=idm scenario.controllers.automated.desired_speed=45 'compare=[<run>]'",
    }
    remedies["human"] = remedies["direct"]
    if of_task:
        remedies["idm"] = "compare with human, whose v0 is that of drivers=…"
    shares = _means(episodes, [FASTER])[FASTER]
    people = [shares[name] for name in ("human", "direct") if name in shares]
    for name in shares.index if people else ():
        if not name.endswith(FILTERED) and not np.isclose(shares[name], people).any():
            kind = "lcc_rl.pieces.LinearACC" if name == "acc" else "<its class>"
            option = f"'compare={{faster: {{_target_: {kind}, desired_speed: 45}}}}'"
            remedies.setdefault(name, option)
    return [
        f"the leaders drive faster than the desired speed of {name} for {shares[name]:.0%} of the "
        f"time (more than {MOSTLY:.0%}): savings against it mean little. Raise v0: {remedy}"
        for name, remedy in remedies.items()
        if shares.get(name, 0.0) > MOSTLY
    ]


def strategies_side_by_side(
    table: pd.DataFrame, rows: Iterable[tuple[str, str, str]], title: str, caption: str
) -> Group:
    """Return tables for the terminal with a column per strategy, as many as fit 80 characters.

    Names are wrapped at spaces only.

    Args:
        table: one row per strategy, named in the column ``strategy``.
        rows: label, column of ``table`` and number format, in order; columns without any value
            are left out.
        title: above the table.
        caption: below it.
    """
    rows = [row for row in rows if table[row[1]].notna().any()]
    room = WIDTH - max(len(label) for label, _, _ in rows)
    widths = [1 + _width(name) for name in table["strategy"]]
    starts = [0]
    for place in range(1, len(table)):
        if sum(widths[starts[-1] : place + 1]) > room:
            starts.append(place)
    ends = [*starts[1:], len(table)]
    drawn = [_beside(table.iloc[a:b], rows) for a, b in zip(starts, ends, strict=True)]
    drawn[0].title, drawn[-1].caption = escape(title), escape(caption)
    return Group(*drawn)


def _width(strategy: object) -> int:
    """Return the width of a strategy's column: that of the longest word of its name."""
    return max([LEAST, *map(len, in_words(str(strategy)).split())])


def _beside(table: pd.DataFrame, rows: Sequence[tuple[str, str, str]]) -> Table:
    drawn = Table(**PLAIN)
    drawn.add_column("")
    for strategy in table["strategy"]:
        name = escape(in_words(str(strategy)))
        drawn.add_column(name, justify="right", max_width=_width(strategy), overflow="fold")
    for label, key, form in rows:
        known = np.isfinite(table[key].astype(float))
        cells = (form.format(x) if k else "–" for x, k in zip(table[key], known, strict=True))
        drawn.add_row(escape(label), *(cell.replace("-", "−") for cell in cells))
    return drawn
