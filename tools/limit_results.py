"""Table, figure and comparison of networks and tuned rules within limits, for compare_agents.py."""

from __future__ import annotations

from itertools import combinations
from math import isfinite
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from lcc_rl import results
from lcc_rl.errors import ResultsError
from lcc_rl.figures.drawing import in_words, legend_above, new_figure, style
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.results.fronts import ENERGY, KINDS, SHARE, energy_at, front, points, saving_at

WINDOWS, EPISODES = "windows.parquet", "episodes.parquet"
MEANS = (
    ENERGY,
    "total_energy_kj",
    "total_acceleration_loss_kj",
    SHARE,
    "share_ttc_unsafe",
    "cav_distance_m",
    "collided",
)
DESCRIBED = ("leader_speed_mps", "leader_path_energy_kj")  # of a window
HUES = {
    "network": "#0072b2",
    "memory": "#56b4e9",
    "preview": "#009e73",
    "idm": "#d55e00",
    "idm_gradient": "#cc79a7",
}
NAMES = {
    "memory": "network with memory",
    "preview": "network with preview",
    "idm": "IDM, by search",
    "idm_gradient": "IDM, by gradient",
}
LINES = {"alcc": "-", "own_energy": "--", "reference": ":"}


def windows_of(folder: Path) -> pd.DataFrame:
    """Return the means over drivers of every training and window, and keep them.

    Without trainings below the folder, those kept there before.

    Raises:
        ResultsError: if there are none.
    """
    parts = []
    for path in sorted(folder.glob(f"*/*/limit_*/seed_*/{EPISODES}")):
        episodes = results.load(path.parent)
        variant, policy, limit = path.relative_to(folder).parts[:3]
        means = episodes.groupby("profile_id", as_index=False)[[*MEANS, *DESCRIBED]].mean()
        means["drivers"] = episodes["driver_id"].nunique()
        means["training_seed"] = int(episodes["seed"].iloc[0])
        share = float(limit.removeprefix("limit_"))
        parts.append(means.assign(variant=variant, policy=policy, limit=share))
    if parts:
        write_parquet(pd.concat(parts, ignore_index=True), folder / WINDOWS)
    if not (folder / WINDOWS).exists():
        raise ResultsError(f"{folder}: no finished training below it, and no {WINDOWS}")
    return read_parquet(folder / WINDOWS)


def table_of_limits(folder: Path) -> pd.DataFrame:
    """Return one row per kind of controller and limit in training."""
    return points(windows_of(folder))[[*KINDS, "limit", "seeds", *MEANS]]


def comparisons(folder: Path, at: float) -> list[str]:
    """Say what each kind of controller saves against those that save less, at the same share."""
    windows = read_parquet(folder / WINDOWS)
    kinds = list(dict.fromkeys(windows[KINDS].itertuples(index=False, name=None)))
    energy = {}
    for kind in kinds:
        used, missed = (x.mean((1, 2)) for x in front(windows, kind))
        energy[kind] = energy_at(used, missed, at)
    kinds = sorted((kind for kind in kinds if isfinite(energy[kind])), key=energy.__getitem__)
    lines = [f"path energy with too long a time gap for at most {at:.1%} of the time above 1 m/s:"]
    for one, other in combinations(kinds, 2):
        found = saving_at(windows, one, other, at)
        words = f"{' '.join(one)} against {' '.join(other)}"
        lines.append(f"  {words}: {found.value:.2%} ({found.low:.2%} … {found.high:.2%})")
    return lines


def figure_of_limits(folder: Path) -> Figure:
    """Path energy over the share of long time gaps: a dot per training, a line per kind."""
    windows = read_parquet(folder / WINDOWS)
    figure = new_figure(6.4, 4.2)
    axes = figure.subplots()
    for kind, rows in windows.groupby(KINDS, sort=False):
        variant, policy = map(str, kind)
        hue, style_of = HUES.get(policy, "#222222"), LINES.get(variant, "-.")
        line = points(rows).sort_values(SHARE)
        name = f"{in_words(variant)}, {NAMES.get(policy, policy)}"
        axes.plot(100.0 * line[SHARE], line[ENERGY], ls=style_of, color=hue, label=name)
        each = rows.groupby(["limit", "training_seed"])[[ENERGY, SHARE]].mean()
        axes.plot(100.0 * each[SHARE], each[ENERGY], ".", color=hue, alpha=0.6)
    legend_above(axes, 2)
    style(axes, "time gap > 2.5 s above 1 m/s [% of the time]", "path energy\n[kJ per episode]")
    return figure
