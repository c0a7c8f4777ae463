"""The page of the main job: energy saved by strategy."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd

from lcc_rl.config.schemas import StudyConfig
from lcc_rl.config.words import RECORDED
from lcc_rl.figures.drawing import in_file
from lcc_rl.figures.page import Page
from lcc_rl.pieces import ExcessSpacing
from lcc_rl.results.names import in_words
from lcc_rl.results.render import for_print, full_rows
from lcc_rl.results.report import AGAINST, UNTRAINED, Report

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


def write_page(folder: str | Path, commands: Sequence[str], report: Report, size: str) -> Path:
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
    page = Page(folder)

    def figures(names: dict[str, str]) -> list[tuple[str, Path]]:
        paths = {page.folder / f"{name}.png": caption for name, caption in names.items()}
        return [(caption, path) for path, caption in paths.items() if path.exists()]

    words = f"{report.verdict}\n\n{report.note}"
    page.add("Results", words, [(size, for_print(report))], figures(RESULT_FIGURES))
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
            page.add(heading, figures=drawn)
    cells = [[label.strip(), *row] for label, row in full_rows(report)]
    columns = ["measure", *(in_words(str(name)) for name in report.table["strategy"])]
    every = pd.DataFrame(cells, columns=columns)
    page.add("All measures", tables=[("Means per strategy", every)])
    return page.write(MAIN_TITLE, commands)
