"""Creating, styling and saving figures."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.legend import Legend

from lcc_rl.config.words import FILTERED
from lcc_rl.io.atomic import atomic_path
from lcc_rl.results.names import in_words

INK, SOFT = "#222222", "#8a8a8a"
COLUMN_WIDTH, PAGE_WIDTH = 3.5, 7.2  # widths of one and two columns of a journal [in]
LABEL = 28  # most characters of a name in one line
INTERVAL: dict[str, Any] = {"lw": 1.5, "alpha": 0.6}  # look of the line along an interval
# Decorator of drawing functions: the look of all figures.
paper = mpl.rc_context(
    {
        "font.size": 8.0,
        "axes.titlesize": 8.0,
        "axes.titlelocation": "left",
        "axes.labelsize": 8.0,
        "figure.titlesize": 8.0,
        "legend.fontsize": 7.0,
        "legend.frameon": False,
        "legend.handlelength": 1.5,
        "legend.columnspacing": 1.5,
        "xtick.labelsize": 7.0,
        "ytick.labelsize": 7.0,
        "axes.linewidth": 0.6,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.axisbelow": True,
        "grid.color": "#e6e6e6",
        "grid.linewidth": 0.6,
        "xtick.major.width": 0.6,
        "ytick.major.width": 0.6,
        "lines.linewidth": 1.2,
        "lines.markersize": 4.0,
        "svg.fonttype": "none",
        "svg.hashsalt": "lcc_rl",  # equal pictures give equal files
        "pdf.fonttype": 42,
    }
)
# Distinguishable without colour vision and in grey. A filtered rule has its colour, dashed.
COLOURS = {
    "alcc": "#0072b2",
    "reference": "#d55e00",
    "own_energy": "#009e73",
    "rule": "#e69f00",
    "idm_acc": "#56b4e9",
    "acc": "#999933",
    "follower_stopper": "#cc6677",
    "pi_saturation": "#aa4499",
    "idm": "#6b6b6b",
    "human": "#b0a080",
    "direct": INK,
}
OWN_COLOURS = ("#cc79a7", "#882255", "#117733")  # of the user's controllers
SERIES = ("#56b4e9", "#009e73", "#e69f00", "#cc79a7")  # of ordered values, such as shares


def colour(strategy: str) -> str:
    """Return the colour of a strategy in all figures."""
    strategy = strategy.removesuffix(FILTERED)
    return COLOURS.get(strategy) or OWN_COLOURS[sum(strategy.encode()) % len(OWN_COLOURS)]


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure that needs no display; sizes in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def footnote(figure: Figure, text: str) -> None:
    """Write a note below a figure."""
    figure.supxlabel(text, fontsize=7, color=INK)


def legend_above(axis: Axes, columns: int = 3) -> Legend:
    """Put the legend above the frame."""
    return axis.legend(
        ncols=columns, loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2
    )


def lines_of(name: str) -> str:
    """Return a strategy's name in words, in at most two lines."""
    return fill(in_words(name), LABEL, max_lines=2, placeholder="…")


def rows_of(axis: Axes, names: Sequence[str]) -> None:
    """Label the rows of a chart, the first at the top; empty names have no label."""
    axis.set_yticks(range(len(names)), [lines_of(name) for name in names])
    axis.set_ylim(len(names) - 0.4, -0.6)


def dots(
    axis: Axes,
    places: Sequence[float] | np.ndarray,
    table: pd.DataFrame,
    column: str,
    hue: str,
    upright: bool = False,
    **look: Any,
) -> None:
    """Draw a dot per row and a line along its interval.

    Args:
        places: position of every row, on the vertical axis or, if upright, the horizontal one.
        table: rows with the columns ``<column>``, ``<column>_low`` and ``<column>_high``.
        axis, column: the axes to draw on, and the name of the column.
        hue: colour of dots and lines.
        upright: draw vertical lines.
        look: options of the dots, for ``Axes.plot``.
    """
    low, high = (table[f"{column}_{end}"].to_numpy(float) for end in ("low", "high"))
    draw = axis.vlines if upright else axis.hlines
    draw(places, low, high, color=hue, **INTERVAL)
    pair = (places, table[column]) if upright else (table[column], places)
    axis.plot(*pair, "o", color=hue, **look)


def in_file(name: str) -> str:
    """Return a name for use in a file name: without spaces and separators of paths."""
    return re.sub(r"[^\w.+-]", "_", name)


@paper
def save(figure: Figure, path: str | Path, dpi: int = 200, formats: Iterable[str] = ()) -> Path:
    """Write a figure atomically; the format follows the file's suffix.

    Args:
        figure, path: the figure and its file.
        dpi: pixels per inch of raster graphics.
        formats: further formats, each in its own file (``figure_formats``).

    Returns:
        The path.

    Raises:
        ResultsError: if a file cannot be written.
    """
    path = Path(path)
    logging.getLogger("fontTools").setLevel(logging.WARNING)  # it logs every glyph of a PDF
    for suffix in dict.fromkeys([path.suffix or ".png", *(f".{kind}" for kind in formats)]):
        with atomic_path(path if suffix == path.suffix else path.with_suffix(suffix)) as temporary:
            figure.savefig(temporary, dpi=dpi, format=suffix[1:])
    return path
