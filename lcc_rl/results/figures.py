"""Figures of trainings and evaluations of a controlled car (ALCC Figs. 6, 7, 9 and 10)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from lcc_rl.io.files import read_parquet
from lcc_rl.results.drawing import INK, in_file, in_words, legend_above, new_figure, save, unbox
from lcc_rl.results.intervals import Estimate, share_saved
from lcc_rl.results.runs import stored_config
from lcc_rl.results.savings import BASELINES, UNTRAINED, by_driver, paired, savings, worse_off
from lcc_rl.results.space_time import space_time

# Distinct without colour vision and in grey.
COLOURS = {
    "alcc": "#0072b2",
    "reference": "#d55e00",
    "own_energy": "#009e73",
    "idm": "#6b6b6b",
    "human": "#b0a080",
    "direct": "#222222",
}
OTHERS = ("#cc79a7", "#e69f00", "#56b4e9")
VEHICLES = {
    "leader": ("leader", "#222222"),
    "cav": ("controlled car", "#0072b2"),
    "hdv": ("human follower", "#d55e00"),
}


def colour(strategy: str) -> str:
    """Return the colour that a strategy has in every figure."""
    return COLOURS.get(strategy) or OTHERS[sum(strategy.encode()) % len(OTHERS)]


def style(axis: Axes, xlabel: str, ylabel: str) -> None:
    """Label an axis and remove the top and right line of its frame."""
    axis.set_xlabel(xlabel)
    axis.set_ylabel(ylabel)
    unbox(axis)


def sample_episode(steps: pd.DataFrame, strategy: str) -> Figure:
    """Speeds, accelerations and gaps of one held-out episode (Fig. 7)."""
    rows = _one_episode(steps, strategy)
    first = rows.iloc[0]
    figure = new_figure(7.0, 6.5)
    axes = figure.subplots(3, 1, sharex=True)
    for vehicle, (name, hue) in VEHICLES.items():
        for axis, entry in zip(axes, ("speed", "acceleration", "gap"), strict=True):
            column = f"{vehicle}_{entry}"
            if column in rows and rows[column].notna().any():
                axis.plot(rows["time_s"], rows[column], color=hue, label=name, lw=1.3)
    style(axes[0], "", "speed [m/s]")
    style(axes[1], "", "acceleration [m/s²]")
    style(axes[2], "time [s]", "gap ahead [m]")
    legend_above(axes[0])
    figure.suptitle(
        f"{in_words(strategy)}: profile {first['profile']}, driver "
        f"v0 {first['desired_speed_mps']:.1f} m/s, T {first['time_gap_s']:.2f} s",
        fontsize=10,
    )
    return figure


def overview(episodes: pd.DataFrame, steps: pd.DataFrame, strategy: str) -> Figure:
    """Speeds of one episode, and the mean energies of both cars by strategy."""
    figure = new_figure(10.0, 3.8)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    rows = _one_episode(steps, strategy)
    for vehicle, (name, hue) in VEHICLES.items():
        if f"{vehicle}_speed" in rows:
            left.plot(rows["time_s"], rows[f"{vehicle}_speed"], color=hue, label=name, lw=1.3)
    style(left, "time [s]", "speed [m/s]")
    left.set_title(f"One held-out episode of {in_words(strategy)}", fontsize=10, pad=22)
    legend_above(left)
    _mean_energies(right, episodes[episodes["strategy"] != "direct"])
    return figure


def _mean_energies(axis: Axes, cars: pd.DataFrame) -> None:
    """Draw a bar per strategy: the mean energies of car and human driver, one after the other."""
    present = [vehicle for vehicle in ("cav", "hdv") if f"{vehicle}_path_energy_kj" in cars]
    means = cars.groupby("strategy", sort=False)[[f"{x}_path_energy_kj" for x in present]].mean()
    totals, places = pd.Series(0.0, means.index), np.arange(len(means))
    for vehicle in present:
        name, hue = VEHICLES[vehicle]
        value = means[f"{vehicle}_path_energy_kj"]
        axis.barh(places, value, left=totals, color=hue, label=name)
        totals = totals + value
    for place, (label, total) in enumerate(totals.items()):
        known = label != "idm" and "idm" in totals
        change = f" ({100 * (total / totals['idm'] - 1):+.1f} %)" if known else ""
        axis.annotate(f" {total:.0f}{change}", (total, place), va="center", fontsize=8)
    axis.set_yticks(places, [in_words(str(name)) for name in totals.index], fontsize=9)
    axis.set_ylim(len(places) - 0.4, -0.6)
    axis.set_xlim(0.0, 1.4 * totals.max())
    against = "\nin brackets: against idm" if "idm" in totals else ""
    style(axis, f"path energy [kJ per episode]{against}", "")
    legend_above(axis)
    title = (
        f"{cars['profile_id'].nunique()} held-out profiles × {cars['driver_id'].nunique()} drivers"
    )
    axis.set_title(f"Mean over {title}", fontsize=10, pad=22)


def _one_episode(steps: pd.DataFrame, strategy: str) -> pd.DataFrame:
    """Return the sample episode of a strategy whose leader's, or first, speed varies most."""
    rows = steps[steps["strategy"] == strategy]
    if "training_seed" in rows and rows["training_seed"].notna().any():
        rows = rows[rows["training_seed"] == rows["training_seed"].min()]
    first_speed = next(name for name in rows.columns if name.endswith("_speed"))
    episodes = rows.groupby(["profile", "driver_id"])[first_speed]
    spread = episodes.transform("std")
    first = rows.iloc[int(spread.to_numpy().argmax())]
    rows = rows[(rows["profile"] == first["profile"]) & (rows["driver_id"] == first["driver_id"])]
    # Of several vehicles of a kind the first is shown.
    return rows.rename(columns=lambda name: re.sub(r"^(cav|hdv)1_", r"\1_", name))


def human_energy(episodes: pd.DataFrame, strategy: str) -> Figure:
    """Human driver's energy behind the controlled car and directly behind the leader (Fig. 9)."""
    figure = new_figure(9.0, 3.8)
    names = {"direct": "B: direct", strategy: f"A: behind {in_words(strategy)}"}
    saving = _by_driver(figure, episodes, "hdv_path_energy_kj", names, "the human driver")
    found = savings(episodes, "hdv_path_energy_kj", strategy, "direct")
    figure.suptitle(
        f"Human driver's path energy with and without the controlled car ahead "
        f"(n = {len(saving)} drivers)\n"
        f"mean saving {_with_interval(found, episodes, strategy)}",
        fontsize=10,
    )
    return figure


def paired_improvement(episodes: pd.DataFrame, strategy: str, baseline: str) -> Figure:
    """Path energy of all vehicles by driver and its saving against a baseline (Fig. 10)."""
    figure = new_figure(9.0, 3.8)
    names = {name: in_words(name) for name in (baseline, strategy)}
    column = "total_path_energy_kj"
    saving = _by_driver(figure, episodes, column, names, "all vehicles")
    found = savings(episodes, column, strategy, baseline)
    pairs = worse_off(paired(episodes, column), strategy, baseline)["pairs"]
    share = _with_interval(found, episodes, strategy)
    figure.suptitle(
        f"{names[strategy]} against {names[baseline]}: saving of path energy {share}\n"
        f"best driver {100 * saving.max():+.1f} %, worst {100 * saving.min():+.1f} %; worse off: "
        f"{int((saving < 0).sum())} of {len(saving)} drivers, "
        f"{100 * pairs:.0f} % of (window, driver) pairs",
        fontsize=10,
    )
    return figure


def _by_driver(
    figure: Figure, episodes: pd.DataFrame, column: str, names: dict[str, str], whose: str
) -> pd.Series:
    """Draw the energies of all drivers under a baseline and a strategy, and what each saves.

    Args:
        figure: an empty figure.
        episodes: rows of an evaluation.
        column: the energy.
        names: labels of the baseline and of the strategy, in this order.
        whose: energy, for the label of the axis.

    Returns:
        The share that each driver saves.
    """
    energy = by_driver(episodes, column)[list(names)].dropna()
    left, right = figure.subplots(1, 2)
    bins = np.histogram_bin_edges(energy.to_numpy(), 30)
    for (name, label), alpha in zip(names.items(), (0.45, 0.6), strict=True):
        mean = f"{label}, mean {energy[name].mean():.1f}"
        left.hist(energy[name], bins, color=colour(name), alpha=alpha, label=mean)
    style(left, f"path energy of {whose} [kJ per episode]", "drivers")
    left.xaxis.set_major_locator(MaxNLocator(5))
    left.yaxis.set_major_locator(MaxNLocator(integer=True))
    legend_above(left)
    baseline, strategy = names
    saving = share_saved(energy[strategy], energy[baseline])
    against = " against ".join(label.split(":")[0] for label in (names[strategy], names[baseline]))
    _paired_bars(right, saving, f"path energy saved\n{against} [%]", colour(strategy))
    return saving


def _with_interval(found: Estimate, episodes: pd.DataFrame, strategy: str) -> str:
    """Return a share and its interval, in words."""
    seeds = episodes.loc[episodes["strategy"] == strategy, "training_seed"].nunique()
    if np.isnan(found.low):
        return f"{100 * found.value:+.1f} % (1 window, 1 training seed: no interval)"
    bounds = f"{100 * found.low:+.1f} … {100 * found.high:+.1f} %"
    over = "windows; 1 training seed" if seeds == 1 else "windows and seeds"
    return f"{100 * found.value:+.1f} % (95 % interval over {over}: {bounds})"


def _paired_bars(axis: Axes, saving: pd.Series, label: str, hue: str) -> None:
    """Draw one bar per driver, sorted; below zero means worse off."""
    ordered = 100 * np.sort(saving.to_numpy())
    axis.bar(np.arange(len(ordered)), ordered, width=1.0, color=hue, alpha=0.8)
    axis.axhline(0.0, color=INK, lw=0.8)
    mean = ordered.mean()
    axis.axhline(mean, color=INK, lw=0.8, ls="--", label=f"mean of drivers {mean:+.1f} %")
    axis.xaxis.set_major_locator(MaxNLocator(5, integer=True, min_n_ticks=1))
    style(axis, "drivers, sorted", label)
    legend_above(axis)


def write_study_figures(folder: str | Path) -> list[Path]:
    """Draw the figures of an evaluation into its folder ``figures``.

    Args:
        folder: holds episodes.parquet and steps.parquet.

    Returns:
        The figures' paths.

    Raises:
        ResultsError: if a table is missing or a figure cannot be written.
    """
    folder = Path(folder)
    episodes, steps = (read_parquet(folder / f"{x}.parquet") for x in ("episodes", "steps"))
    cfg = stored_config(folder)
    drawn = study_figures(episodes, steps, cfg)
    formats = cfg.get("figure_formats", ())
    return [
        save(figure, folder / "figures" / f"{in_file(stem)}.png", formats=formats)
        for stem, figure in drawn
    ]


def study_figures(
    episodes: pd.DataFrame, steps: pd.DataFrame, cfg: Mapping[str, Any]
) -> Iterator[tuple[str, Figure]]:
    """Yield name and figure of all that an evaluation with a row per episode shows.

    Args:
        episodes: rows of episodes.parquet.
        steps: rows of steps.parquet; it may have none.
        cfg: the evaluation's configuration.
    """
    names = list(dict.fromkeys(episodes["strategy"]))
    cars = [name for name in names if name != "direct"]
    diagram = space_time(steps, [*names[:1], *names[-2:]], cfg) if len(steps) else None
    if diagram is not None:
        yield "space_time", diagram
    if len(steps) and "idm" in names and cars[-1] not in UNTRAINED:
        yield "overview", overview(episodes, steps, cars[-1])
    for name in cars:
        if len(steps) and (steps["strategy"] == name).any():
            yield f"episode {name}", sample_episode(steps, name)
        if "direct" in names:
            yield f"human_energy {name}", human_energy(episodes, name)
        for baseline in BASELINES:
            if baseline in names and baseline != name and name not in UNTRAINED:
                figure = paired_improvement(episodes, name, baseline)
                yield f"improvement {name} vs {baseline}", figure
