"""Figures of evaluations of a controlled car (ALCC Figs. 7, 9 and 10), and all of one folder."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from lcc_rl.figures.drawing import (
    INK,
    colour,
    in_file,
    legend_above,
    new_figure,
    rows_of,
    save,
    style,
)
from lcc_rl.figures.platoon import platoon_figures
from lcc_rl.figures.space_time import space_time
from lcc_rl.io.files import read_parquet
from lcc_rl.results.headline import baseline_of, in_words
from lcc_rl.results.intervals import Estimate, share_saved
from lcc_rl.results.means import Means
from lcc_rl.results.runs import stored_config
from lcc_rl.results.savings import BASELINES, UNTRAINED, by_driver, savings

VEHICLES = {
    "leader": ("leader", INK),
    "cav": ("controlled car", "#0072b2"),
    "hdv": ("human follower", "#d55e00"),
}


def write_figures(folder: str | Path, rows: str = "episodes") -> list[Path]:
    """Draw the figures of an evaluation into its folder ``figures``.

    Args:
        folder: holds config.yaml, episodes.parquet and steps.parquet.
        rows: what a row of episodes.parquet is of, ``episodes`` or ``vehicles``.

    Returns:
        The figures' paths.

    Raises:
        ResultsError: if a table is missing or a figure cannot be written.
    """
    folder = Path(folder)
    steps, cfg = read_parquet(folder / "steps.parquet"), stored_config(folder)
    found: Iterable[tuple[str, Figure]]
    if rows == "episodes":
        found = study_figures(read_parquet(folder / "episodes.parquet"), steps, cfg)
    else:
        bound = float((cfg.get("deployed") or {}).get("jerk_bound", 30.0))
        found = platoon_figures(steps, bound)
    formats = cfg.get("figure_formats", ())
    return [
        save(figure, folder / "figures" / f"{in_file(stem)}.png", formats=formats)
        for stem, figure in found
    ]


def study_figures(
    episodes: pd.DataFrame, steps: pd.DataFrame, cfg: Mapping[str, Any]
) -> Iterator[tuple[str, Figure]]:
    """Yield name and figure of all that an evaluation with a row per episode shows.

    Those that networks are compared with have no figures of their own beside a network's.

    Args:
        episodes: rows of episodes.parquet.
        steps: rows of steps.parquet; it may have none.
        cfg: the evaluation's configuration.
    """
    means, names = Means.of(episodes), list(dict.fromkeys(episodes["strategy"]))
    cars = [name for name in names if name != "direct"]
    diagram = space_time(steps, [*names[:1], *names[-2:]], cfg) if len(steps) else None
    if diagram is not None:
        yield "space_time", diagram
    if len(steps) and {"human", "idm"} & set(names) and cars[-1] not in UNTRAINED:
        yield "overview", overview(episodes, steps, cars[-1])
    for name in [name for name in cars if name not in UNTRAINED] or cars:
        if len(steps) and (steps["strategy"] == name).any():
            yield f"episode {name}", sample_episode(steps, name)
        if "direct" in names:
            yield f"human_energy {name}", human_energy(means, name)
        for baseline in BASELINES:
            if baseline in names and baseline != name and name not in UNTRAINED:
                figure = paired_improvement(means, name, baseline)
                yield f"improvement {name} vs {baseline}", figure


def sample_episode(steps: pd.DataFrame, strategy: str) -> Figure:
    """Speeds, accelerations and gaps of one held-out episode (Fig. 7)."""
    rows = _one_episode(steps, strategy)
    first = rows.iloc[0]
    figure = new_figure(7.0, 6.5)
    axes = figure.subplots(3, 1, sharex=True)
    for axis, entry in zip(axes, ("speed", "acceleration", "gap"), strict=True):
        _over_time(axis, rows, entry)
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
    """Speeds of one episode, and the mean energies per vehicle and km by strategy."""
    figure = new_figure(10.0, 3.8)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    _over_time(left, _one_episode(steps, strategy), "speed")
    style(left, "time [s]", "speed [m/s]")
    left.set_title(f"One held-out episode of {in_words(strategy)}", fontsize=10, pad=22)
    legend_above(left)
    _mean_energies(right, episodes[episodes["strategy"] != "direct"])
    return figure


def _over_time(axis: Axes, rows: pd.DataFrame, entry: str) -> None:
    """Draw a line per vehicle that has the entry."""
    for vehicle, (name, hue) in VEHICLES.items():
        column = f"{vehicle}_{entry}"
        if column in rows and rows[column].notna().any():
            axis.plot(rows["time_s"], rows[column], color=hue, label=name, lw=1.3)


def _mean_energies(axis: Axes, cars: pd.DataFrame) -> None:
    """Draw a bar per strategy: the mean energies of car and human driver, one after the other."""
    present = [vehicle for vehicle in ("cav", "hdv") if f"{vehicle}_path_energy_kj" in cars]
    columns = [f"{x}_{end}" for x in present for end in ("path_energy_kj", "distance_m")]
    means = cars.groupby("strategy", sort=False)[columns].mean()
    kilometres = means[[f"{x}_distance_m" for x in present]].sum(axis=1) / 1e3
    baseline = baseline_of(means.index)
    totals, places = pd.Series(0.0, means.index), np.arange(len(means))
    for vehicle in present:
        name, hue = VEHICLES[vehicle]
        value = means[f"{vehicle}_path_energy_kj"] / kilometres
        axis.barh(places, value, left=totals, color=hue, label=name)
        totals = totals + value
    for place, (label, total) in enumerate(totals.items()):
        saved = ""
        if baseline not in (None, label):
            saved = f" ({100 * (1.0 - total / totals[baseline]):+.1f} %)".replace("-", "−")
        axis.annotate(f" {total:.0f}{saved}", (total, place), va="center", fontsize=8)
    rows_of(axis, list(totals.index))
    axis.tick_params(axis="y", labelsize=9)
    axis.set_xlim(0.0, 1.4 * totals.max())
    against = f"\nin brackets: saved against {in_words(baseline)}" if baseline else ""
    style(axis, f"path energy [kJ per vehicle and km]{against}")
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
    spread = rows.groupby(["profile", "driver_id"])[first_speed].transform("std")
    first = rows.iloc[int(spread.to_numpy().argmax())]
    rows = rows[(rows["profile"] == first["profile"]) & (rows["driver_id"] == first["driver_id"])]
    # The first of several vehicles of a kind is shown.
    return rows.rename(columns=lambda name: re.sub(r"^(cav|hdv)1_", r"\1_", name))


def human_energy(means: Means, strategy: str) -> Figure:
    """Human driver's energy behind the controlled car and directly behind the leader (Fig. 9)."""
    names = {"direct": "B: direct", strategy: f"A: behind {in_words(strategy)}"}
    column = "hdv_path_energy_kj"
    figure, saving, share = _by_driver(means, column, names, "the human driver")
    figure.suptitle(
        f"Human driver's path energy with and without the controlled car ahead "
        f"(n = {len(saving)} drivers)\nmean saving {share}",
        fontsize=10,
    )
    return figure


def paired_improvement(means: Means, strategy: str, baseline: str) -> Figure:
    """Path energy of all vehicles by driver and its saving against a baseline (Fig. 10)."""
    names = {name: in_words(name) for name in (baseline, strategy)}
    column = "total_path_energy_kj"
    figure, saving, share = _by_driver(means, column, names, "all vehicles")
    figure.suptitle(
        f"{names[strategy]} against {names[baseline]}: saving of path energy {share}\n"
        f"best driver {100 * saving.max():+.1f} %, worst {100 * saving.min():+.1f} %; worse off: "
        f"{int((saving < 0).sum())} of {len(saving)} drivers",
        fontsize=10,
    )
    return figure


def _by_driver(
    means: Means, column: str, names: dict[str, str], whose: str
) -> tuple[Figure, pd.Series, str]:
    """Draw the energies of all drivers under a baseline and a strategy, and what each saves.

    Args:
        means: of an evaluation.
        column: the energy.
        names: labels of the baseline and of the strategy, in this order.
        whose: energy, for the label of the axis.

    Returns:
        The figure, the share that each driver saves, and the mean saving in words.
    """
    baseline, strategy = names
    energy = by_driver(means.drivers, column)[[baseline, strategy]].dropna()
    figure = new_figure(9.0, 3.8)
    left, right = figure.subplots(1, 2)
    bins = np.histogram_bin_edges(energy.to_numpy(), 30)
    for (name, label), alpha in zip(names.items(), (0.45, 0.6), strict=True):
        mean = f"{label}, mean {energy[name].mean():.1f}"
        left.hist(energy[name], bins, color=colour(name), alpha=alpha, label=mean)
    style(left, f"path energy of {whose} [kJ per episode]", "drivers")
    left.xaxis.set_major_locator(MaxNLocator(5))
    left.yaxis.set_major_locator(MaxNLocator(integer=True))
    legend_above(left)
    saving = share_saved(energy[strategy], energy[baseline])
    against = " against ".join(label.split(":")[0] for label in (names[strategy], names[baseline]))
    _sorted_bars(right, saving, colour(strategy))
    style(right, "drivers, sorted", f"path energy saved\n{against} [%]")
    found = savings(means.windows, column, strategy, baseline)
    return figure, saving, _with_interval(found, means.windows, strategy)


def _with_interval(found: Estimate, episodes: pd.DataFrame, strategy: str) -> str:
    """Return a share and its interval, in words."""
    seeds = episodes.loc[episodes["strategy"] == strategy, "training_seed"].nunique()
    if np.isnan(found.low):
        return f"{100 * found.value:+.1f} % (1 window, 1 training seed: no interval)"
    bounds = f"{100 * found.low:+.1f} … {100 * found.high:+.1f} %"
    over = "windows; 1 training seed" if seeds == 1 else "windows and seeds"
    return f"{100 * found.value:+.1f} % (95 % interval over {over}: {bounds})"


def _sorted_bars(axis: Axes, saving: pd.Series, hue: str) -> None:
    """Draw one bar per driver, sorted; below zero means worse off."""
    ordered = 100 * np.sort(saving.to_numpy())
    axis.bar(np.arange(len(ordered)), ordered, width=1.0, color=hue, alpha=0.8)
    axis.axhline(0.0, color=INK, lw=0.8)
    mean = ordered.mean()
    axis.axhline(mean, color=INK, lw=0.8, ls="--", label=f"mean of drivers {mean:+.1f} %")
    axis.xaxis.set_major_locator(MaxNLocator(5, integer=True, min_n_ticks=1))
    legend_above(axis)
