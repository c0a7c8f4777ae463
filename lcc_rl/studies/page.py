"""The page of a study, with every table and figure also as a file in the study's folder."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from lcc_rl.errors import ResultsError
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import write_parquet
from lcc_rl.results.drawing import save
from lcc_rl.results.report import Section, as_markdown, made, write_report
from lcc_rl.studies.runner import read_notes

MARKED = re.compile(r"(<!-- table: (\w+) -->).*?(<!-- end -->)", re.DOTALL)


class Page:
    """Sections of a study's page; tables and figures are written when a section is added.

    Args:
        folder: the study's folder.
        formats: further formats of the figures, as files only.
    """

    def __init__(self, folder: str | Path, formats: Iterable[str] = ()) -> None:
        self.folder, self.formats = Path(folder), tuple(formats)
        self.sections: list[Section] = []
        self.tables: dict[str, pd.DataFrame] = {}

    def add(
        self,
        heading: str,
        text: str,
        tables: Iterable[tuple[str, str, pd.DataFrame]] = (),
        figures: Iterable[tuple[str, str, Figure]] = (),
    ) -> None:
        """Add a section.

        Args:
            heading: its title.
            text: plain paragraphs, separated by blank lines.
            tables: name, caption and rows; written to ``tables/<name>.parquet``.
            figures: name, caption and figure; written to ``figures/<name>.png``.

        Raises:
            ResultsError: if a file cannot be written.
        """
        shown, drawn = [], []
        for name, caption, frame in tables:
            write_parquet(frame, self.folder / "tables" / f"{name}.parquet")
            shown.append((caption, frame))
            self.tables[name] = frame
        for name, caption, figure in figures:
            place = self.folder / "figures" / f"{name}.png"
            drawn.append((caption, save(figure, place, dpi=130, formats=self.formats)))
        self.sections.append(Section(heading, text, shown, drawn))

    def fill(self, page: Path) -> None:
        """Write tables into a Markdown file, between ``<!-- table: name -->`` and ``<!-- end -->``.

        Raises:
            ResultsError: if a marked table is none of the page's, or the file cannot be written.
        """

        def table(found: re.Match[str]) -> str:
            begin, name, end = found.groups()
            if name not in self.tables:
                raise ResultsError(f"{page}: no table {name!r}; known: {', '.join(self.tables)}")
            return f"{begin}\n\n{as_markdown(self.tables[name])}\n\n{end}"

        text = MARKED.sub(table, page.read_text())
        with atomic_path(page) as part:
            part.write_text(text)

    def write(self, title: str, details: Sequence[tuple[str, str]], more: str = "") -> Path:
        """Add how the study was made, and write ``report.html``.

        Args:
            title: the page's title.
            details: title and long text of what is folded away.
            more: further paragraphs of the last section.

        Returns:
            The page's path.

        Raises:
            ResultsError: if the page cannot be written.
        """
        commands = read_notes(self.folder).get("commands", [])
        runs = self.folder.rglob("training.parquet")
        self.sections.append(made(commands, details, runs, more))
        return write_report(self.folder, title, self.sections)
