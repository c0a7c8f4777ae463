"""Rendering of tables and reports: terminal, Markdown and LaTeX."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from textwrap import fill
from typing import NamedTuple

import numpy as np
import pandas as pd
from rich.console import Console, Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from lcc_rl.errors import require_known
from lcc_rl.results.intervals import BOUNDED
from lcc_rl.results.measures import Shown, between, heading, signed
from lcc_rl.results.names import in_words
from lcc_rl.results.report import Report
from lcc_rl.runs.output import PLAIN

DASH = "–"
WIDTH, UNLIMITED = 80, 10_000  # characters


class TableColumn(NamedTuple):
    """A column of a table as text: heading, cells, and whether it holds numbers."""

    heading: str
    cells: list[str]
    number: bool


def columns(frame: pd.DataFrame) -> list[TableColumn]:
    """Return the columns of a table as text.

    A column's unit is the end of its name (``energy_kj``, ``saving_pct``). ``x``, ``x_low`` and
    ``x_high`` become one column. Numbers have about four digits, per cent at most two decimals, or
    all ``frame.attrs["decimals"]`` decimals.
    """
    bounds = {f"{name}{end}" for name in frame for end in ("_low", "_high")}
    return [
        TableColumn(heading(name), column_cells(frame, name), _is_number(frame[name]))
        for name in map(str, frame)
        if name not in bounds
    ]


def as_markdown(frame: pd.DataFrame) -> str:
    """Return a table for a Markdown page, with the headings and cells of :func:`columns`."""
    shown = columns(frame)
    rows = zip(*(column.cells for column in shown), strict=True)
    return markdown_table([column.heading for column in shown], rows)


def markdown_table(head: Sequence[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table with escaped cells."""
    return "\n".join(map(markdown_row, [head, ["---"] * len(head), *rows]))


def markdown_row(cells: Iterable[str]) -> str:
    """Return a row of a Markdown table with escaped cells.

    Examples:
        >>> print(markdown_row(["a|b", "1"]))
        | a\\|b | 1 |
    """
    escaped = (" ".join(cell.split()).replace("|", r"\|") for cell in cells)
    return f"| {' | '.join(escaped)} |"


def as_csv(frame: pd.DataFrame, decimal: str = "point") -> str:
    """Return a table as CSV without negative zeros; a decimal comma separates columns by ``;``."""
    frame = frame.assign(**(frame.select_dtypes("float") + 0.0))
    sep, mark = (";", ",") if decimal == "comma" else (",", ".")
    return frame.to_csv(index=False, sep=sep, decimal=mark).rstrip()


LATEX = {
    **{sign: f"${sign}$" for sign in "<>"},
    "−": "$-$",
    " … ": " to ",
    DASH: "--",
    "²": "$^2$",
    "³": "$^3$",
    "Σ": r"$\Sigma$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "±": r"$\pm$",
    "×": r"$\times$",
}


def as_latex(frame: pd.DataFrame) -> str:
    """Return a table for LaTeX (package booktabs) with headings and cells of :func:`columns`."""
    shown = columns(frame)
    cells = pd.DataFrame({column.heading: column.cells for column in shown})
    places = "".join("r" if column.number else "l" for column in shown)
    text = cells.to_latex(index=False, escape=True, column_format=places).rstrip()
    for sign, word in LATEX.items():
        text = text.replace(sign, word)
    return text


def column_cells(frame: pd.DataFrame, name: str) -> list[str]:
    """Return the cells of a column as text, with its interval if the table has one."""
    keys = [f"{name}{end}" for end in BOUNDED if f"{name}{end}" in frame]
    most = 2 if heading(name).endswith("[%]") else 4
    places = frame.attrs.get("decimals", min(most, *(_places(frame[key]) for key in keys)))
    cells = [_cell(value, places) for value in frame[name]]
    if f"{name}_low" not in frame:
        return cells
    low, high = ([_cell(x, places) for x in frame[f"{name}_{end}"]] for end in ("low", "high"))
    return [
        cell if DASH in ends else f"{cell} ({' … '.join(ends)})"
        for cell, *ends in zip(cells, low, high, strict=True)
    ]


def _is_number(values: pd.Series) -> bool:
    kinds = pd.api.types
    return kinds.is_numeric_dtype(values) and not kinds.is_bool_dtype(values)


def _places(values: pd.Series) -> int:
    """Return the number of decimals for about four significant digits."""
    if not pd.api.types.is_float_dtype(values):
        return 0
    numbers = values.to_numpy(float)
    sizes = np.abs(numbers[np.isfinite(numbers) & (numbers != 0.0)])
    if not len(sizes):
        return 0
    typical = float(np.median(sizes))
    return int(np.clip(3 - np.floor(np.log10(typical)), 0, 2 if typical >= 0.1 else 4))


def _cell(value: object, places: int) -> str:
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    if isinstance(value, (int, np.integer)):
        return f"{value:,}"
    if isinstance(value, (float, np.floating)) and np.isfinite(value):
        return signed(float(value), f"{{:,.{places}f}}")
    return value if isinstance(value, str) else DASH


def terminal(report: Report, title: str = "", full: bool = False) -> RenderableType:
    """Return a report for the terminal, within 80 characters, with a row per strategy.

    Args:
        report, title: the report of an evaluation, and the title of the table.
        full: all measures with a column per strategy.
    """
    notes = [report.verdict] if report.verdict else []
    if full:
        drawn: RenderableType = _side_by_side(report, title)
        notes += [fill(line, WIDTH) for line in report.remarks]
    else:
        drawn = as_rich(report.short, report.shown, title, report.note)
    return Group(drawn, Text("\n".join(notes))) if notes else drawn


def as_rich(table: pd.DataFrame, shown: Sequence[Shown], title: str, caption: str) -> Table:
    """Return columns of a table for the terminal; savings have one decimal, sign and interval."""
    drawn = Table(title=escape(title), caption=escape(caption), **PLAIN)
    drawn.min_width = min(len(title), WIDTH)  # title and caption are wrapped at its width
    for index, column in enumerate(shown):
        drawn.add_column(escape(column.heading), justify="right" if index else "left")
    texts = [(one.heading, *_short_cells(table, one.key)) for one in shown]
    first, *rest = (max(len(word) for word in " ".join(text).split()) for text in texts)
    drawn.columns[0].overflow = "fold"
    if first > WIDTH // 4:  # names are wrapped at spaces, if all columns have room
        drawn.columns[0].width = max(min(first, WIDTH - sum(rest) - len(rest)), 1)
    widest, *others = (max(map(len, "\n".join(text).split("\n"))) for text in texts)
    if widest > (room := WIDTH - sum(others) - len(others)) and first <= WIDTH // 4:
        drawn.columns[0].width = max(first, room)  # before the cells of others are wrapped
        drawn.width = WIDTH if first > room else None
    for row in zip(*(cells for _, *cells in texts), strict=True):
        drawn.add_row(*map(escape, row))
    return drawn


def _short_cells(table: pd.DataFrame, name: str) -> list[str]:
    if f"{name}_low" not in table or not name.endswith("_pct"):
        return column_cells(table, name)
    bounds = zip(*(table[f"{name}{end}"] for end in BOUNDED), strict=True)
    return [saved_text(*row) for row in bounds]


def saved_text(share: float, low: float, high: float) -> str:
    """Return a saving [%] with sign and interval."""
    if pd.isna(share):
        return DASH
    return signed(share) + ("" if pd.isna(low) else f" ({between(low, high)})")


def full_rows(report: Report) -> Iterator[tuple[str, list[str]]]:
    """Yield label and cells of every measure with a value, and of the bounds of its interval."""
    for measure in report.rows:
        pad = " " * (2 + len(measure.label) - len(measure.label.lstrip()))
        ends = {"": measure.title, "_low": f"{pad}95 % interval, low", "_high": f"{pad}  high"}
        for end, title in ends.items():
            values = report.table.get(f"{measure.key}{end}", pd.Series(dtype=float))
            known = values.notna() & (values.astype(float).abs() < np.inf)
            if known.any():
                cells = zip(values, known, strict=True)
                yield title, [signed(x, measure.number) if k else DASH for x, k in cells]


def _side_by_side(report: Report, title: str) -> Group:
    """Return tables with as many columns of strategies as fit; names are wrapped at spaces."""
    rows = list(full_rows(report))
    names = [in_words(str(name)) for name in report.table["strategy"]]
    room = WIDTH - max(len(label) for label, _ in rows)
    widths = [max([len("automated"), *map(len, name.split())]) for name in names]
    drawn: list[Table] = []
    used = room
    for name, width in zip(names, widths, strict=True):
        used += 1 + width
        if used > room or not drawn:
            used = 1 + width
            drawn.append(Table("", **PLAIN))
        drawn[-1].add_column(escape(name), justify="right", max_width=width, overflow="fold")
    start = 0
    for table in drawn:
        end = start + len(table.columns) - 1
        for label, cells in rows:
            table.add_row(escape(label), *cells[start:end])
        start = end
    drawn[0].title, drawn[-1].caption = escape(title), escape(report.full_caption)
    return Group(*drawn)


def for_print(report: Report, names: Sequence[str] = ()) -> pd.DataFrame:
    """Return columns of a report with their intervals and the headings of its short table.

    Args:
        report, names: the report, and names of columns; by default those of its short table.

    Raises:
        ConfigError: for an unknown column, naming the nearest.
    """
    keys = [column.key for column in report.shown]
    table = chosen(report.short, names or keys, "column of the short table (--all has all)")
    headings = {f"{one.key}{end}": f"{one.words}{end}" for one in report.shown for end in BOUNDED}
    return table.rename(columns=headings)


def chosen(table: pd.DataFrame, names: Sequence[str], what: str = "column") -> pd.DataFrame:
    """Return columns of a table with their intervals, all by default; ``what`` they are called.

    Raises:
        ConfigError: for an unknown column, naming the nearest.
    """
    known = [str(key) for key in table]
    require_known(what, names, known)
    keys = names or known
    shown = [name for key in keys for name in (f"{key}{end}" for end in BOUNDED) if name in known]
    return table[list(dict.fromkeys(shown))]


def print_table(table: RenderableType) -> None:
    """Print a table or a text, as wide as the terminal, ``COLUMNS`` or its content."""
    console = Console()
    if not console.is_terminal and "COLUMNS" not in os.environ:
        wide = Console(width=UNLIMITED).measure(table).maximum  # limited by this width
        console = Console(width=max(wide, console.width))
    console.print(table)
