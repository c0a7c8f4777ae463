"""Figures of trainings: what is learned, and limits kept, over the episodes (ALCC Fig. 6)."""

from __future__ import annotations

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcc_rl.results.drawing import in_words, legend_above, new_figure
from lcc_rl.results.figures import colour, style
from lcc_rl.results.intervals import band

WINDOW = 10  # iterations of the rolling mean
SHARE = "share_"  # prefix of the columns of limits
# What is missed in a limit's share of the time.
LIMITS = {
    "safety": "unsafe time-to-collision",
    "efficiency": "long time gap",
    "gap": "long gap",
    "time_gap": "short time gap",
}


def training_figure(training: pd.DataFrame) -> Figure:
    """What a training minimises, and how it keeps its limits; without limits the reward.

    Args:
        training: rows of training.parquet of one or more runs, with ``variant``, ``seed`` and
            their settings (:func:`lcc_rl.results.load`).
    """
    limits = [str(name) for name in training if str(name).startswith(SHARE)]
    limits = [name for name in limits if training[name].notna().any()]
    if not limits:
        return learning_curve(training)
    figure = new_figure(9.0, 3.8)
    axes = figure.subplots(1, 1 + len(limits))
    for variant, rows in training.groupby("variant", sort=False):
        label = draw_curve(axes[0], rows, "loss_actor", str(variant))[1]
        axes[0].lines[-1].set_label(label)
        for axis, name in zip(axes[1:], limits, strict=True):
            draw_curve(axis, rows.assign(percent=100.0 * rows[name]), "percent", str(variant))
    style(axes[0], "training episodes", "objective, less is better")
    legend_above(axes[0], 1)
    for axis, name in zip(axes[1:], limits, strict=True):
        what = name.removeprefix(SHARE)
        _limit(axis, training.get(f"agent.limits.{what}"))
        style(axis, "training episodes", f"{LIMITS.get(what, what)} [% of the time]")
    return figure


def _limit(axis: Axes, limits: pd.Series | None) -> None:
    """Mark the limit of all runs, where they have the same."""
    if limits is None or limits.nunique() != 1:
        return
    percent = 100.0 * float(limits.iloc[0])
    axis.axhline(percent, color="#222222", lw=0.8, ls="--", label=f"limit {percent:g} %")
    axis.set_ylim(0.0, max(4.0 * percent, 1e-3))  # the first batches would set the scale
    legend_above(axis)


def learning_curve(training: pd.DataFrame) -> Figure:
    """Episode reward over episodes, see :func:`draw_curve` (Fig. 6).

    Args:
        training: rows of training.parquet of one or more runs, with ``variant`` and ``seed``.
    """
    figure = new_figure(7.0, 4.0)
    axis = figure.subplots()
    floor = 0.0
    for variant, rows in training.groupby("variant", sort=False):
        mean, label = draw_curve(axis, rows, "episode_reward", str(variant))
        axis.lines[-1].set_label(label)
        floor = min(floor, float(mean.iloc[len(mean) // 5 :].min()))
    # The first, random episodes would set the scale.
    axis.set_ylim(bottom=1.6 * floor - 1.0)
    style(axis, "training episodes", "mean reward per episode")
    title = f"Learning curve, rolling mean of {WINDOW} batches, exploration noise included"
    figure.suptitle(title, fontsize=10)
    legend_above(axis, 2)
    return figure


def draw_curve(axis: Axes, rows: pd.DataFrame, column: str, variant: str) -> tuple[pd.Series, str]:
    """Draw the rolling mean of one variant's column with a band.

    Of several seeds the line is the mean and the band its 95 % bootstrap interval, as far as all
    seeds have trained; of one seed the band spans the 5th to 95th percentile of the window.

    Returns:
        The line, and a label with the number of seeds.
    """
    curves = rows.pivot_table(index="episodes", columns="seed", values=column).dropna()
    smooth = curves.rolling(WINDOW, min_periods=1)
    line = smooth.mean().mean(axis=1)
    if curves.shape[1] > 1:
        low, high = band(smooth.mean().to_numpy(float))
        label = f"{in_words(variant)} (n = {curves.shape[1]} seeds, 95 % band)"
    else:
        low, high = (smooth.quantile(q).iloc[:, 0].to_numpy(float) for q in (0.05, 0.95))
        label = f"{in_words(variant)} (1 seed; band: 5–95 % of {WINDOW} batches)"
    axis.fill_between(line.index, low, high, color=colour(variant), alpha=0.2, lw=0)
    axis.plot(line.index, line, color=colour(variant))
    return line, label
