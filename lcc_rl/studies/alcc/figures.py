"""Figures of the ALCC study, numbered as in the paper."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcc_rl.figures.drawing import (
    COLUMN_WIDTH,
    INK,
    PAGE_WIDTH,
    SOFT,
    colour,
    dots,
    footnote,
    legend_above,
    new_figure,
    paper,
    rows_of,
)
from lcc_rl.figures.training import BAND_NOTE, draw_curves
from lcc_rl.functional.power import motor_power
from lcc_rl.results.measures import signed
from lcc_rl.results.names import in_words
from lcc_rl.results.windows import by_driver, savings
from lcc_rl.studies.alcc.paper_tables import (
    BASELINE,
    PAIR,
    PAPER_GENERALIZATION,
    STRATEGY,
    generalization,
)
from lcc_rl.studies.alcc.tables import comparison

REWARD_LABELS = {
    "episode_reward": "total reward",
    "reward_safety": "safety (TTC)",
    "reward_efficiency": "efficiency (time gap)",
    "reward_cav_energy": "energy of the car",
    "reward_hdv_energy": "energy of the human driver",
    "reward_collision": "collision",
}
PANELS = {
    "path_saving_against_idm_pct": ("path energy saved against\none IDM driver [%]", 0.0),
    "unsafe_ttc_pct": ("time with TTC < 4 s [%]", 0.1),
    "long_time_gap_pct": ("time with time gap\n> 2.5 s [%]", 1.0),
}


@paper
def power_map() -> Figure:
    """Draw the electric power of the motor over speed and acceleration (A2; Fig. 2)."""
    speed, acceleration = np.linspace(0.0, 30.0, 151), np.linspace(-3.0, 3.0, 121)
    power = motor_power(torch.tensor(speed), torch.tensor(acceleration)[:, None]).numpy() / 1e3
    figure = new_figure(COLUMN_WIDTH, 2.7)
    axis = figure.subplots()
    limit = float(np.abs(power).max())
    shades = np.linspace(-limit, limit, 61)
    filled = axis.contourf(speed, acceleration, power, shades, cmap="RdBu_r")
    filled.set_edgecolor("face")  # no seams in vector formats
    levels = [-150, -100, -50, -20, 0, 20, 50, 100, 150, 200]
    lines = axis.contour(speed, acceleration, power, levels, colors=INK, linewidths=0.7)
    axis.clabel(lines, fmt=lambda kw: signed(kw, "{:.0f}"), fontsize=6)
    ticks = [-200, -100, 0, 100, 200]
    figure.colorbar(filled, label="electric power [kW]\n(below 0: recuperated)", ticks=ticks)
    axis.set(xlabel="speed [m/s]", ylabel="acceleration [m/s²]")
    return figure


@paper
def reward_terms(training: pd.DataFrame) -> Figure:
    """Draw learning curves of all reward terms (not in the paper; Fig. 6 shows their sum).

    Args:
        training: rows of training.parquet of one or more runs, with ``variant`` and ``seed``.
    """
    shown = {name: label for name, label in REWARD_LABELS.items() if name in training}
    lines = -(-len(shown) // 3)
    figure = new_figure(PAGE_WIDTH, 0.5 + 1.9 * lines)
    axes = figure.subplots(lines, 3, sharex=True, squeeze=False).ravel()
    for axis, (name, label) in zip(axes, shown.items(), strict=False):
        floor, top = draw_curves(axis, training, name)
        axis.set_ylim(1.5 * floor - 0.2, top + 0.05 * (top - floor) + 0.05)
        axis.set_title(label)
    for axis in axes[len(shown) :]:
        axis.remove()
    look: dict[str, Any] = {"loc": "outside upper center", "ncols": 2}
    figure.legend(handles=axes[0].get_lines(), **look)
    figure.supxlabel(f"training episodes\n{BAND_NOTE}", fontsize=8)
    figure.supylabel("sum per episode", fontsize=8)
    return figure


@paper
def distributions(drivers: pd.DataFrame) -> Figure:
    """Draw path energies of CAV and HDV over drivers, by strategy (Fig. 11).

    A driver's value is its mean over held-out windows and seeds. Boxes span the quartiles,
    whiskers the 5th to 95th percentile; a diamond marks the mean.
    """
    names = list(dict.fromkeys(drivers["strategy"]))
    figure = new_figure(PAGE_WIDTH, 0.8 + 0.42 * len(names))
    axes = figure.subplots(1, 2)
    titles = {"cav": "controlled car (CAV)", "hdv": "human driver (HDV)"}
    for axis, (vehicle, title) in zip(axes, titles.items(), strict=True):
        energy = by_driver(drivers, f"{vehicle}_path_energy_kj")
        for row, name in enumerate(names):
            if name in energy:
                _flat_box(axis, energy[name].to_numpy(float), row, colour(name))
        rows_of(axis, names if vehicle == "cav" else [""] * len(names))
        axis.use_sticky_edges = False  # a box may be at the edge
        axis.margins(x=0.12)
        axis.set(xlabel="path energy [kJ per episode]")
        axis.set_title(f"{title}, n = {len(energy)} drivers")
    footnote(figure, "box: quartiles; whiskers: 5th to 95th percentile; diamond and number: mean")
    return figure


def _flat_box(axis: Axes, values: np.ndarray, row: int, hue: str) -> None:
    """Draw a horizontal box with its mean beside it."""
    lowest, low, median, high, highest = np.percentile(values, [5, 25, 50, 75, 95])
    axis.hlines(row, lowest, highest, color=hue)
    axis.barh(row, high - low, 0.5, low, color=hue, alpha=0.35, edgecolor=hue)
    axis.vlines(median, row - 0.25, row + 0.25, color=hue, lw=2.0)
    mean = values.mean()
    above: dict[str, Any] = {"xytext": (0, 8), "textcoords": "offset points"}
    axis.plot(mean, row, marker="D", color=INK, markersize=3)
    axis.annotate(f"{mean:.1f}", (mean, row), ha="center", fontsize=6, **above)


@paper
def generalization_figure(windows: pd.DataFrame) -> Figure:
    """Draw the path energy of both vehicles on all held-out windows, and its saving (Fig. 12)."""
    table = generalization(windows).sort_values("path_saving_pct")
    figure = new_figure(PAGE_WIDTH, 4.4)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 3))
    _energies_by_profile(above, windows, table["profile_id"].tolist(), (BASELINE, STRATEGY))
    values, places = table["path_saving_pct"].to_numpy(float), np.arange(len(table))
    seeds = windows.loc[windows["strategy"] == STRATEGY, "training_seed"].nunique()
    sure = f"mean of {seeds} seeds, 95 % interval" if seeds > 1 else "1 seed (no interval)"
    look: dict[str, Any] = {"upright": True, "ms": 2.5, "label": f"this study, {sure}"}
    dots(below, places, table, "path_saving_pct", colour(STRATEGY), **look)
    beyond = len(table) + 1.0 + np.arange(len(PAPER_GENERALIZATION))
    label = "paper, 4 profiles, energy as drawn"
    below.plot(beyond, PAPER_GENERALIZATION, "s", mfc="none", color=INK, label=label)
    below.axhline(0.0, color=INK, lw=0.8)
    together = 100 * savings(windows, "total_path_energy_kj", *PAIR).value
    line = f"all windows together {signed(together)} %"
    below.axhline(together, color=colour(STRATEGY), lw=0.8, ls="--", label=line)
    _cut_outliers(below, places, values)
    below.set_xticks([])
    text = f"held-out windows, sorted by the saving (n = {len(table)}); right: the paper's"
    saved = f"saved by {in_words(STRATEGY)}\nagainst {in_words(BASELINE)} [%]"
    below.set(xlabel=text, ylabel=saved)
    legend_above(below, 2)
    return figure


def _energies_by_profile(
    axis: Axes, windows: pd.DataFrame, order: list[object], names: tuple[str, str]
) -> None:
    """Draw the path energy of car and human driver on all profiles for two strategies."""
    places = np.arange(len(order))
    columns = ["cav_path_energy_kj", "hdv_path_energy_kj"]
    for name, offset in zip(names, (-0.21, 0.21), strict=True):
        rows = windows[windows["strategy"] == name].groupby("profile_id")[columns].mean()
        car, human = (rows.loc[order, column].to_numpy(float) for column in columns)
        axis.bar(places + offset, car, 0.4, color=colour(name), label=f"{in_words(name)}: car")
        label = f"{in_words(name)}: human driver"
        axis.bar(places + offset, human, 0.4, car, color=colour(name), alpha=0.45, label=label)
    legend_above(axis, 2)
    axis.set_ylabel("path energy\n[kJ per episode]")


def _cut_outliers(axis: Axes, places: np.ndarray, values: np.ndarray) -> None:
    """Scale an axis by most of its values, and label outliers at its border."""
    limit = 2.0 * max(float(np.percentile(np.abs(values), 85)), max(PAPER_GENERALIZATION))
    axis.set_ylim(-limit, limit)
    look: dict[str, Any] = {
        "xytext": (-4, 0),
        "textcoords": "offset points",
        "ha": "right",
        "fontsize": 7,
    }
    for x, value in zip(places, values, strict=True):
        if abs(value) > limit:
            mark, end, side = ("▲", limit, "top") if value > 0 else ("▼", -limit, "bottom")
            axis.annotate(f"{signed(value, '{:+.0f}')} % {mark}", (x, end), va=side, **look)


@paper
def comparison_figure(windows: pd.DataFrame) -> Figure:
    """Draw energy, safety and efficiency for each change of the study (not in the paper).

    Args:
        windows: rows of the evaluations; those of the unchanged study come first.
    """
    table = comparison(windows)
    names, strategies = (list(dict.fromkeys(table[name])) for name in ("ablation", "strategy"))
    figure = new_figure(PAGE_WIDTH, 1.0 + 0.32 * len(names))
    axes = figure.subplots(1, len(PANELS), sharey=True, width_ratios=(2, 1, 1))
    abreast = 0.18 * np.linspace(-1.0, 1.0, len(strategies)) * (len(strategies) > 1)
    for axis, (column, (label, line)) in zip(axes, PANELS.items(), strict=True):
        for strategy, offset in zip(strategies, abreast, strict=True):
            chosen, hue = table[table["strategy"] == strategy], colour(strategy)
            rows = [names.index(name) + offset for name in chosen["ablation"]]
            dots(axis, rows, chosen, column, hue, label=in_words(strategy))
        axis.axvline(line, color=SOFT, lw=0.8, ls="-" if line == 0.0 else "--")
        axis.axhline(0.5, color=SOFT, lw=0.6)
        axis.set_xlabel(label)
        axis.tick_params(axis="y", length=0)
    rows_of(axes[0], [str(name).replace("_", " ") for name in names])
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3)
    counts = sorted({int(count) for count in table["seeds"] if str(count).isdigit()})
    seeds = f"{' or '.join(map(str, counts))} {'seed' if counts == [1] else 'seeds'}"
    footnote(figure, f"n = {seeds}; lines: 95 % interval; dashed: the study's limit")
    return figure
