"""Space-time diagrams: positions of all vehicles of a string, coloured by speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from lcc_rl.errors import ResultsError
from lcc_rl.figures.drawing import COLUMN_WIDTH, PAGE_WIDTH, lines_of, new_figure, paper
from lcc_rl.functional.pattern import HUMAN
from lcc_rl.results.motion import SampleMotion, most_varied, motion_of, sample_episodes

FEWEST = 3  # least number of vehicles
POINT_STEPS = 5  # steps between the points of a line
MOST_PANELS = 3  # panels
RIMS = {True: "controlled cars", False: "human drivers"}  # the group with fewer vehicles
# From red (standing) to blue (driving): distinguishable without colour vision, and never white.
SPEED_COLOURS = LinearSegmentedColormap.from_list(
    "speed", ["#a50f15", "#f0a202", "#2ca25f", "#08519c"]
)


@paper
def space_time(
    steps: pd.DataFrame, names: Sequence[str], cfg: Mapping[str, Any], every: int = POINT_STEPS
) -> Figure | None:
    """Draw positions over time of one sample episode, a panel per strategy.

    Lines of controlled vehicles have a black rim, or of human drivers if most are controlled.

    Args:
        steps: rows of steps.parquet.
        names: strategies; the first :data:`MOST_PANELS` with the whole string are shown.
        cfg: the evaluation's configuration.
        every: rows between the points of a line.

    Returns:
        The figure; None for strings with fewer than :data:`FEWEST` vehicles.
    """
    found, episode = {}, most_varied(steps)
    for name in names:
        try:
            rows = next(iter(sample_episodes(episode, name).values()))
            found[name] = motion_of(rows, cfg["scenario"]).at(slice(None, None, every))
        except ResultsError:  # the strategy lacks this episode
            continue
    most = max((len(motion.roles) for motion in found.values()), default=0)
    # Strategies with the whole string.
    whole = {name: m for name, m in found.items() if len(m.roles) == most >= FEWEST}
    return side_by_side(dict([*whole.items()][:MOST_PANELS])) if whole else None


@paper
def side_by_side(motions: Mapping[str, SampleMotion], high: float = 2.6) -> Figure:
    """Return a diagram of each motion, by title; ``high``: height in inches."""
    speeds = np.concatenate([motion.speed.ravel() for motion in motions.values()])
    low, top = float(speeds.min()), float(speeds.max())
    scale = (low if low > 0.3 * top else 0.0, top)  # a narrower scale if no car nearly stops
    figure = new_figure(COLUMN_WIDTH if len(motions) == 1 else PAGE_WIDTH, high)
    axes = figure.subplots(1, len(motions), sharey=True, squeeze=False)[0]
    for axis, (name, motion) in zip(axes, motions.items(), strict=True):
        lines = _panel(axis, motion, scale)
        axis.set_title(lines_of(name))
        axis.set_xlabel("time [s]")
        axis.grid(visible=False)
    axes[0].set_ylabel("position [m]")
    first = next(iter(motions.values()))
    rims = f"\nblack rim: places of {RIMS[_few(first)]}" if len(set(first.roles)) > 1 else ""
    figure.colorbar(lines, ax=axes, label=f"speed [m/s]{rims}")
    return figure


def _few(motion: SampleMotion) -> bool:
    """Whether at least half of the vehicles have human drivers."""
    return 2 * motion.roles.count(HUMAN) >= len(motion.roles)


def _panel(axis: Axes, motion: SampleMotion, scale: tuple[float, float]) -> LineCollection:
    """Draw the lines of all vehicles; return them for the colour bar."""
    around = motion.circumference or np.inf
    shown = motion.position if np.isinf(around) else motion.position % around
    for vehicle, role in enumerate(motion.roles):
        points = np.stack([motion.time, shown[:, vehicle]], -1)
        parts = np.stack([points[:-1], points[1:]], 1)
        whole = np.abs(parts[:, 1, 1] - parts[:, 0, 1]) < 0.5 * around
        framed = (role != HUMAN) == _few(motion)
        above = 3 if framed else 2  # other lines do not cover the rim
        if framed:
            frame = LineCollection(list(parts[whole]), colors="black", linewidths=2.0, zorder=above)
            axis.add_collection(frame)
        lines = LineCollection(list(parts[whole]), cmap=SPEED_COLOURS, linewidths=0.8, zorder=above)
        lines.set_array(motion.speed[:-1, vehicle][whole])
        lines.set_clim(*scale)
        axis.add_collection(lines)
    axis.autoscale_view()
    return lines
