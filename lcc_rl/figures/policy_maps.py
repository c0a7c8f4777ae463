"""Maps of policies: acceleration over gap and relative speed, beside a tuned rule."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial import ConvexHull, QhullError

from lcc_rl.errors import ResultsError
from lcc_rl.figures.drawing import INK, footnote, legend_above, new_figure, paper, unbox
from lcc_rl.figures.platoon import PARENTS, WHO_DRIVES
from lcc_rl.results.motion import motion_of, sample_episodes, visited
from lcc_rl.results.names import in_words

NEAR = 1.0  # of a map's speed: what an outline shows [m/s]
NOTE = f"black line: no acceleration; dashed: what the sample episodes visit within {NEAR:g} m/s"
LEVELS = 24  # of the accelerations


def policy_maps(
    rows: pd.DataFrame, steps: pd.DataFrame, cfg: Mapping[str, Any]
) -> Iterator[tuple[str, Figure]]:
    """Yield name and figure of the maps of an evaluation.

    Args:
        rows: of responses.parquet.
        steps: rows of steps.parquet, whose sample episodes are outlined.
        cfg: the evaluation's configuration.
    """
    yield "policy_map", accelerations(rows, steps, cfg)
    if "winner" in rows and rows["winner"].notna().any():
        yield "policy_map_switching", winners(rows)


@paper
def accelerations(rows: pd.DataFrame, steps: pd.DataFrame, cfg: Mapping[str, Any]) -> Figure:
    """Acceleration over gap and relative speed, a row per strategy, a column per speed.

    Args:
        rows: of responses.parquet.
        steps: rows of steps.parquet, whose sample episodes are outlined.
        cfg: the evaluation's configuration.
    """
    limit = float(rows["acceleration_mps2"].abs().max())
    levels = np.linspace(-limit, limit, LEVELS + 1)
    figure, panels = _panels(rows)
    for axis, name, speed, part in panels:
        x, y, z = _grid(part, "acceleration_mps2")
        filled = axis.contourf(x, y, z, levels, cmap="RdBu")
        filled.set_edgecolor("face")  # no seams in vector formats
        if np.nanmin(z) < 0.0 < np.nanmax(z):
            axis.contour(x, y, z, [0.0], colors=INK, linewidths=1.0)
        outline = _outline(steps, name, speed, cfg)
        if outline is not None:
            axis.plot(outline[:, 0], outline[:, 1], color=INK, ls="--", lw=1.0)
            axis.set(xlim=(x.min(), x.max()), ylim=(0.0, y.max()))
    ticks = np.linspace(-limit, limit, 7)
    figure.colorbar(filled, ax=figure.axes, label="acceleration [m/s²]", ticks=ticks)
    footnote(figure, NOTE)
    return figure


@paper
def winners(rows: pd.DataFrame) -> Figure:
    """Draw which controller drives in a hybrid strategy over gap and relative speed.

    Args:
        rows: of responses.parquet.
    """
    figure, panels = _panels(rows[rows["winner"].notna()])
    for axis, _, _, part in panels:
        axis.pcolormesh(
            *_grid(part, "winner"), cmap=WHO_DRIVES, vmin=0.0, vmax=1.0, rasterized=True
        )
    for name, hue in PARENTS.items():
        figure.axes[0].plot([], [], "s", color=hue, label=name)
    legend_above(figure.axes[0])
    return figure


def _panels(rows: pd.DataFrame) -> tuple[Figure, list[tuple[Axes, str, float, pd.DataFrame]]]:
    """Return a figure, and panel, strategy, speed and rows of each map."""
    names = list(dict.fromkeys(rows["strategy"]))
    speeds = sorted(rows["speed_mps"].unique())
    figure = new_figure(1.0 + 3.1 * len(speeds), 0.7 + 1.6 * len(names))
    axes = figure.subplots(len(names), len(speeds), sharex=True, sharey=True, squeeze=False)
    panels = []
    for line, name in zip(axes, names, strict=True):
        for axis, speed in zip(line, speeds, strict=True):
            own = (rows["strategy"] == name) & (rows["speed_mps"] == speed)
            axis.set_title(f"{in_words(name)}, at {speed:g} m/s", loc="left")
            unbox(axis)
            panels.append((axis, name, float(speed), rows[own]))
        line[0].set_ylabel("gap [m]")
    for axis in axes[-1]:
        axis.set_xlabel("speed ahead − own speed [m/s]")
    return figure, panels


def _grid(rows: pd.DataFrame, column: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return relative speeds, gaps and a column as an image."""
    table = rows.pivot_table(index="gap_m", columns="relative_speed_mps", values=column)
    return table.columns.to_numpy(float), table.index.to_numpy(float), table.to_numpy(float)


def _outline(
    steps: pd.DataFrame, name: str, speed: float, cfg: Mapping[str, Any]
) -> np.ndarray | None:
    """Return the convex hull of what sample episodes visit near a speed, closed, ``[n, 2]``."""
    try:
        episodes = sample_episodes(steps, name).values()
        seen = np.concatenate([visited(motion_of(rows, cfg["scenario"])) for rows in episodes])
        points = seen[np.abs(seen[:, 0] - speed) <= NEAR][:, [2, 1]]
        corners = ConvexHull(points).vertices
    except (ResultsError, QhullError, ValueError):  # none, too few, or on a line
        return None
    closed: np.ndarray = points[[*corners, corners[0]]]
    return closed
