"""Figures of the ALCC study over seeds, each from parquet alone; the paper's number is named."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcc_rl.functional.power import motor_power
from lcc_rl.results.drawing import new_figure
from lcc_rl.results.figures import colour, draw_curve, style
from lcc_rl.results.tables import HUMANS, paired, per_seed, savings
from lcc_rl.studies.alcc.tables import (
    PAPER_GENERALIZATION,
    comparison,
    generalization,
)

INK, SOFT = "#222222", "#8a8a8a"
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
        # As in the learning curve: the first, random episodes would set the scale.
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
    """Energy of the CAV and of the HDV over drivers, by strategy (Fig. 11).

    A driver's value is its mean over the held-out profiles and seeds. Boxes span the quartiles,
    whiskers the 5th to 95th percentile; a diamond marks the mean.
    """
    names = list(dict.fromkeys(episodes["strategy"]))
    figure = new_figure(9.0, 0.9 + 0.62 * len(names))
    axes = figure.subplots(1, 2)
    titles = {"cav": "controlled car (CAV)", "hdv": "human driver (HDV)"}
    for axis, vehicle in zip(axes, ("cav", "hdv"), strict=True):
        by_driver = paired(episodes, f"{vehicle}_energy_kj").groupby("driver_id").mean()
        for place, name in enumerate(names):
            if name in by_driver:
                _flat_box(axis, by_driver[name].to_numpy(float), place, colour(name))
        axis.set_yticks(range(len(names)), names if vehicle == "cav" else [""] * len(names))
        axis.set_ylim(len(names) - 0.4, -0.6)
        axis.margins(x=0.12)
        style(axis, "energy [kJ per episode]", "")
        axis.set_title(f"{titles[vehicle]}, n = {len(by_driver)} drivers", fontsize=10)
    note = "box: quartiles; whiskers: 5th to 95th percentile; diamond and number: mean"
    figure.supxlabel(note, fontsize=8, color=SOFT)
    return figure


def _flat_box(axis: Axes, values: np.ndarray, place: int, hue: str) -> None:
    """Draw one lying box with its mean beside it."""
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
    """Saving of total energy on every held-out profile, beside the paper's four (Fig. 12)."""
    table = generalization(episodes, strategy, baseline).sort_values("saving_pct")
    values, places = table["saving_pct"].to_numpy(float), np.arange(len(table))
    figure = new_figure(9.0, 4.0)
    axis = figure.subplots()
    _whiskers(axis, places, table, "saving_pct", colour(strategy), upright=True)
    axis.plot(places, values, "o", color=colour(strategy), label=_label(episodes, strategy))
    beyond = len(table) + 1.0 + np.arange(len(PAPER_GENERALIZATION))
    axis.plot(beyond, PAPER_GENERALIZATION, "s", mfc="none", color=INK, label="paper, 4 profiles")
    axis.axhline(0.0, color=INK, lw=0.8)
    together = 100 * savings(episodes, "total_energy_kj", strategy, baseline).value
    line = f"all profiles together {together:+.1f} %"
    axis.axhline(together, color=colour(strategy), lw=0.8, ls="--", label=line)
    _cut_outliers(axis, places, values)
    axis.set_xticks([])
    style(
        axis,
        f"held-out profiles, sorted (n = {len(table)}); right: the paper's",
        f"total energy saved by {strategy}\nagainst {baseline} [%]",
    )
    axis.legend(frameon=False, loc="upper left")
    return figure


def _cut_outliers(axis: Axes, places: np.ndarray, values: np.ndarray) -> None:
    """Scale an axis by the bulk of its values, and write those beyond it at its border."""
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


def _whiskers(
    axis: Axes,
    places: Sequence[float] | np.ndarray,
    table: pd.DataFrame,
    column: str,
    hue: str,
    upright: bool = False,
) -> None:
    """Draw the intervals of a column, where it has any."""
    low, high = (table[f"{column}_{end}"].to_numpy(float) for end in ("low", "high"))
    draw = axis.vlines if upright else axis.hlines
    draw(places, low, high, color=hue, lw=2.0, alpha=0.6)


PANELS = {
    "saving_against_idm_pct": ("total energy saved\nagainst idm [%]", 0.0),
    "unsafe_ttc_pct": ("time with TTC < 4 s [%]", 0.1),
    "long_time_gap_pct": ("time with time gap\n> 2.5 s [%]", 1.0),
}


def comparison_figure(episodes: pd.DataFrame, by: str = "ablation") -> Figure:
    """What each change of the study does to energy, safety and efficiency (no counterpart).

    Args:
        episodes: rows of the evaluations; those of the study itself come first.
        by: the column that names the change.
    """
    table = comparison(episodes, by)
    names = list(dict.fromkeys(table[by]))
    figure = new_figure(10.0, 1.3 + 0.42 * len(names))
    axes = figure.subplots(1, len(PANELS), sharey=True, width_ratios=(2, 1, 1))
    for axis, (column, (label, line)) in zip(axes, PANELS.items(), strict=True):
        strategies = list(dict.fromkeys(table["strategy"]))
        for strategy, offset in zip(strategies, _abreast(len(strategies), 0.18), strict=True):
            part = table[table["strategy"] == strategy]
            rows = [names.index(name) + offset for name in part[by]]
            _whiskers(axis, rows, part, column, colour(strategy))
            axis.plot(part[column], rows, "o", color=colour(strategy), ms=5, label=strategy)
        axis.axvline(line, color=SOFT, lw=0.8, ls="-" if line == 0.0 else "--")
        axis.axhline(0.5, color=SOFT, lw=0.6)
        axis.grid(visible=True, axis="x", color="#e6e6e6", linewidth=0.8)
        axis.set_axisbelow(True)
        style(axis, label, "")
        axis.tick_params(axis="y", length=0)
    axes[0].set_yticks(range(len(names)), [str(name).replace("_", " ") for name in names])
    axes[0].set_ylim(len(names) - 0.4, -0.6)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3, frameon=False)
    note = f"n = {_how_many(table['seeds'])}; lines: 95 % interval; dashed: the study's limit"
    figure.supxlabel(note, fontsize=8, color=SOFT)
    return figure


def _how_many(seeds: pd.Series) -> str:
    """Write the numbers of seeds of a column, each once, leaving out what was not trained."""
    counts = sorted({int(count) for count in seeds if str(count).isdigit()})
    return f"{' or '.join(map(str, counts))} {'seed' if counts == [1] else 'seeds'}"


def _abreast(count: int, reach: float) -> np.ndarray:
    """Return evenly spread places around zero, at most ``reach`` from it; one alone is there."""
    return reach * np.linspace(-1.0, 1.0, count) * (count > 1)


def followers_figure(episodes: pd.DataFrame) -> Figure:
    """What regard for the human drivers behind saves, against their number (no counterpart).

    Args:
        episodes: rows of the evaluations of all trained strategies, with the column
            ``followers``.
    """
    table = comparison(episodes, "followers")
    table = table[table["strategy"] != "reference"]
    column = "saving_against_reference_pct"
    figure = new_figure(6.5, 3.8)
    axis = figure.subplots()
    names = list(dict.fromkeys(table["strategy"]))
    for name, offset in zip(names, _abreast(len(names), 0.06), strict=True):
        part = table[table["strategy"] == name]
        label = f"{name}, {_how_many(part['seeds'])}"
        places = part["followers"].to_numpy(float) + offset
        axis.plot(places, part[column], "o-", color=colour(name), label=label)
        _whiskers(axis, places, part, column, colour(name), upright=True)
    axis.axhline(0.0, color=INK, lw=0.8)
    axis.legend(frameon=False, loc="lower left")
    words = "total energy saved\nagainst reference [%]"
    style(axis, "human drivers behind the controlled car (lines: 95 % interval)", words)
    return figure


def single_profile_figure(episodes: pd.DataFrame) -> Figure:
    """One profile for training and evaluation: every seed beside the human (no counterpart).

    Args:
        episodes: rows of the evaluations, with the column ``study_profile``.
    """
    groups = dict(iter(episodes.groupby("study_profile", sort=True)))
    figure = new_figure(max(7.5, 1.8 + 1.9 * len(groups)), 4.2)
    axis = figure.subplots()
    seen: set[str] = set()
    for place, part in enumerate(groups.values()):
        energy = per_seed(part, "total_energy_kj")
        human = float(energy["idm"].mean())
        axis.hlines(human, place - 0.36, place + 0.36, color=colour("idm"), lw=2.5)
        _once(axis, seen, "idm", "idm (human driver)", "-")
        learned = [name for name in energy if name not in HUMANS]
        for number, strategy in enumerate(sorted(learned, reverse=True)):
            values = energy[strategy].to_numpy(float)
            centre = place - 0.16 + 0.32 * number
            jitter = centre + _abreast(len(values), 0.1)
            axis.plot(jitter, values, "o", color=colour(strategy), ms=5, alpha=0.6, mew=0)
            axis.hlines(values.mean(), centre - 0.14, centre + 0.14, color=colour(strategy), lw=2)
            _once(axis, seen, strategy, f"{strategy}: seeds and mean", "o")
    labels = [f"profile {name!s}\n{_gain(part)}" for name, part in groups.items()]
    axis.set_xticks(range(len(groups)), labels, fontsize=9)
    axis.set_ylim(bottom=min(0.0, axis.get_ylim()[0]))
    style(axis, "profile used for training and evaluation", "total energy [kJ per episode]")
    figure.legend(loc="outside upper center", frameon=False, ncols=3)
    return figure


def _gain(episodes: pd.DataFrame) -> str:
    """Write what regard for the driver behind brings on one profile."""
    energy = per_seed(episodes, "total_energy_kj")
    if not {"alcc", "reference"} <= set(energy):
        return ""
    # Not a percentage: in a jam a profile's energy can be near zero.
    return f"alcc {energy['alcc'].mean() - energy['reference'].mean():+.1f} kJ\nagainst reference"


def _once(axis: Axes, seen: set[str], strategy: str, label: str, mark: str) -> None:
    """Put a strategy into the legend the first time it appears."""
    if strategy not in seen:
        seen.add(strategy)
        axis.plot([], [], mark, color=colour(strategy), label=label)
