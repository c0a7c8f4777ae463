"""Figures that compare the trainings of the ALCC study with each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcc_rl.results.drawing import INK, in_words, legend_above, new_figure
from lcc_rl.results.figures import colour, style
from lcc_rl.results.savings import UNTRAINED, per_seed
from lcc_rl.studies.alcc.tables import comparison

SOFT = "#8a8a8a"
PANELS = {
    "path_saving_against_idm_pct": ("path energy saved\nagainst idm [%]", 0.0),
    "unsafe_ttc_pct": ("time with TTC < 4 s [%]", 0.1),
    "long_time_gap_pct": ("time with time gap\n> 2.5 s [%]", 1.0),
}


def whiskers(
    axis: Axes,
    places: Sequence[float] | np.ndarray,
    table: pd.DataFrame,
    column: str,
    hue: str,
    upright: bool = False,
) -> None:
    """Draw the intervals of a column, where it has any.

    Args:
        axis: the axes.
        places: position of every row, on the vertical axis or, if upright, the horizontal one.
        table: rows with the columns ``<column>_low`` and ``<column>_high``.
        column: name of the column.
        hue: colour of the lines.
        upright: draw vertical lines.
    """
    low, high = (table[f"{column}_{end}"].to_numpy(float) for end in ("low", "high"))
    draw = axis.vlines if upright else axis.hlines
    draw(places, low, high, color=hue, lw=2.0, alpha=0.6)


def comparison_figure(episodes: pd.DataFrame, by: str = "ablation") -> Figure:
    """Energy, safety and efficiency under each change of the study (no counterpart).

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
            whiskers(axis, rows, part, column, colour(strategy))
            axis.plot(
                part[column], rows, "o", color=colour(strategy), ms=5, label=in_words(strategy)
            )
        axis.axvline(line, color=SOFT, lw=0.8, ls="-" if line == 0.0 else "--")
        axis.axhline(0.5, color=SOFT, lw=0.6)
        axis.grid(visible=True, axis="x", color="#e6e6e6", linewidth=0.8)
        axis.set_axisbelow(True)
        style(axis, label, "")
        axis.tick_params(axis="y", length=0)
    axes[0].set_yticks(range(len(names)), [in_words(str(name)) for name in names])
    axes[0].set_ylim(len(names) - 0.4, -0.6)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3, frameon=False)
    note = f"n = {_how_many(table['seeds'])}; lines: 95 % interval; dashed: the study's limit"
    figure.supxlabel(note, fontsize=8, color=SOFT)
    return figure


def _how_many(seeds: pd.Series) -> str:
    """Return the distinct numbers of seeds in a column, in words."""
    counts = sorted({int(count) for count in seeds if str(count).isdigit()})
    return f"{' or '.join(map(str, counts))} {'seed' if counts == [1] else 'seeds'}"


def _abreast(count: int, reach: float) -> np.ndarray:
    """Return evenly spaced offsets in ±``reach``; zero for a single one."""
    return reach * np.linspace(-1.0, 1.0, count) * (count > 1)


def followers_figure(episodes: pd.DataFrame) -> Figure:
    """Energy saved against the number of human drivers behind (no counterpart).

    Args:
        episodes: rows of the evaluations of all trained strategies, with the column
            ``followers``.
    """
    table = comparison(episodes, "followers")
    table = table[table["strategy"] != "reference"]
    column = "path_saving_against_reference_pct"
    figure = new_figure(6.5, 3.8)
    axis = figure.subplots()
    names = list(dict.fromkeys(table["strategy"]))
    for name, offset in zip(names, _abreast(len(names), 0.06), strict=True):
        part = table[table["strategy"] == name]
        label = f"{in_words(name)}, {_how_many(part['seeds'])}"
        places = part["followers"].to_numpy(float) + offset
        axis.plot(places, part[column], "o-", color=colour(name), label=label)
        whiskers(axis, places, part, column, colour(name), upright=True)
    axis.axhline(0.0, color=INK, lw=0.8)
    legend_above(axis)
    words = "path energy saved\nagainst reference [%]"
    style(axis, "human drivers behind the controlled car (lines: 95 % interval)", words)
    return figure


def single_profile_figure(episodes: pd.DataFrame) -> Figure:
    """Total energy of every seed trained and evaluated on one profile (no counterpart).

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
        learned = [name for name in energy if name not in UNTRAINED]
        for number, strategy in enumerate(sorted(learned, reverse=True)):
            values = energy[strategy].to_numpy(float)
            centre = place - 0.16 + 0.32 * number
            jitter = centre + _abreast(len(values), 0.1)
            axis.plot(jitter, values, "o", color=colour(strategy), ms=5, alpha=0.6, mew=0)
            axis.hlines(values.mean(), centre - 0.14, centre + 0.14, color=colour(strategy), lw=2)
            _once(axis, seen, strategy, f"{in_words(strategy)}: seeds and mean", "o")
    labels = [f"profile {name!s}\n{_gain(part)}" for name, part in groups.items()]
    axis.set_xticks(range(len(groups)), labels, fontsize=9)
    axis.set_ylim(bottom=min(0.0, axis.get_ylim()[0]))
    style(axis, "profile used for training and evaluation", "total energy [kJ per episode]")
    figure.legend(loc="outside upper center", frameon=False, ncols=3)
    return figure


def _gain(episodes: pd.DataFrame) -> str:
    """Return the difference of alcc from reference on one profile, in words."""
    energy = per_seed(episodes, "total_energy_kj")
    if not {"alcc", "reference"} <= set(energy):
        return ""
    # Not a percentage: in a jam a profile's energy can be near zero.
    return f"alcc {energy['alcc'].mean() - energy['reference'].mean():+.1f} kJ\nagainst reference"


def _once(axis: Axes, seen: set[str], strategy: str, label: str, mark: str) -> None:
    """Add a strategy to the legend the first time it appears."""
    if strategy not in seen:
        seen.add(strategy)
        axis.plot([], [], mark, color=colour(strategy), label=label)
