"""A self-contained HTML page of text, tables and figures."""

from __future__ import annotations

import base64
import platform
from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader
from PIL import Image  # comes with matplotlib

from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import PROCESSOR, parquet_metadata
from lcc_rl.results.names import worded
from lcc_rl.results.render import columns

PACKAGES = ("lcc_rl", "torch", "torchrl", "tensordict", "numpy", "pandas", "scipy", "matplotlib")


class Page:
    """A page of results, without scripts or network.

    Args:
        folder: folder of ``report.html``.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.sections: list[dict[str, Any]] = []

    def add(
        self,
        heading: str,
        text: str = "",
        tables: Iterable[tuple[str, pd.DataFrame]] = (),
        figures: Iterable[tuple[str, Path]] = (),
        details: Sequence[tuple[str, str]] = (),
    ) -> None:
        """Add a section.

        Args:
            heading: its title.
            text: plain paragraphs, separated by blank lines.
            tables: caption and rows, see :func:`lcc_rl.results.render.columns`.
            figures: caption and file.
            details: titles and long texts, collapsed.
        """
        shown = [(_line(caption), columns(worded(frame))) for caption, frame in tables]
        drawn = [(_line(caption), _webp(path)) for caption, path in figures]
        paragraphs = [_line(part) for part in text.split("\n\n") if part.strip()]
        section = {"heading": heading, "paragraphs": paragraphs, "tables": shown}
        self.sections.append(section | {"figures": drawn, "details": details})

    def write(self, title: str, commands: Sequence[str] = ()) -> Path:
        """Add the origin of the results, and write ``report.html``.

        Args:
            title: title of the page.
            commands: the commands, oldest first.

        Returns:
            The path of the page.

        Raises:
            ResultsError: if the page cannot be written.
        """
        rows = [(name, version(name)) for name in PACKAGES]
        rows += [("Python", platform.python_version()), ("machine", platform.machine())]
        written = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
        text = f"This page was written on {written} from parquet files alone."
        runs = sorted(self.folder.rglob("training.parquet"))
        places = Counter(parquet_metadata(run).get(PROCESSOR, "not recorded") for run in runs)
        if places:
            counted = (f"{place} ({count})" for place, count in places.most_common())
            text += f" Its trainings ran on: {', '.join(counted)}."
        versions = pd.DataFrame(rows, columns=["package", "version"])
        listing = [("Commands", "\n".join(commands))] if commands else []
        made = [("Versions that wrote this page", versions)]
        self.add("How it was made", text, made, details=listing)
        pages = Environment(
            loader=PackageLoader("lcc_rl", "assets"), autoescape=True, trim_blocks=True
        )
        path = self.folder / "report.html"
        with atomic_path(path) as temporary:
            template = pages.get_template("page.html")
            html = template.render(title=title, sections=self.sections)
            temporary.write_text(html, encoding="utf-8")
        return path


def _line(text: str) -> str:
    return " ".join(text.split())


def _webp(path: Path) -> str:
    """Return a picture as lossless WebP in Base64, a third of the size of a PNG."""
    buffer = BytesIO()
    with Image.open(path) as image:
        image.save(buffer, "WEBP", lossless=True, exact=True)
    return base64.b64encode(buffer.getvalue()).decode()
