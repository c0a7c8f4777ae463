"""Creating, styling and saving figures."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lcc_rl.io.atomic import atomic_path


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure that needs no display; sizes in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def unbox(axis: Axes) -> None:
    """Remove the top and right line of the frame."""
    axis.spines[["top", "right"]].set_visible(False)


def save(figure: Figure, path: str | Path, dpi: int = 150) -> Path:
    """Write a figure atomically; the format follows the file's suffix.

    Raises:
        ResultsError: if the file cannot be written.
    """
    path = Path(path)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=dpi, format=path.suffix.lstrip(".") or "png")
    return path
