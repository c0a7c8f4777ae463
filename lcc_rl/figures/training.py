"""Figures of trainings: objective and limits over episodes (ALCC Fig. 6)."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcc_rl.figures.drawing import (
    COLUMN_WIDTH,
    INK,
    PAGE_WIDTH,
    colour,
    footnote,
    legend_above,
    new_figure,
    paper,
)
from lcc_rl.results.intervals import band
from lcc_rl.results.names import in_words, several

ROLLING = 10  # iterations of the rolling mean
BAND_NOTE = (
    f"band: 95 % interval over seeds;\nfor one seed 5th to 95th percentile of {ROLLING} batches"
)
LIMIT_PREFIX = "share_"  # prefix of the columns of limits
# Subjects of the limits' shares of the time.
LIMIT_LABELS = {
    "safety": "unsafe time-to-collision",
    "efficiency": "long time gap",
    "gap": "long gap",
    "time_gap": "short time gap",
}


@paper
def training_figure(training: pd.DataFrame) -> Figure:
    """Draw the objective and the limits of a training; without limits the reward.

    Args:
        training: rows of training.parquet of one or more runs, with ``variant``, ``seed`` and
            their settings (:func:`lcc_rl.results.load`).
    """
    held = [name for name in map(str, training) if name.startswith(LIMIT_PREFIX)]
    if not held:
        return learning_curve(training)
    limits = [name for name in held if training[name].fillna(0.0).any()]
    figure = new_figure(PAGE_WIDTH if limits else COLUMN_WIDTH, 2.7)
    first, *others = figure.subplots(1, 1 + len(limits), squeeze=False)[0]
    draw_curves(first, training, "loss_actor")
    first.set(xlabel="training episodes", ylabel="objective, less is better")
    legend_above(first, 1)
    for axis, name in zip(others, limits, strict=True):
        draw_curves(axis, training.assign(percent=100.0 * training[name]), "percent")
        top = 0.0  # without the first fifth, which would set the scale
        for line in axis.lines:
            line.set_label("")
            values = np.asarray(line.get_ydata(), float)
            top = max(top, float(values[len(values) // 5 :].max()))
        what = name.removeprefix(LIMIT_PREFIX)
        bound = training.get(f"limit_{what}")
        if bound is not None and bound.nunique() == 1:  # all runs have the same limit
            percent = 100.0 * float(bound.iloc[0])
            axis.axhline(percent, color=INK, lw=0.8, ls="--", label=f"limit {percent:.3g} %")
            legend_above(axis)
            top = max(top, percent)
        axis.set_ylim(0.0, max(1.2 * top, 1e-3))
        axis.set(xlabel="training episodes")
        axis.set(ylabel=f"{LIMIT_LABELS.get(what, what)} [% of the time]")
    never = [
        LIMIT_LABELS.get(name.removeprefix(LIMIT_PREFIX), name)
        for name in held
        if name not in limits
    ]
    footnote(figure, "\n".join([BAND_NOTE, *(f"{what}: in no batch" for what in never)]))
    return figure


@paper
def learning_curve(training: pd.DataFrame) -> Figure:
    """Draw the episode reward over episodes, see :func:`draw_curves` (Fig. 6).

    Args:
        training: rows of training.parquet of one or more runs, with ``variant`` and ``seed``.
    """
    figure = new_figure(COLUMN_WIDTH, 2.7)
    axis = figure.subplots()
    floor, _ = draw_curves(axis, training, "episode_reward")
    axis.set_ylim(bottom=1.25 * floor - 0.1)
    axis.set(xlabel="training episodes")
    axis.set(ylabel=f"mean reward per episode\n(rolling mean of {ROLLING} batches)")
    legend_above(axis, 1)
    footnote(figure, BAND_NOTE)
    return figure


def draw_curves(axis: Axes, training: pd.DataFrame, column: str) -> tuple[float, float]:
    """Draw the rolling mean of every variant's column with a band.

    With several seeds the line is the mean and the band its 95 % t-interval, up to the
    shortest training. With one seed the band spans the 5th to 95th percentile of the window.

    Returns:
        Limits of the scale: the least value after the first fifth, which is random, at most 0; and
        the largest value, at least 0.
    """
    floor = top = 0.0
    for variant, rows in training.groupby("variant", sort=False):
        if rows[column].isna().all():
            continue
        curves = rows.pivot_table(index="episodes", columns="seed", values=column).dropna()
        smooth = curves.rolling(ROLLING, min_periods=1)
        line = smooth.mean().mean(axis=1)
        count = curves.shape[1]
        if count > 1:
            low, high = band(smooth.mean().to_numpy(float))
        else:
            low, high = (smooth.quantile(q).iloc[:, 0].to_numpy(float) for q in (0.05, 0.95))
        label = f"{in_words(str(variant))} ({several(count, 'seed')})"
        axis.fill_between(line.index, low, high, color=colour(str(variant)), alpha=0.2, lw=0)
        axis.plot(line.index, line, color=colour(str(variant)), label=label)
        floor = min(floor, float(line.iloc[len(line) // 5 :].min()))
        top = max(top, float(line.max()))
    return floor, top
