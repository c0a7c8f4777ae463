"""A study: its settings, and its tables and figures as files and on a Markdown page."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from lcc_rl.errors import require
from lcc_rl.figures.drawing import save
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import write_parquet
from lcc_rl.results.names import worded
from lcc_rl.results.render import as_markdown
from lcc_rl.settings import MOST_PARALLEL

RESULTS_PAGE = "results.md"


@dataclass(frozen=True)
class Study:
    """The settings of a study.

    Args:
        folder: the study's folder.
        recipe: ``experiment`` of every training; None for the defaults of the agent.
        seeds: number of trainings of every learned variant, numbered from 0.
        overrides: further settings of all runs, including data and calibration.
        jobs: number of parallel trainings.

    Raises:
        ConfigError: naming a setting that is out of range.
    """

    folder: Path
    recipe: str | None = None
    seeds: int = 8
    overrides: tuple[str, ...] = ()
    jobs: int = 2

    def __post_init__(self) -> None:
        for name, most in (("seeds", 10**6), ("jobs", MOST_PARALLEL)):
            given = getattr(self, name)
            require(1 <= given <= most, f"{name} must lie from 1 to {most}, got {given}")


class StudyResults:
    """Tables and figures of a study, written when they are added.

    Args:
        folder: folder of ``tables/<name>.parquet``, ``figures/<name>.png`` and ``results.md``.
        formats: further formats of the figures.
    """

    def __init__(self, folder: str | Path, formats: Iterable[str] = ()) -> None:
        self.folder, self.formats = Path(folder), tuple(formats)
        self.tables: dict[str, pd.DataFrame] = {}
        self.blocks: list[str] = []

    def table(self, name: str, caption: str, table: pd.DataFrame) -> None:
        """Write a table with a caption."""
        write_parquet(table, self.folder / "tables" / f"{name}.parquet")
        self.tables[name] = table
        self.blocks.append(f"**{caption}** (`{name}`)\n\n{as_markdown(worded(table))}")

    def figure(self, name: str, caption: str, figure: Figure) -> None:
        """Write a figure with a caption."""
        place = save(figure, self.folder / "figures" / f"{name}.png", formats=self.formats)
        self.blocks.append(f"![{caption}](figures/{place.name})\n\n{caption}")

    def write(self, title: str) -> None:
        """Write ``results.md`` with all tables and figures.

        Raises:
            ResultsError: if the page cannot be written.
        """
        with atomic_path(self.folder / RESULTS_PAGE) as temporary:
            text = "\n\n".join([f"# {title}", *self.blocks])
            temporary.write_text(f"{text}\n", encoding="utf-8")
