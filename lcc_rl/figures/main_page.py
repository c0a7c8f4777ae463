"""The table and the page of the main job: who saves energy, within which limits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd
from rich.markup import escape
from rich.table import Table

from lcc_rl.agents.limits import RECORDED
from lcc_rl.config.schemas import StudyConfig
from lcc_rl.figures.drawing import in_file
from lcc_rl.figures.page import Page
from lcc_rl.io.files import read_parquet
from lcc_rl.results.cells import MISSING, column_cells
from lcc_rl.results.savings import UNTRAINED
from lcc_rl.results.tables import PATH, PER_KM, ROWS, summary

TITLE = "lcc_rl: data → drivers → policies → results"
WHO = {
    "idm": "one human driver (IDM)",
    "human": "simulated human drivers",
    "recorded": "recorded drivers",
    "constant_filtered": "safety filter alone",
    "acc tuned": "ACC tuned on I-80",
    "idm tuned": "IDM tuned on I-80",
    "rule": "IDM tuned on these data",
    "reference": "network for its own car",
    "alcc": "network for both cars",
}
# Column of the summary, as a percentage, and its name in the table.
SHARES = {
    "unsafe_ttc_pct": "share_ttc_unsafe",
    "long_time_gap_pct": "share_time_gap_long_moving",
}
HUMAN, NETWORK = "human", "alcc"
RULES = ("rule", "idm tuned")  # whom a network is compared with: the first that there is
HEADINGS = {
    "who": "the car is driven by",
    "energy_kj_per_km": "energy\n[kJ/km]",
    "saved_against_human_pct": "saved against\nhumans [%]",
    "distance_pct": "dis-\ntance\n[%]",
    "unsafe_ttc_pct": "unsafe\nTTC\n[%]",
    "long_time_gap_pct": "long\ngap\n[%]",
    "collisions": "colli-\nsions",
}
CAPTION = (
    "Energy of both cars per km without what their motion stores; 95 % intervals over windows; "
    "distance against that of human drivers. Shares of the time: time-to-collision < 4 s; time gap "
    "> 2.5 s above 1 m/s."
)
LIMIT = "efficiency"
HELD_TO = (
    f"The networks learn within a limit of long time gaps, agent.limits.{LIMIT}={{limit}} of the "
    "time; rows with more save by falling back."
)
AS_RECORDED = (
    "The networks and the IDM tuned on these data may have long time gaps as often as the recorded "
    "drivers of the training recordings; rows with more save by falling back."
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
    limits = sorted({f"{limit:.2g}" if limit != RECORDED else limit for limit in found if limit})
    if not limits:
        return CAPTION
    if limits == [RECORDED]:
        return f"{CAPTION} {AS_RECORDED}"
    return f"{CAPTION} {HELD_TO.format(limit=', '.join(limits))}"


def headline(found: pd.DataFrame) -> pd.DataFrame:
    """Shorten a summary to what a reader asks first.

    Args:
        found: of :func:`lcc_rl.results.tables.summary`.

    Returns:
        A row per strategy with a controlled car, those that draw most first: path energy per km
        [kJ/km], the shares saved [%] against human drivers and the tuned rule with their
        intervals, the distance [%] against that of human drivers, the shares of the time [%] with
        an unsafe time-to-collision and a long time gap, and collisions.
    """
    cars = found[found[PATH].notna()].sort_values(PER_KM, ascending=False, kind="stable")
    table = pd.DataFrame({"strategy": cars["strategy"]})
    table["who"] = [WHO.get(str(name), str(name)) for name in cars["strategy"]]
    table["energy_kj_per_km"] = cars[PER_KM]
    for column, baseline in _against(cars["strategy"]).items():
        for end in ("", "_low", "_high"):
            table[f"{column}{end}"] = 100.0 * cars[f"km_saving_vs_{baseline}{end}"]
    if HUMAN in set(cars["strategy"]):
        human = cars.loc[cars["strategy"] == HUMAN, "distance_m"].iloc[0]
        table["distance_pct"] = 100.0 * (cars["distance_m"] / human - 1.0)
    for name, column in SHARES.items():
        table[name] = (100.0 * cars[column]).round(2)
    table["collisions"] = cars["collisions"]
    return table.reset_index(drop=True)


def _against(strategies: Iterable[object]) -> dict[str, str]:
    """Return the baselines that there are, by the column of what is saved against them."""
    known = set(strategies)
    rule = next((name for name in RULES if name in known), None)
    found = {"saved_against_human_pct": HUMAN, "saved_against_rule_pct": rule}
    return {column: name for column, name in found.items() if name is not None and name in known}


def verdict(table: pd.DataFrame) -> str:
    """Return in a sentence what came out for the network, from a headline; empty without one."""
    rows = table.set_index("strategy")
    against = _against(rows.index)
    if NETWORK not in rows.index or not against:
        return ""
    column, baseline = list(against.items())[-1]
    own, other = rows.loc[NETWORK], rows.loc[baseline]
    saved, low, high = (own[f"{column}{end}"] for end in ("", "_low", "_high"))
    less = "less"
    if saved < 0.0:
        less, saved, low, high = "more", -saved, -high, -low
    within = "" if low > 0.0 else ", which is within the uncertainty"
    long = "long_time_gap_pct"
    return (
        f"The {own['who']} needs {saved:.1f} % {less} energy per km than the {other['who']} "
        f"({low:.1f} … {high:.1f}){within}, with long time gaps for {own[long]:.2f} % of the time "
        f"against {other[long]:.2f} %."
    )


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
    words = f"{verdict(table)}\n\n{caption}"
    page.add("Results", words, [("", "Held-out windows", shown)], figures(RESULTS))
    learned = [str(name) for name in table["strategy"] if name not in UNTRAINED]
    improvements = {
        f"evaluation/figures/improvement_{own}_vs_{in_file(name)}": (
            f"{own} against {name}, driver by driver"
        )
        for own in learned[-1:]
        for name in _against(table["strategy"]).values()
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
