"""Figures of a calibration, counterparts of Figs. 4 and 5 of the ALCC paper."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcc_rl.errors import DataError
from lcc_rl.functional.laws import LAWS
from lcc_rl.results.drawing import new_figure, unbox

COLOURS = {"local": "#0072b2", "global": "#d55e00"}
INK, GREY = "#222222", "#8a8a8a"
PARAMETERS = {
    "desired_speed": ("desired_speed_mps", "desired speed $v_0$ [m/s]"),
    "time_gap": ("time_gap_s", "time gap $T$ [s]"),
    "acceleration": ("acceleration_mps2", "acceleration $a$ [m/s²]"),
    "deceleration": ("deceleration_mps2", "deceleration $b$ [m/s²]"),
    "min_gap": ("min_gap_m", "standstill gap $s_0$ [m]"),
    "sensitivity": ("sensitivity_hz", "sensitivity $\\kappa$ [1/s]"),
    "form": ("form", "form $\\beta$"),
    "speed_gain": ("speed_gain_hz", "speed gain $\\lambda$ [1/s]"),
    "leader_deceleration": ("leader_deceleration_mps2", "believed $\\hat{b}$ [m/s²]"),
}


def calibration_figure(drivers: pd.DataFrame) -> Figure:
    """Box plots of the error and the parameters by mode (Fig. 4 of the ALCC paper).

    Boxes span the quartiles, whiskers the 5th to 95th percentile; a diamond marks the mean.

    Args:
        drivers: calibrated drivers of one mode or both.

    Raises:
        DataError: if the table is empty or lacks a column.
    """
    modes = _modes(drivers)
    # Parameters held constant in every mode would be empty panels.
    shown = {
        name: pair
        for name, pair in PARAMETERS.items()
        if pair[0] in drivers and drivers[pair[0]].nunique() > 1
    }
    rows = 1 + len(shown) // 3
    figure = new_figure(10.0, 0.4 + 2.7 * rows)
    axes = figure.subplots(rows, 3).ravel()
    for axis in axes[1 + len(shown) :]:
        axis.remove()
    _boxes(axes[0], {mode: 100.0 * part["rmspe"] for mode, part in modes.items()})
    axes[0].set_title("speed error RMSPE [%]", fontsize=10, color=INK)
    for axis, (name, (column, label)) in zip(axes[1:], shown.items(), strict=False):
        _boxes(axis, {mode: part[column] for mode, part in modes.items()})
        axis.set_title(label, fontsize=10, color=INK)
        _say_bound(axis, name, modes)
    means = ", ".join(f"{mode} {100 * part['rmspe'].mean():.1f} %" for mode, part in modes.items())
    model = ", ".join(drivers["model"].unique()).upper() if "model" in drivers else "IDM"
    figure.suptitle(f"{model} calibration: mean RMSPE {means}", fontsize=12, color=INK)
    note = "box: quartiles; whiskers: 5th to 95th percentile; line: median; diamond: mean"
    figure.supxlabel(note, fontsize=8, color=GREY)
    return figure


def joint_figure(drivers: pd.DataFrame, mode: str | None = None) -> Figure:
    """Joint distribution of (v0, T) with its marginals (Fig. 5 of the ALCC paper).

    Args:
        drivers: calibrated drivers of one mode or both.
        mode: the mode; by default local where the table has it.

    Raises:
        DataError: if the table is empty, lacks a column or has no such mode.
    """
    modes = _modes(drivers)
    mode = mode or next(iter(modes))
    if mode not in modes:
        raise DataError(f"no drivers of mode {mode!r} to draw; the table holds {', '.join(modes)}")
    table = modes[mode]
    speed = table["desired_speed_mps"].to_numpy(float)
    gap = table["time_gap_s"].to_numpy(float)
    bound = table["desired_speed_at_bound"].to_numpy(bool)
    figure = new_figure(6.6, 6.2)
    grid = figure.add_gridspec(2, 2, width_ratios=(4, 1), height_ratios=(1, 4))
    centre = figure.add_subplot(grid[1, 0])
    top = figure.add_subplot(grid[0, 0], sharex=centre)
    side = figure.add_subplot(grid[1, 1], sharey=centre)
    _scatter(centre, speed, gap, bound, COLOURS.get(mode, INK))
    _marginals(top, side, speed, gap, bound, COLOURS.get(mode, INK))
    figure.suptitle(
        f"Desired speed and time gap of {len(table)} drivers ({mode} calibration)\n"
        f"{_correlation(speed, gap, bound)}",
        fontsize=11,
        color=INK,
    )
    return figure


def _modes(drivers: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Split the table by mode, local first."""
    models = drivers["model"].unique() if "model" in drivers else ["idm"]
    names = [name for name in PARAMETERS if any(name in LAWS[x].parameters for x in models)]
    columns = [PARAMETERS[name][0] for name in names] + [f"{name}_at_bound" for name in names]
    missing = [name for name in ("mode", "rmspe", *columns) if name not in drivers]
    if missing:
        raise DataError(f"driver table: missing column(s) {', '.join(missing)}")
    if drivers.empty:
        raise DataError("driver table: no drivers to draw")
    order = sorted(drivers["mode"].unique(), key=lambda mode: (mode != "local", mode))
    return {str(mode): drivers[drivers["mode"] == mode] for mode in order}


def _boxes(axis: Axes, values: dict[str, pd.Series]) -> None:
    """Draw a box per mode, or a line where the parameter was held constant."""
    _plain(axis)
    for place, (mode, series) in enumerate(values.items()):
        colour = COLOURS.get(mode, INK)
        numbers = series.to_numpy(float)
        if len(numbers) > 1 and np.ptp(numbers) == 0.0:
            axis.plot([place - 0.25, place + 0.25], numbers[[0, 0]], color=colour, linewidth=2)
            axis.annotate(
                f"held at {numbers[0]:g}",
                (place, numbers[0]),
                xytext=(0, 5),
                textcoords="offset points",
                ha="center",
                fontsize=8,
                color=colour,
            )
            continue
        axis.boxplot(
            [numbers],
            positions=[place],
            widths=0.5,
            whis=(5, 95),
            showmeans=True,
            patch_artist=True,
            boxprops={"facecolor": colour, "alpha": 0.35, "edgecolor": colour},
            medianprops={"color": colour, "linewidth": 2},
            meanprops={"marker": "D", "markerfacecolor": INK, "markeredgecolor": INK}
            | {"markersize": 4},
            whiskerprops={"color": colour},
            capprops={"color": colour},
            flierprops={"marker": ".", "markersize": 3, "markeredgecolor": GREY},
        )
    labels = [f"{mode}\nn = {len(series)}" for mode, series in values.items()]
    axis.set_xticks(range(len(values)), labels, fontsize=9)
    axis.set_xlim(-0.6, len(values) - 0.4)
    axis.set_ylim(bottom=0.0)
    axis.grid(visible=False, axis="x")


def _say_bound(axis: Axes, name: str, modes: dict[str, pd.DataFrame]) -> None:
    """Write which share of a fitted parameter lies on a bound of the search."""
    flags = {mode: part[f"{name}_at_bound"].mean() for mode, part in modes.items()}
    texts = [f"{mode} {100 * share:.0f} %" for mode, share in flags.items() if share > 0.0]
    if texts:
        axis.set_xlabel(f"on a bound: {', '.join(texts)}", fontsize=8, color=GREY)


def _scatter(
    axis: Axes, speed: np.ndarray, gap: np.ndarray, bound: np.ndarray, colour: str
) -> None:
    """Draw a dot for every driver, hollow where v0 lies on a bound and is not identified."""
    _plain(axis)
    axis.scatter(
        speed[~bound],
        gap[~bound],
        s=16,
        color=colour,
        alpha=0.6,
        linewidths=0,
        label=f"$v_0$ identified ({(~bound).sum()})",
    )
    if bound.any():
        axis.scatter(
            speed[bound],
            gap[bound],
            s=16,
            facecolors="none",
            edgecolors=GREY,
            linewidths=0.8,
            clip_on=False,
            label=f"$v_0$ on a bound ({bound.sum()}, {100 * bound.mean():.0f} %)",
        )
    axis.set_xlabel("desired speed $v_0$ [m/s]")
    axis.set_ylabel("time gap $T$ [s]")
    axis.set_ylim(bottom=0.0)
    axis.legend(
        fontsize=8,
        frameon=True,
        framealpha=0.9,
        edgecolor="none",
        loc="upper left",
        bbox_to_anchor=(0.5, 1.0),
    )


def _marginals(
    top: Axes, side: Axes, speed: np.ndarray, gap: np.ndarray, bound: np.ndarray, colour: str
) -> None:
    """Counts along both axes, drivers at a bound stacked in grey."""
    colours = [colour, "#c8c8c8"]
    top.hist([speed[~bound], speed[bound]], bins=24, stacked=True, color=colours)
    side.hist(
        [gap[~bound], gap[bound]], bins=24, stacked=True, color=colours, orientation="horizontal"
    )
    for axis in (top, side):
        _plain(axis)
        axis.grid(visible=False)
    top.tick_params(labelbottom=False)
    side.tick_params(labelleft=False)
    top.set_ylabel("drivers")
    side.set_xlabel("drivers")


def _correlation(speed: np.ndarray, gap: np.ndarray, bound: np.ndarray) -> str:
    """Correlation of all drivers and of those whose v0 is identified."""
    return (
        f"correlation of ($v_0$, $T$): {_pearson(speed, gap)} of all, "
        f"{_pearson(speed[~bound], gap[~bound])} of those with $v_0$ identified"
    )


def _pearson(first: np.ndarray, second: np.ndarray) -> str:
    if len(first) < 3 or first.std() == 0.0 or second.std() == 0.0:
        return "undefined"
    return f"{np.corrcoef(first, second)[0, 1]:.2f}"


def _plain(axis: Axes) -> None:
    """A light grid behind the data and no box around it."""
    axis.grid(visible=True, axis="both", color="#e6e6e6", linewidth=0.8)
    axis.set_axisbelow(True)
    unbox(axis)
    axis.tick_params(labelsize=9)
