"""Figures of the ALCC study, with the numbers of their counterparts in the paper."""

from __future__ import annotations

import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcc_rl.functional.power import motor_power
from lcc_rl.results.drawing import in_words, legend_above, new_figure
from lcc_rl.results.figures import colour, style
from lcc_rl.results.savings import by_driver, savings
from lcc_rl.results.training_figures import draw_curve
from lcc_rl.studies.alcc.comparison_figures import INK, SOFT, whiskers
from lcc_rl.studies.alcc.paper_tables import PAPER_GENERALIZATION, generalization

TERMS = {
    "episode_reward": "total reward",
    "reward_safety": "safety (TTC)",
    "reward_efficiency": "efficiency (time gap)",
    "reward_cav_energy": "CAV energy",
    "reward_hdv_energy": "HDV energy",
    "reward_collision": "collision",
}


def power_map() -> Figure:
    """Electric power of the motor over speed and acceleration (A2; Fig. 2)."""
    speed, acceleration = np.linspace(0.0, 30.0, 151), np.linspace(-3.0, 3.0, 121)
    power = motor_power(torch.tensor(speed), torch.tensor(acceleration)[:, None]).numpy() / 1e3
    figure = new_figure(6.6, 4.2)
    axis = figure.subplots()
    limit = float(np.abs(power).max())
    mesh = axis.pcolormesh(
        speed, acceleration, power, cmap="RdBu_r", vmin=-limit, vmax=limit, rasterized=True
    )
    levels = [-150, -100, -50, -20, 0, 20, 50, 100, 150, 200]
    lines = axis.contour(speed, acceleration, power, levels, colors=INK, linewidths=0.7)
    axis.clabel(lines, fmt="%d kW", fontsize=8)
    figure.colorbar(mesh, label="electric power [kW]; below zero: recuperation")
    style(axis, "speed [m/s]", "acceleration [m/s²]")
    return figure


def reward_terms(training: pd.DataFrame) -> Figure:
    """Learning curves of every reward term (no counterpart; Fig. 6 shows their sum).

    Args:
        training: rows of training.parquet of one or more runs, with ``variant`` and ``seed``.
    """
    shown = {name: label for name, label in TERMS.items() if name in training}
    columns = 3
    lines = -(-len(shown) // columns)
    figure = new_figure(10.0, 0.5 + 2.7 * lines)
    axes = np.atleast_1d(figure.subplots(lines, columns, sharex=True)).ravel()
    labels: dict[str, str] = {}
    for axis, (name, label) in zip(axes, shown.items(), strict=False):
        floor, top = 0.0, 0.0
        for variant, rows in training.groupby("variant", sort=False):
            if rows[name].isna().all():
                continue
            line, labels[str(variant)] = draw_curve(axis, rows, name, str(variant))
            floor = min(floor, float(line.iloc[len(line) // 5 :].min()))
            top = max(top, float(line.max()))
        # The first, random episodes would set the scale.
        axis.set_ylim(1.5 * floor - 0.2, top + 0.05 * (top - floor) + 0.05)
        style(axis, "", "")
        axis.set_title(label, fontsize=10)
    for axis in axes[len(shown) :]:
        axis.remove()
    handles = [axes[0].plot([], [], color=colour(v), label=text)[0] for v, text in labels.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=2, frameon=False, fontsize=9)
    figure.supxlabel("training episodes", fontsize=10)
    figure.supylabel("sum per episode", fontsize=10)
    return figure


def distributions(episodes: pd.DataFrame) -> Figure:
    """Path energy of the CAV and of the HDV over drivers, by strategy (Fig. 11).

    A driver's value is its mean over the held-out profiles and seeds. Boxes span the quartiles,
    whiskers the 5th to 95th percentile; a diamond marks the mean.
    """
    names = list(dict.fromkeys(episodes["strategy"]))
    figure = new_figure(9.0, 0.9 + 0.62 * len(names))
    axes = figure.subplots(1, 2)
    titles = {"cav": "controlled car (CAV)", "hdv": "human driver (HDV)"}
    for axis, vehicle in zip(axes, ("cav", "hdv"), strict=True):
        energy = by_driver(episodes, f"{vehicle}_path_energy_kj")
        for place, name in enumerate(names):
            if name in energy:
                _flat_box(axis, energy[name].to_numpy(float), place, colour(name))
        labels = [in_words(name) if vehicle == "cav" else "" for name in names]
        axis.set_yticks(range(len(names)), labels)
        axis.set_ylim(len(names) - 0.4, -0.6)
        axis.margins(x=0.12)
        style(axis, "path energy [kJ per episode]", "")
        axis.set_title(f"{titles[vehicle]}, n = {len(energy)} drivers", fontsize=10)
    note = "box: quartiles; whiskers: 5th to 95th percentile; diamond and number: mean"
    figure.supxlabel(note, fontsize=8, color=SOFT)
    return figure


def _flat_box(axis: Axes, values: np.ndarray, place: int, hue: str) -> None:
    """Draw a horizontal box with its mean beside it."""
    lowest, low, median, high, highest = np.percentile(values, [5, 25, 50, 75, 95])
    axis.hlines(place, lowest, highest, color=hue, lw=1.2)
    axis.barh(place, high - low, 0.5, low, color=hue, alpha=0.35, edgecolor=hue)
    axis.vlines(median, place - 0.25, place + 0.25, color=hue, lw=2.0)
    axis.plot(values.mean(), place, marker="D", color=INK, markersize=4)
    axis.annotate(
        f"{values.mean():.1f}",
        (values.mean(), place),
        xytext=(0, 13),
        textcoords="offset points",
        ha="center",
        fontsize=8,
    )


def generalization_figure(
    episodes: pd.DataFrame, strategy: str = "alcc", baseline: str = "reference"
) -> Figure:
    """Path energy of both vehicles on every held-out profile, and its saving (Fig. 12)."""
    table = generalization(episodes, strategy, baseline).sort_values("path_saving_pct")
    figure = new_figure(9.0, 6.5)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 3))
    _energies_by_profile(above, episodes, table["profile_id"].tolist(), (baseline, strategy))
    values, places = table["path_saving_pct"].to_numpy(float), np.arange(len(table))
    whiskers(below, places, table, "path_saving_pct", colour(strategy), upright=True)
    below.plot(places, values, "o", color=colour(strategy), label=_label(episodes, strategy))
    beyond = len(table) + 1.0 + np.arange(len(PAPER_GENERALIZATION))
    label = "paper, 4 profiles, energy as drawn"
    below.plot(beyond, PAPER_GENERALIZATION, "s", mfc="none", color=INK, label=label)
    below.axhline(0.0, color=INK, lw=0.8)
    together = 100 * savings(episodes, "total_path_energy_kj", strategy, baseline).value
    line = f"all profiles together {together:+.1f} %"
    below.axhline(together, color=colour(strategy), lw=0.8, ls="--", label=line)
    _cut_outliers(below, places, values)
    below.set_xticks([])
    style(
        below,
        f"held-out profiles, sorted by the saving (n = {len(table)}); right: the paper's",
        f"path energy saved by {in_words(strategy)}\nagainst {in_words(baseline)} [%]",
    )
    legend_above(below)
    return figure


def _energies_by_profile(
    axis: Axes, episodes: pd.DataFrame, order: list[object], names: tuple[str, str]
) -> None:
    """Draw the path energy of car and human driver on every profile under two strategies."""
    places = np.arange(len(order))
    for name, offset in zip(names, (-0.21, 0.21), strict=True):
        columns = [f"{vehicle}_path_energy_kj" for vehicle in ("cav", "hdv")]
        rows = episodes[episodes["strategy"] == name].groupby("profile_id")[columns].mean()
        car, human = (rows.loc[order, column].to_numpy(float) for column in columns)
        axis.bar(places + offset, car, 0.4, color=colour(name), label=f"{in_words(name)}: car")
        label = f"{in_words(name)}: human driver"
        axis.bar(places + offset, human, 0.4, car, color=colour(name), alpha=0.45, label=label)
    legend_above(axis, 4)
    style(axis, "", "path energy\n[kJ per episode]")


def _cut_outliers(axis: Axes, places: np.ndarray, values: np.ndarray) -> None:
    """Scale an axis by most of its values, and write the outliers at its border."""
    limit = 2.0 * max(float(np.percentile(np.abs(values), 85)), max(PAPER_GENERALIZATION))
    axis.set_ylim(-limit, limit)
    for place, value in zip(places, values, strict=True):
        if abs(value) > limit:
            up = value > 0
            axis.annotate(
                f"{value:+.0f} % {'▲' if up else '▼'}",
                (place, limit if up else -limit),
                xytext=(-4, 0),
                textcoords="offset points",
                ha="right",
                va="top" if up else "bottom",
                fontsize=8,
            )


def _label(episodes: pd.DataFrame, strategy: str) -> str:
    seeds = episodes.loc[episodes["strategy"] == strategy, "training_seed"].nunique()
    if seeds > 1:
        return f"this study, mean of {seeds} seeds, 95 % interval"
    return "this study, 1 seed (no interval)"
