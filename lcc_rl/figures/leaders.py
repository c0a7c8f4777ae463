"""Figures that compare the leaders of two sets of trajectories."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lcc_rl.data.statistics import UNITS, WINDOW_S, motion
from lcc_rl.errors import ConfigError
from lcc_rl.figures.drawing import new_figure, save, style

COLOURS = ("#1b6ca8", "#d1661f")  # blue and orange, distinct without red-green vision and in grey
QUANTITIES = {  # label, what is counted, and number of bins: there are far fewer windows
    "speed": ("leader speed", "samples", 40),
    "acceleration": ("leader acceleration", "samples", 40),
    "energy": (f"leader energy in {WINDOW_S:.0f} s", "windows", 20),
}
TAIL = 0.003  # share cut off at either end of a histogram, so that outliers do not set the scale
TRACES = 4
TRACE_S = 90.0


def figure_leaders(sets: Mapping[str, pd.DataFrame]) -> Figure:
    """Draw the distributions of the leaders' motion, and some of their speed traces.

    Args:
        sets: two named episode tables, see :func:`lcc_rl.data.statistics.motion`; the first is
            drawn filled.

    Returns:
        A figure with three distributions above and traces of each set below; the traces are of
        episodes spread evenly over the order of their mean speed.
    """
    figure = new_figure(10.0, 6.2)
    above, below = np.asarray(figure.subfigures(2, 1)).flat
    motions = {name: motion(episodes) for name, episodes in sets.items()}
    for axis, quantity in zip(above.subplots(1, 3).flat, UNITS, strict=True):
        _distribution(axis, quantity, {name: found[quantity] for name, found in motions.items()})
    panels = below.subplots(1, 2, sharex=True, sharey=True).flat
    for axis, (name, episodes), colour in zip(panels, sets.items(), COLOURS, strict=True):
        _traces(axis, name, episodes, colour)
    panels[0].set_ylabel("leader speed [m/s]")
    panels[0].set_ylim(bottom=0.0)
    panels[0].set_xlim(0.0, TRACE_S)
    return figure


def save_leaders(sets: Mapping[str, pd.DataFrame], path: str | Path) -> None:
    """Write the figure of :func:`figure_leaders`.

    Args:
        sets: two named episode tables.
        path: destination; its ending chooses the format (png, pdf, svg).

    Raises:
        ConfigError: if the ending is no format.
        DataError: if a table lacks a column or has no episode.
        ResultsError: if the file cannot be written.
    """
    figure = figure_leaders(sets)
    known = figure.canvas.get_supported_filetypes()
    if Path(path).suffix.lstrip(".") not in known:
        raise ConfigError(f"{path}: the ending must be one of {', '.join(sorted(known))}")
    save(figure, path)


def _distribution(axis: Axes, quantity: str, values: Mapping[str, NDArray[np.float64]]) -> None:
    """Draw the densities of one quantity in both sets."""
    (label, counted, bins), unit = QUANTITIES[quantity], UNITS[quantity]
    both = np.concatenate(list(values.values()))
    low, high = np.quantile(both, TAIL), np.quantile(both, 1.0 - TAIL)
    edges = np.linspace(low, high, bins + 1).tolist()
    looks = ({"histtype": "stepfilled", "alpha": 0.45}, {"histtype": "step", "alpha": 1.0})
    for (name, found), colour, look in zip(values.items(), COLOURS, looks, strict=True):
        named = f"{name}, {len(found):,} {counted}"
        axis.hist(found, edges, density=True, color=colour, lw=1.6, label=named, **look)  # type: ignore[arg-type]
    inverse = f"1/({unit})" if "/" in unit else f"1/{unit}"
    style(axis, f"{label} [{unit}]", f"density [{inverse}]")
    axis.set_ylim(top=1.3 * axis.get_ylim()[1])  # room for the legend
    axis.legend(frameon=False, fontsize="small", loc="upper right")


def _traces(axis: Axes, name: str, episodes: pd.DataFrame, colour: str) -> None:
    """Draw speed traces of a few leaders."""
    groups = episodes.groupby("episode" if "episode" in episodes.columns else "event")
    order = groups["leader_speed_mps"].mean().sort_values(kind="stable").index
    places = (np.arange(TRACES) + 0.5) / TRACES * len(order)
    chosen = list(dict.fromkeys(order[places.astype(int)]))
    for rank, episode in enumerate(chosen):
        trace = groups.get_group(episode)
        time = trace["time_s"] - trace["time_s"].iloc[0]
        shade = 1.0 - 0.6 * rank / max(len(chosen) - 1, 1)
        axis.plot(time, trace["leader_speed_mps"], color=colour, alpha=shade, linewidth=1.3)
    axis.set_title(f"{name}: {len(chosen)} of {len(order)} leaders", fontsize="medium")
    style(axis, "time since the episode began [s]")
