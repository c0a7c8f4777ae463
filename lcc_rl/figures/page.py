"""One self-contained HTML page from text, tables and figures, without scripts or network."""

from __future__ import annotations

import base64
import platform
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader
from matplotlib.figure import Figure
from PIL import Image  # comes with matplotlib

from lcc_rl.errors import ResultsError
from lcc_rl.figures.drawing import save
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import PROCESSOR, parquet_metadata, write_parquet
from lcc_rl.results.cells import as_markdown, columns
from lcc_rl.results.names import worded

MARKED = re.compile(r"(<!-- table: (\w+) -->).*?(<!-- end -->)", re.DOTALL)
PACKAGES = ("lcc_rl", "torch", "torchrl", "tensordict", "numpy", "pandas", "scipy", "matplotlib")


class Page:
    """A page of results; its tables and figures are also written as files.

    Args:
        folder: gets ``report.html``, ``tables/<name>.parquet`` and ``figures/<name>.png``.
        formats: further formats of the figures, as files only.
    """

    def __init__(self, folder: str | Path, formats: Iterable[str] = ()) -> None:
        self.folder, self.formats = Path(folder), tuple(formats)
        self.tables: dict[str, pd.DataFrame] = {}
        self.sections: list[dict[str, Any]] = []

    def add(
        self,
        heading: str,
        text: str = "",
        tables: Iterable[tuple[str, str, pd.DataFrame]] = (),
        figures: Iterable[tuple[str, str, Figure | Path]] = (),
        details: Sequence[tuple[str, str]] = (),
    ) -> None:
        """Add a section.

        Args:
            heading: its title.
            text: plain paragraphs, separated by blank lines.
            tables: name, caption and rows, see :func:`lcc_rl.results.cells.columns`; a table
                without a name is not written as a file.
            figures: name, caption and the figure, or the file of a figure that is drawn already.
            details: titles and long texts, folded away.
        """
        shown, drawn = [], []
        for name, caption, frame in tables:
            if name:
                write_parquet(frame, self.folder / "tables" / f"{name}.parquet")
                self.tables[name] = frame
            shown.append((_line(caption), columns(worded(frame))))
        for name, caption, figure in figures:
            if isinstance(figure, Figure):
                place = self.folder / "figures" / f"{name}.png"
                figure = save(figure, place, dpi=130, formats=self.formats)
            drawn.append((_line(caption), _webp(figure)))
        paragraphs = [_line(part) for part in text.split("\n\n") if part.strip()]
        section = {"heading": heading, "paragraphs": paragraphs, "tables": shown}
        self.sections.append(section | {"figures": drawn, "details": details})

    def fill(self, page: Path) -> None:
        """Write tables into a Markdown file, between ``<!-- table: name -->`` and ``<!-- end -->``.

        Raises:
            ResultsError: if the page has no table of a marked name, or the file cannot be written.
        """

        def table(found: re.Match[str]) -> str:
            begin, name, end = found.groups()
            if name not in self.tables:
                raise ResultsError(f"{page}: no table {name!r}; known: {', '.join(self.tables)}")
            return f"{begin}\n\n{as_markdown(worded(self.tables[name]))}\n\n{end}"

        text = MARKED.sub(table, page.read_text(encoding="utf-8"))
        with atomic_path(page) as part:
            part.write_text(text, encoding="utf-8")

    def write(
        self,
        title: str,
        commands: Sequence[str] = (),
        details: Sequence[tuple[str, str]] = (),
        more: str = "",
    ) -> Path:
        """Add how the results were made, and write ``report.html``.

        Args:
            title: the page's title.
            commands: the commands, oldest first, with dates if they are known.
            details: titles and long texts of the last section, folded away.
            more: further paragraphs of the last section.

        Returns:
            The page's path.

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
        made = [("", "Versions that wrote this page", versions)]
        self.add("How it was made", text + more, made, details=[*listing, *details])
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
