"""Creating, styling and saving figures."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lcc_rl.io.atomic import atomic_path

INK = "#222222"


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure that needs no display; sizes in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def unbox(axis: Axes) -> None:
    """Remove the top and right line of the frame."""
    axis.spines[["top", "right"]].set_visible(False)


def legend_above(axis: Axes, columns: int = 3) -> None:
    """Put the legend above the frame, where it covers no data."""
    axis.legend(
        frameon=False,
        fontsize=9,
        ncols=columns,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        borderaxespad=0.2,
    )


def in_words(name: str) -> str:
    """Return a name as it is read aloud.

    Examples:
        >>> in_words("preview_10s"), in_words("cacc paper_like")
        ('preview 10 s', 'cacc paper like')
    """
    return re.sub(r"(?<=\d)s\b", " s", name.replace("_", " "))


def in_file(name: str) -> str:
    """Return a name as part of a file's: without spaces, or what would lead elsewhere."""
    return re.sub(r"[^\w.+-]", "_", name)


def save(figure: Figure, path: str | Path, dpi: int = 150, formats: Iterable[str] = ()) -> Path:
    """Write a figure atomically; the format follows the file's suffix.

    Args:
        figure: the figure.
        path: the file.
        dpi: pixels per inch of what is drawn as pixels.
        formats: further formats, each a file beside it (``figure_formats``).

    Returns:
        The path.

    Raises:
        ResultsError: if a file cannot be written.
    """
    path = Path(path)
    own = path.suffix.lstrip(".") or "png"
    targets = {own: path} | {kind: path.with_suffix(f".{kind}") for kind in formats if kind != own}
    for kind, target in targets.items():
        with atomic_path(target) as temporary:
            figure.savefig(temporary, dpi=dpi, format=kind)
    return path
