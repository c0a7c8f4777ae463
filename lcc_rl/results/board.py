"""Rows of ``lcc-rl score``, one per task and source of leaders, and their tables."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from itertools import product
from math import isclose
from typing import Annotated, Any

import numpy as np
import pandas as pd
from pydantic import Field
from rich.table import Table

from lcc_rl.errors import in_short, require, require_known
from lcc_rl.results import measures, render
from lcc_rl.results.intervals import varied
from lcc_rl.results.measures import FINAL_SPREAD, FLOW, MEASURES, Shown, signed
from lcc_rl.results.names import in_words
from lcc_rl.results.remarks import FLOW_LOST, FLOW_NAMED
from lcc_rl.results.render import DASH, markdown_table, saved_text
from lcc_rl.results.task import Task
from lcc_rl.settings import Number, Settings, Whole, parse

BoardRow = Mapping[str, Any]
BOARD_COLUMNS = (
    Shown("where", "task, leaders"),
    Shown("score", "score"),
    Shown("saved", "saved [%]\nagainst"),
    Shown("distance", "dis-\ntance\n[%]"),
    Shown("flow_pct", "flow\n[%]"),
    Shown("ratio", "string\nratio"),
    Shown("drives", "dri-\nves"),
    Shown("kept", "limits\nkept"),
)
HEAD = ["leaders", "driven by", "saved [%]", "flow [1/h]", "flow [%]", "limits not kept"]
SAVED_SHARE = ("saving", "saving_low", "saving_high")
OF_HEADING, OF_PLACE = ("measure", "unit", "against"), ("data", "settings", "baseline")
COPIED = ("score", *SAVED_SHARE, "distance_lost", FLOW, FLOW_LOST, "string_ratio", FINAL_SPREAD)
FUTURE = " §"  # marks rows that read the leader's future
CELL = r"[^\r\n|`]{1,200}"  # a text in a cell of a table
Name = Annotated[str, Field(pattern=f"^{CELL}$")]
Missing = Number | None


class Limit(Settings):
    """The bound and the value of a limit of a row."""

    bound: Number
    value: Missing


class ScoreRow(Settings):
    """A row of a file of ``lcc-rl score``."""

    task: Name
    source: Name
    measure: Name
    unit: Name | None
    against: Name
    baseline: Missing
    score: Missing
    saving: Missing
    saving_low: Missing
    saving_high: Missing
    distance_lost: Missing
    flow_vph: Missing
    flow_lost: Missing
    string_ratio: Missing
    collisions: Whole
    windows: Whole
    drives: Whole
    data: Name
    settings: Name
    kept: bool
    future: list[Name]
    limits: dict[str, Limit]


SHAPE = [field.name for field in fields(ScoreRow)]


def row_of(
    table: pd.DataFrame, task: Task, source: str, strategy: str, drivers: int, future: Sequence[str]
) -> dict[str, Any]:
    """Return the row of a strategy on a task behind the leaders of a source.

    Args:
        table: result of :func:`lcc_rl.results.report.summary`.
        task, source, strategy: the task, and names of the leaders and of the strategy.
        drivers: number of drivers of the evaluation.
        future: entries of the leader's future that it reads.

    Returns:
        Plain values, None for missing numbers. ``limits`` holds bound and value of each limit,
        ``measures`` all measures, ``windows`` and ``drives`` the counts of the interval.
    """
    by_name = table.set_index("strategy")
    values = by_name.loc[strategy]
    row: dict[str, Any] = {"task": task.name, "source": source}
    row |= {"measure": task.score, "unit": task.unit if task.measure.per else None}
    row |= {"against": task.against, "baseline": _number(by_name.loc[task.against, "score"])}
    row |= {name: _number(values[name]) for name in COPIED}
    row["measures"] = {measure.key: _number(values[measure.key]) for measure in MEASURES}
    row["limits"] = {
        limit.key: {"bound": bound, "value": _number(values[limit.key])}
        for limit, bound in task.bounds.items()
    }
    row |= {name: int(str(values[name])) for name in ("collisions", "windows", "drives")}
    return row | {"kept": bool(values["kept"]), "drivers": drivers, "future": [*future]}


def _number(value: Any) -> float | None:
    """Return a number with seven digits, the accuracy of single precision; None for NaN."""
    return float(f"{value:.7g}") if np.isfinite(value) else None


def score_table(name: str, rows: Sequence[BoardRow]) -> Table:
    """Return rows as a table for the terminal, within 80 characters."""
    lines: list[dict[str, str]] = []
    for row in rows:
        if not lines or row["task"] not in (line["where"] for line in lines):
            lines.append(dict.fromkeys((column.key for column in BOARD_COLUMNS), ""))
            against = in_words(row["against"])
            unit = row["unit"] or ("m/s" if row["measure"].endswith("_mps") else "–")
            lines[-1] |= {"where": row["task"], "score": str(unit), "saved": against}
        mark = FUTURE * bool(row["future"])
        lines.append({"where": f"  {row['source']}{mark}", **_cells(row)})
    caption = (
        "saved, distance, flow: against the baseline; 95 % interval over drives, or over the "
        "minutes of a single one (then too narrow); score.json has every limit and "
        f"value. {future_note(rows)}"
    )
    return render.as_rich(pd.DataFrame(lines), BOARD_COLUMNS, in_words(name), caption.strip())


def _cells(row: BoardRow) -> dict[str, str]:
    """Return the cells of a row as text."""
    share = [np.nan if row[key] is None else 100.0 * row[key] for key in SAVED_SHARE]
    return {
        "score": _text(row["score"], "{:.2f}".format),
        "saved": saved_text(*share),
        "distance": _text(row["distance_lost"], lambda lost: signed(-100.0 * lost)),
        "flow": _text(row[FLOW], "{:,.0f}".format),
        "flow_pct": _text(row[FLOW_LOST], lambda lost: signed(-100.0 * lost)),
        "ratio": _text(row["string_ratio"], "{:.2f}".format),
        "drives": str(row["drives"]),
        "kept": "yes" if row["kept"] else ",\n".join(broken(row)),
    }


def _text(value: float | None, form: Callable[[float], str]) -> str:
    """Return a number as text; a dash for a missing one, as of a row with a collision."""
    return DASH if value is None else form(value)


def future_note(rows: Sequence[BoardRow]) -> str:
    """Return a sentence on the rows that read the leader's future; empty without any."""
    names = ", ".join(dict.fromkeys(name for row in rows for name in row["future"]))
    return f"{FUTURE.strip()}: reads the leader's future ({names})." if names else ""


def leaderboard(documents: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a Markdown table for each task: policies and savings by source.

    Args:
        documents: contents of the files of ``lcc-rl score``, by name.

    Raises:
        ConfigError: if two rows of one task and source are not comparable or share a name.
    """
    check_alike(documents)
    every = [{**row, "by": one["name"]} for one in documents.values() for row in one["results"]]
    sections = []
    for task in dict.fromkeys(row["task"] for row in every):
        rows = [row for row in every if row["task"] == task]
        sources = list(dict.fromkeys(row["source"] for row in rows))
        lines = []
        for row in sorted(rows, key=lambda x: sources.index(x["source"])):
            sample = varied(row["drives"])
            place = f"{row['source']}, {row[sample]} {sample}"
            mark = FUTURE * bool(row["future"])
            lines.append([place, f"`{row['by']}`{mark}", *_markdown(row)])
        text = f"Against {in_words(rows[0]['against'])}. {future_note(rows)}".strip()
        sections.append(f"### {task}\n\n{text}\n\n{markdown_table(HEAD, lines)}\n")
    return "\n".join(sections)


def check_alike(documents: Mapping[str, Mapping[str, Any]]) -> None:
    """Check that rows of a task and source share data, settings and limits, and no name.

    Raises:
        ConfigError: naming the file, the row and the difference or contradiction.
    """
    first: dict[tuple[str, str], BoardRow] = {}
    files: dict[tuple[str, str, str], str] = {}
    headings: dict[str, BoardRow] = {}
    for file, document in documents.items():
        usable = isinstance(document, Mapping) and isinstance(document.get("results"), list)
        named = usable and re.fullmatch(CELL, str(document.get("name", "")))
        require(named, f"{file}: expected an object with a name, in one line, and results")
        for number, row in enumerate(document["results"], 1):
            check_row(row, f"{file}, row {number}")
            place = (row["task"], row["source"])
            known = first.setdefault(place, row)
            other = files.setdefault((document["name"], *place), file)
            require(
                other == file,
                f"{other} and {file} both score {document['name']} in {place[0]} behind "
                f"{place[1]}: remove one, or give it another name",
            )
            same = ({name: x["bound"] for name, x in one["limits"].items()} for one in (row, known))
            require(len({str(x) for x in same}) == 1, f"{file}: {place[0]}: it has other limits")
            heading = headings.setdefault(place[0], row)
            for key, one in [*product(OF_HEADING, [heading]), *product(OF_PLACE, [known])]:
                rounded = key == "baseline" and isclose(
                    row[key] or 0.0, one[key] or 0.0, rel_tol=1e-3
                )
                require(
                    rounded or row[key] == one[key],
                    f"{file}: {place[0]} behind {place[1]} was measured with other "
                    f"{key} ({row[key]!s:.8}, not {one[key]!s:.8})",
                )


def check_row(row: BoardRow, where: str) -> None:
    """Check that a row is consistent; ``where`` names it.

    Raises:
        ConfigError: naming the contradiction.
    """
    require(isinstance(row, Mapping), f"{where}: expected a row with names, got {in_short(row)}")
    lacking = ", ".join(name for name in SHAPE if name not in row)
    require(not lacking, f"{where}: it lacks {lacking}")
    parse(ScoreRow, {name: row[name] for name in SHAPE}, where)
    where = f"{where}: {row['task']} behind {row['source']}"
    require_known(f"limit ({where})", row["limits"], measures.limit_measures())
    value, low, high = (row[key] for key in SAVED_SHARE)
    inside = low is high is None or (None not in (low, value, high) and low <= value <= high)
    require(inside, f"{where}: the saving {value} is not within its interval {low} … {high}")
    score, baseline = row["score"], row["baseline"]
    known = baseline and score is not None
    agree = value is None or (known and isclose(value, 1.0 - score / baseline, abs_tol=1e-4))
    require(agree, f"{where}: the saving {value} is not that of {score} against {baseline}")
    wrong = broken(row)
    require(
        row["kept"] is (not wrong),
        f"{where}: kept is {row['kept']}, but limits are not kept: {', '.join(wrong) or 'none'}",
    )


def _markdown(row: BoardRow) -> list[str]:
    """Return saving, flow and broken limits; bold: a saving within limits, a large loss of flow."""
    cells = _cells(row)
    share = f"**{cells['saved']}**" if row["kept"] else cells["saved"]
    much = (row[FLOW_LOST] or 0.0) > FLOW_NAMED
    flow = f"**{cells['flow_pct']}**" if much else cells["flow_pct"]
    return [share, cells["flow"], flow, ", ".join(broken(row))]


def broken(row: BoardRow) -> list[str]:
    """Return the broken limits by their first words, and the number of collisions."""
    faults = [f"{row['collisions']} coll."] if row["collisions"] else []
    for name, limit in row["limits"].items():
        measure = measures.limit_measures()[name]
        if limit["value"] is not None and not measure.keeps(limit["value"], limit["bound"]):
            faults.append(measure.limited)
    return faults
