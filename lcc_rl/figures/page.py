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

from lcc_rl.config.schemas import StudyConfig
from lcc_rl.config.words import RECORDED
from lcc_rl.figures.drawing import in_file
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import PROCESSOR, parquet_metadata
from lcc_rl.pieces import ExcessSpacing
from lcc_rl.results.names import in_words, worded
from lcc_rl.results.render import columns, for_print, full_rows
from lcc_rl.results.report import AGAINST, UNTRAINED, Report
from lcc_rl.results.runs import RECORD

PACKAGES = ("lcc_rl", "torch", "torchrl", "tensordict", "numpy", "pandas", "scipy", "matplotlib")


def section(
    heading: str,
    text: str = "",
    tables: Iterable[tuple[str, pd.DataFrame]] = (),
    figures: Iterable[tuple[str, Path]] = (),
    details: Sequence[tuple[str, str]] = (),
) -> dict[str, Any]:
    """Return a section of a page.

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
    parts = {"heading": heading, "paragraphs": paragraphs, "tables": shown}
    return parts | {"figures": drawn, "details": details}


def write_sections(
    folder: Path, title: str, sections: Sequence[dict[str, Any]], commands: Sequence[str] = ()
) -> Path:
    """Write ``report.html``, without scripts or network; its end is the origin of the results.

    Args:
        folder, title: folder and title of the page.
        sections: values of the template's sections, in order.
        commands: the commands, oldest first.

    Raises:
        ResultsError: if the page cannot be written.
    """
    rows = [(name, version(name)) for name in PACKAGES]
    rows += [("Python", platform.python_version()), ("machine", platform.machine())]
    written = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    text = f"This page was written on {written} from parquet files alone."
    runs = sorted(folder.rglob(RECORD))
    places = Counter(parquet_metadata(run).get(PROCESSOR, "not recorded") for run in runs)
    if places:
        counted = (f"{place} ({count})" for place, count in places.most_common())
        text += f" Its trainings ran on: {', '.join(counted)}."
    versions = pd.DataFrame(rows, columns=["package", "version"])
    listing = [("Commands", "\n".join(commands))] if commands else []
    made = [("Versions that wrote this page", versions)]
    last = section("How it was made", text, made, details=listing)
    pages = Environment(loader=PackageLoader("lcc_rl", "assets"), autoescape=True, trim_blocks=True)
    with atomic_path(folder / "report.html") as temporary:
        html = pages.get_template("page.html").render(title=title, sections=[*sections, last])
        temporary.write_text(html, encoding="utf-8")
    return folder / "report.html"


def _line(text: str) -> str:
    return " ".join(text.split())


def _webp(path: Path) -> str:
    """Return a picture as lossless WebP in Base64, a third of the size of a PNG."""
    buffer = BytesIO()
    with Image.open(path) as image:
        image.save(buffer, "WEBP", lossless=True, exact=True)
    return base64.b64encode(buffer.getvalue()).decode()


# -- the page of the main job: energy saved by strategy --------------------------------------------

MAIN_TITLE = "lcc_rl: data → drivers → policies → results"
LIMIT = "efficiency"
HELD_TO = (
    f"The networks learn within a limit of long time gaps, agent.limits.{LIMIT}={{limit}} of the "
    "time; rows above this limit save by falling behind."
)
AS_RECORDED = (
    "The networks and the IDM tuned on these data are trained with the recorded drivers' {} as a "
    "limit."
)
# Files of figures in the job's folder, without ending, and their captions.
RESULT_FIGURES = {
    "evaluation/figures/overview": "A held-out episode, and the path energy per vehicle and km",
    "evaluation/figures/learning_curve": "The trainings: objective and limit",
}
DRIVER_FIGURES = {
    "calibration/calibration": "Calibrated drivers: error and parameters",
    "calibration/joint_distribution": "Desired speed and time gap of the drivers",
}


def held_to(trainings: Iterable[StudyConfig]) -> str:
    """Return a sentence on the limit of the trainings; empty without one."""
    agents = [cfg.agent.settings for cfg in trainings if cfg.agent is not None]
    found = [(agent.get("limits") or {}).get(LIMIT) for agent in agents]
    terms = [(agent.get("surrogates") or {}).get(LIMIT) for agent in agents]
    spacing = all(term is not None and term.kind is ExcessSpacing for term in terms)
    limits = sorted({f"{limit:.2g}" if limit != RECORDED else limit for limit in found if limit})
    if not limits:
        return ""
    what = "spacing, and so their flow," if spacing else "share of long time gaps"
    held = limits == [RECORDED]
    return AS_RECORDED.format(what) if held else HELD_TO.format(limit=", ".join(limits))


def write_page(folder: Path, commands: Sequence[str], report: Report, size: str) -> Path:
    """Write ``report.html`` of a job: headline, figures, drivers, commands and versions.

    Args:
        folder: the job's folder, with ``evaluation``, ``calibration`` and a folder per training.
        commands: the command lines.
        report: report of its evaluation.
        size: numbers of windows and drivers as text.

    Returns:
        The path of the page.

    Raises:
        ResultsError: if the page cannot be written.
    """

    def figures(names: dict[str, str]) -> list[tuple[str, Path]]:
        paths = {folder / f"{name}.png": caption for name, caption in names.items()}
        return [(caption, path) for path, caption in paths.items() if path.exists()]

    words = f"{report.verdict}\n\n{report.note}"
    sections = [section("Results", words, [(size, for_print(report))], figures(RESULT_FIGURES))]
    learned = [str(name) for name in report.short["strategy"] if name not in UNTRAINED]
    improvements = {
        f"evaluation/figures/improvement_{own}_vs_{in_file(name)}": (
            f"{in_words(own)} against {in_words(name)}, driver by driver"
        )
        for own in learned[-1:]
        for name in AGAINST
    }
    for heading, names in {"By driver": improvements, "Drivers": DRIVER_FIGURES}.items():
        if drawn := figures(names):
            sections.append(section(heading, figures=drawn))
    cells = [[label.strip(), *row] for label, row in full_rows(report)]
    columns = ["measure", *(in_words(str(name)) for name in report.table["strategy"])]
    every = pd.DataFrame(cells, columns=columns)
    sections.append(section("All measures", tables=[("Means per strategy", every)]))
    return write_sections(folder, MAIN_TITLE, sections, commands)
