"""The table and the page of the main job: who saves energy, within which limits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd
from rich.markup import escape
from rich.table import Table

from lcc_rl.config.schemas import StudyConfig
from lcc_rl.figures.drawing import in_file
from lcc_rl.figures.page import Page
from lcc_rl.io.files import read_parquet
from lcc_rl.results.cells import MISSING, column_cells
from lcc_rl.results.savings import UNTRAINED
from lcc_rl.results.tables import PATH, ROWS, summary

TITLE = "lcc_rl: data → drivers → policies → results"
WHO = {
    "idm": "one human driver (IDM)",
    "human": "human drivers of the data",
    "acc tuned": "cruise control, tuned",
    "idm tuned": "IDM as cruise control, tuned",
    "reference": "network, for its own energy",
    "alcc": "network, for the energy of both",
}
# Column of the summary, as a percentage, and its name in the table.
SHARES = {
    "unsafe_ttc_pct": "share_ttc_unsafe",
    "long_time_gap_pct": "share_time_gap_long_moving",
}
AGAINST = ("human", "idm tuned")
HEADINGS = {
    "who": "the car is driven by",
    "path_energy_kj": "path\nenergy\n[kJ]",
    "saved_against_human_pct": "saved against\nhuman drivers\n[%]",
    "saved_against_idm_tuned_pct": "saved against\ntuned IDM\n[%]",
    "unsafe_ttc_pct": "unsafe\nTTC\n[%]",
    "long_time_gap_pct": "long\ntime gap\n[%]",
    "collisions": "colli-\nsions",
}
CAPTION = (
    "Energy of both cars per episode without what their motion stores; 95 % intervals over "
    "windows. Shares of the time: time-to-collision < 4 s; time gap > 2.5 s above 1 m/s."
)
LIMIT = "efficiency"
HELD_TO = (
    f"The networks learn within a limit of long time gaps, agent.limits.{LIMIT}={{limit}} of the "
    "time; rows with more save by falling back. Tuned rules are tuned on NGSIM I-80, not on these "
    "data."
)
# Files of figures, in the job's folder and without their ending, and their captions.
RESULTS = {
    "evaluation/figures/overview": "A held-out episode, and the path energy of both cars",
    "evaluation/figures/learning_curve": "The trainings: what they minimise, and their limit",
}
DRIVERS = {
    "calibration/calibration": "Calibrated drivers: error and parameters",
    "calibration/joint_distribution": "Desired speed and time gap of the drivers",
}


def caption_of(trainings: Iterable[StudyConfig]) -> str:
    """Return the caption of the table, with the limit that the networks are trained to keep.

    Args:
        trainings: configuration of each.
    """
    found = [((cfg.agent or {}).get("limits") or {}).get(LIMIT) for cfg in trainings]
    limits = {limit for limit in found if limit is not None}
    held = ", ".join(f"{limit:.2g}" for limit in sorted(limits))
    return CAPTION if not limits else f"{CAPTION} {HELD_TO.format(limit=held)}"


def headline(found: pd.DataFrame) -> pd.DataFrame:
    """Shorten a summary to what a reader asks first.

    Args:
        found: of :func:`lcc_rl.results.tables.summary`.

    Returns:
        A row per strategy with a controlled car, those that draw most first: path energy [kJ], the
        shares saved [%] against a human and the tuned rules with their intervals, the shares of
        the time [%] with an unsafe time-to-collision and a long time gap, and collisions.
    """
    cars = found[found[PATH].notna()].sort_values(PATH, ascending=False, kind="stable")
    table = pd.DataFrame({"strategy": cars["strategy"]})
    table["who"] = [WHO.get(str(name), str(name)) for name in cars["strategy"]]
    table["path_energy_kj"] = cars[PATH]
    for baseline in (name for name in AGAINST if name in set(cars["strategy"])):
        for end in ("", "_low", "_high"):
            name = f"saved_against_{baseline.replace(' ', '_')}_pct{end}"
            table[name] = 100.0 * cars[f"path_saving_vs_{baseline}{end}"]
    for name, column in SHARES.items():
        table[name] = 100.0 * cars[column]
    table["collisions"] = cars["collisions"]
    return table.reset_index(drop=True)


def as_rich(table: pd.DataFrame, title: str, caption: str = CAPTION) -> Table:
    """Return a headline as a table for the terminal, a row per strategy, at most 100 wide."""
    drawn = Table(title=escape(title), caption=escape(caption))
    shown = [name for name in HEADINGS if name in table]
    for name in shown:
        drawn.add_column(escape(HEADINGS[name]), justify="right" if name != "who" else "left")
    for row in zip(*(_cells(table, name) for name in shown), strict=True):
        drawn.add_row(*map(escape, row))
    return drawn


def _cells(table: pd.DataFrame, name: str) -> list[str]:
    """Return the cells of a column; savings have one decimal, sign and interval."""
    if f"{name}_low" not in table:
        return column_cells(table, name)
    bounds = zip(*(table[f"{name}{end}"] for end in ("", "_low", "_high")), strict=True)
    return [
        f"{x:+.1f} ({low:.1f} … {high:.1f})" if pd.notna(x) else MISSING for x, low, high in bounds
    ]


def write_page(
    folder: str | Path, commands: Sequence[str], caption: str = CAPTION
) -> tuple[Path, pd.DataFrame]:
    """Write ``report.html`` of a job: the headline, figures, drivers, and how it was made.

    Args:
        folder: the job's folder, with ``evaluation``, ``calibration`` and a folder per training.
        commands: what was typed.
        caption: of the results, see :func:`caption_of`.

    Returns:
        The page's path, and the headline.

    Raises:
        ResultsError: if a table is missing, or the page cannot be written.
    """
    page = Page(folder)
    found = summary(read_parquet(page.folder / "evaluation" / "episodes.parquet"))
    table = headline(found)

    def figures(names: dict[str, str]) -> list[tuple[str, str, Path]]:
        paths = {page.folder / f"{name}.png": caption for name, caption in names.items()}
        return [("", caption, path) for path, caption in paths.items() if path.exists()]

    shown = table.rename(columns={"who": HEADINGS["who"]})
    page.add("Results", caption, [("", "Held-out windows", shown)], figures(RESULTS))
    learned = [str(name) for name in table["strategy"] if name not in UNTRAINED]
    improvements = {
        f"evaluation/figures/improvement_{own}_vs_{in_file(name)}": (
            f"{own} against {name}, driver by driver"
        )
        for own in learned[-1:]
        for name in AGAINST
    }
    for heading, names in {"By driver": improvements, "Drivers": DRIVERS}.items():
        if drawn := figures(names):
            page.add(heading, figures=drawn)
    page.add("All measures", tables=[("", "Means per strategy", _transposed(found))])
    return page.write(TITLE, commands), table


def _transposed(found: pd.DataFrame) -> pd.DataFrame:
    """Return a summary with a column per strategy and a row per measure, as on the terminal."""
    rows = [(label, key, form) for label, key, form in ROWS if found[key].notna().any()]
    names = [str(name) for name in found["strategy"]]
    cells = [
        [label.strip(), *(form.format(x) if pd.notna(x) else None for x in found[key])]
        for label, key, form in rows
    ]
    return pd.DataFrame(cells, columns=["measure", *names])
