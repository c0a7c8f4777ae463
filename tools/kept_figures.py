"""Figures of docs/limits.md and docs/notes/calibration.md, drawn from outputs/reference."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from lcc_rl.results.calibration_figures import COLOURS
from lcc_rl.results.drawing import INK, in_words, legend_above, new_figure, unbox
from lcc_rl.results.figures import style
from lcc_rl.results.fronts import ENERGY, KINDS, SHARE, points
from lcc_rl.results.intervals import bounds, weights

NAMES = {
    "network": ("network", "#0072b2"),
    "memory": ("network with memory", "#56b4e9"),
    "preview": ("network with preview", "#009e73"),
    "idm": ("IDM, by search", "#d55e00"),
    "idm_gradient": ("IDM, by gradient", "#cc79a7"),
}
LINES = {"alcc": "-", "own_energy": "--", "reference": ":"}
BASE, ALONE = "first 60 s", "one at a time"
SECONDS = (15, 20, 30, 40, 50)
PAPER = {"global": (6.0, 16.8), "local": (6.7, 5.5)}  # RMSPE [%], seconds per episode


def figure_of_limits(windows: pd.DataFrame) -> Figure:
    """Draw path energy over the share of long time gaps: a dot per training, a line per kind.

    Args:
        windows: one row per training and held-out window.
    """
    figure = new_figure(6.4, 4.2)
    axes = figure.subplots()
    for kind, rows in windows.groupby(KINDS, sort=False):
        variant, policy = map(str, kind)
        name, hue = NAMES[policy]
        line = points(rows).sort_values(SHARE)
        label = f"{in_words(variant)}, {name}"
        axes.plot(100.0 * line[SHARE], line[ENERGY], ls=LINES[variant], color=hue, label=label)
        each = rows.groupby(["limit", "training_seed"])[[ENERGY, SHARE]].mean()
        axes.plot(100.0 * each[SHARE], each[ENERGY], ".", color=hue, alpha=0.6)
    legend_above(axes, 2)
    style(axes, "time gap > 2.5 s above 1 m/s [% of the time]", "path energy\n[kJ per episode]")
    return figure


def mean_error(rows: pd.DataFrame) -> tuple[float, float, float]:
    """Return the mean RMSPE [%] and its bootstrap interval over drivers.

    Args:
        rows: one row per episode; the episodes of one driver stay together.
    """
    drivers = rows.groupby(["recording", "follower_id"], observed=True)["rmspe"]
    errors, counts = 100.0 * drivers.sum().to_numpy(np.float64), drivers.size().to_numpy()
    drawn = weights(len(counts), 0)
    interval = bounds((drawn @ errors) / (drawn @ counts))
    return float(errors.sum() / counts.sum()), *interval


def figure_of_lengths(rows: pd.DataFrame) -> Figure:
    """Draw calibration errors by length and speed, and computing times, beside Fig. 4 of ALCC.

    Args:
        rows: one row per episode, mode and condition.
    """
    figure = new_figure(9.0, 3.4)
    by_length, by_speed, time = figure.subplots(1, 3, width_ratios=(4, 4, 3))
    base = rows[rows["condition"] == BASE]
    fifth = pd.qcut(base["mean_speed_mps"], 5)
    lengths = {float(x): rows[rows["condition"] == f"pieces of {x} s"] for x in SECONDS}
    speeds = {float(x["mean_speed_mps"].mean()): x for _, x in base.groupby(fifth, observed=True)}
    for mode, marker in (("local", "o"), ("global", "s")):
        look = {"color": COLOURS[mode], "marker": marker, "label": mode}
        for axis, parts in ((by_length, lengths), (by_speed, speeds)):
            value, low, high = np.array(
                [mean_error(part[part["mode"] == mode]) for part in parts.values()]
            ).T
            axis.fill_between(list(parts), low, high, color=COLOURS[mode], alpha=0.2, lw=0)
            axis.plot(list(parts), value, **look)
            axis.axhline(PAPER[mode][0], color=COLOURS[mode], ls=":", label=f"{mode}, paper")
            axis.set_ylim(0.0, 14.0)
        known = rows[rows["mode"] == mode].groupby("condition")["milliseconds"].mean()
        time.plot([1000.0 * PAPER[mode][1], known[ALONE], known[BASE]], range(3), ls="", **look)
    by_length.set(xlabel="length of the pieces [s]", ylabel="mean RMSPE [%]")
    by_speed.set(xlabel="mean speed, first 60 s [m/s]")
    time.set_yticks(range(3), ["paper", "here, one\nat a time", "here, all\nat once"])
    time.set(xscale="log", xlabel="computing time\nper driver [ms]", ylim=(2.5, -0.5))
    for axis in (by_length, by_speed, time):
        axis.tick_params(colors=INK, labelsize=9)
        unbox(axis)
    handles, names = by_length.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=4, frameon=False, fontsize=9)
    return figure
