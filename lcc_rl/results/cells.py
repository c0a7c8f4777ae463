"""Tables for readers: headings with units, and numbers with their intervals as text."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pandas as pd

# A column's unit by the end of its name.
UNITS = {"kj_per_km": "kJ/km", "mps3": "m/s³", "mps": "m/s", "pct": "%", "kj": "kJ", "ms": "ms"}
UNITS |= {"m": "m", "s": "s", "vph": "1/h", "g_per_km": "g/km"}
INITIALS = ("cav", "hdv", "ttc", "sd")
MISSING = "–"


class Column(NamedTuple):
    """A column of a table as text: its heading, its cells, and whether it holds numbers."""

    heading: str
    cells: list[str]
    number: bool


def signed(value: float, form: str = "+z.1f") -> str:
    """Return a number with its sign, a minus as in print, and no negative zero.

    Examples:
        >>> signed(-2.34), signed(2.34)
        ('−2.3', '+2.3')
    """
    return f"{value:{form}}".replace("-", "−")


def columns(frame: pd.DataFrame) -> list[Column]:
    """Return the columns of a table as text.

    A column's unit is the end of its name (``energy_kj``, ``saving_pct``), and ``x``, ``x_low``,
    ``x_high`` become one column. Numbers have about four digits, or as many decimals as
    ``frame.attrs["decimals"]`` says.
    """
    bounds = {f"{name}{end}" for name in frame for end in ("_low", "_high")}
    return [
        Column(heading(name), column_cells(frame, name), _is_number(frame[name]))
        for name in map(str, frame)
        if name not in bounds
    ]


def as_markdown(frame: pd.DataFrame) -> str:
    """Return a table for a Markdown page, with the headings and cells of :func:`columns`."""
    shown = columns(frame)
    rows = [[column.heading for column in shown], ["---"] * len(shown)]
    rows += map(list, zip(*(column.cells for column in shown), strict=True))
    return "\n".join(markdown_row(row) for row in rows)


def markdown_row(cells: Iterable[str]) -> str:
    """Return a row of a Markdown table, whatever its cells hold.

    Examples:
        >>> print(markdown_row(["a|b", "1"]))
        | a\\|b | 1 |
    """
    escaped = (" ".join(cell.split()).replace("|", r"\|") for cell in cells)
    return f"| {' | '.join(escaped)} |"


def as_latex(frame: pd.DataFrame) -> str:
    """Return a table for LaTeX (package booktabs), with headings and cells as on a page."""
    shown = columns(frame)
    cells = pd.DataFrame({column.heading: column.cells for column in shown})
    places = "".join("r" if column.number else "l" for column in shown)
    text = cells.to_latex(index=False, escape=True, column_format=places).rstrip()
    return text.replace("−", "$-$").replace(" … ", " to ").replace(MISSING, "--")


def heading(column: str) -> str:
    """Return a column's name for readers.

    Examples:
        >>> heading("total_energy_kj"), heading("cav_saving_pct")
        ('total energy [kJ]', 'CAV saving [%]')
    """
    suffix = next((end for end in UNITS if column.endswith(f"_{end}")), "")
    words = (column.removesuffix(f"_{suffix}") if suffix else column).split("_")
    text = " ".join(word.upper() if word in INITIALS else word for word in words)
    return f"{text} [{UNITS[suffix]}]" if suffix else text


def column_cells(frame: pd.DataFrame, name: str) -> list[str]:
    """Return the cells of a column as text, with its interval if the table has one."""
    places = frame.attrs.get("decimals", _places(frame[name]))
    cells = [_cell(value, places) for value in frame[name]]
    if f"{name}_low" not in frame:
        return cells
    low, high = ([_cell(x, places) for x in frame[f"{name}_{end}"]] for end in ("low", "high"))
    return [
        cell if MISSING in ends else f"{cell} ({' … '.join(ends)})"
        for cell, *ends in zip(cells, low, high, strict=True)
    ]


def _is_number(values: pd.Series) -> bool:
    kinds = pd.api.types
    return kinds.is_numeric_dtype(values) and not kinds.is_bool_dtype(values)


def _places(values: pd.Series) -> int:
    """Return the decimals that give a column about four significant digits."""
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
        return signed(float(value), f"z,.{places}f")  # no negative zero
    return value if isinstance(value, str) else MISSING
