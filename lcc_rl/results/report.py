"""One self-contained HTML page from text, tables and figures, without scripts or network."""

from __future__ import annotations

import base64
import platform
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from html import escape
from importlib.metadata import version
from io import BytesIO
from pathlib import Path

import numpy as np
import pandas as pd
from PIL import Image  # comes with matplotlib

from lcc_rl.errors import ResultsError
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import PROCESSOR, parquet_metadata

UNITS = {"kj": "kJ", "pct": "%", "s": "s", "m": "m", "mps": "m/s", "mps3": "m/s³"}
UNITS |= {"kj_per_km": "kJ/km", "ms": "ms"}
PACKAGES = ("lcc_rl", "torch", "torchrl", "tensordict", "numpy", "pandas", "scipy", "matplotlib")
INITIALS = ("cav", "hdv", "ttc", "sd")
MISSING = "–"

STYLE = """
:root { color-scheme: light dark; --ink: #1c1c1e; --paper: #ffffff; --soft: #6a6a70;
  --line: #d9d9de; --band: #f5f5f7; --accent: #0060a0; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8e8ea; --paper: #17181a; --soft: #a0a0a6;
  --line: #3a3b40; --band: #212226; --accent: #7db8e8; } }
body { font: 16px/1.55 system-ui, sans-serif; color: var(--ink); background: var(--paper);
  max-width: 74rem; margin: 0 auto; padding: 2rem 1.25rem 5rem; }
h1 { font-size: 1.8rem; line-height: 1.2; margin: 0 0 .5rem; }
h2 { font-size: 1.3rem; margin: 3rem 0 .5rem; padding-top: .6rem;
  border-top: 1px solid var(--line); }
p { max-width: 46rem; margin: .6rem 0; }
a { color: var(--accent); }
nav ol { columns: 2; margin: 1rem 0; padding-left: 1.4rem; }
figure { margin: 1.6rem 0; }
figure img { max-width: 100%; height: auto; background: #fff; border-radius: 4px; }
figcaption, caption { color: var(--soft); font-size: .9rem; text-align: left;
  padding: .3rem 0; caption-side: top; }
.wide { overflow-x: auto; margin: 1.2rem 0; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
th, td { padding: .28rem .5rem; text-align: left; border-bottom: 1px solid var(--line);
  white-space: nowrap; }
th { font-weight: 600; vertical-align: bottom; white-space: normal; background: var(--band); }
th.number, td.number { text-align: right; }
details { margin: .6rem 0; }
summary { cursor: pointer; color: var(--accent); }
pre { font-size: .8rem; line-height: 1.4; background: var(--band); padding: .8rem;
  overflow-x: auto; border-radius: 4px; }
"""
# The browser may fetch and run nothing.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


@dataclass(frozen=True)
class Section:
    """A part of a report.

    Args:
        heading: its title.
        text: plain paragraphs, separated by blank lines.
        tables: caption and table; a column's unit is the end of its name (``energy_kj``,
            ``saving_pct``), and ``x``, ``x_low``, ``x_high`` are shown as one column. Numbers
            have about four digits, or as many decimals as ``table.attrs["decimals"]`` says.
        figures: caption and image file (png or svg).
        details: title and long text, folded away.
    """

    heading: str
    text: str = ""
    tables: Sequence[tuple[str, pd.DataFrame]] = ()
    figures: Sequence[tuple[str, Path]] = ()
    details: Sequence[tuple[str, str]] = field(default=())


def write_report(folder: str | Path, title: str, sections: Sequence[Section]) -> Path:
    """Write ``report.html`` with all of its tables and figures inside.

    Args:
        folder: where the page goes.
        title: its title.
        sections: its parts, in order.

    Returns:
        The page's path.

    Raises:
        ResultsError: if a figure is missing or the page cannot be written.
    """
    path = Path(folder) / "report.html"
    links = "".join(
        f'<li><a href="#s{number}">{escape(section.heading)}</a></li>'
        for number, section in enumerate(sections, 1)
    )
    body = "".join(_section(number, section) for number, section in enumerate(sections, 1))
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>\n"
        f"<body><h1>{escape(title)}</h1><nav><ol>{links}</ol></nav>\n{body}</body></html>\n"
    )
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return path


def made(
    commands: Sequence[str],
    details: Sequence[tuple[str, str]] = (),
    runs: Iterable[Path] = (),
    more: str = "",
) -> Section:
    """Return the section about how a study was made.

    Args:
        commands: the commands, oldest first, with dates where known.
        details: title and text of configurations and notes, folded away.
        runs: a parquet file of each training; its metadata name the processor.
        more: further paragraphs.
    """
    rows = [(name, version(name)) for name in PACKAGES]
    rows += [("Python", platform.python_version()), ("machine", platform.machine())]
    written = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    text = f"This page was written on {written} from parquet files alone."
    listing = [("Commands", "\n".join(commands))] if commands else []
    places = Counter(parquet_metadata(path).get(PROCESSOR, "not recorded") for path in runs)
    if places:
        counted = (f"{place} ({count})" for place, count in places.most_common())
        text += f" Its trainings ran on: {', '.join(counted)}."
    versions = pd.DataFrame(rows, columns=["package", "version"])
    tables = [("Versions that wrote this page", versions)]
    return Section("How it was made", text + more, tables, details=[*listing, *details])


def _section(number: int, section: Section) -> str:
    paragraphs = [part.strip() for part in section.text.split("\n\n") if part.strip()]
    parts = [f'<section id="s{number}"><h2>{escape(section.heading)}</h2>']
    parts += [f"<p>{escape(part)}</p>" for part in paragraphs]
    parts += [_table(caption, frame) for caption, frame in section.tables]
    parts += [_figure(caption, path) for caption, path in section.figures]
    parts += [
        f"<details><summary>{escape(name)}</summary><pre>{escape(text)}</pre></details>"
        for name, text in section.details
    ]
    return "\n".join([*parts, "</section>\n"])


def _figure(caption: str, path: Path) -> str:
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise ResultsError(f"{path}: cannot be read: {error}") from error
    kind = "svg+xml"
    if Path(path).suffix != ".svg":
        content, kind = _smaller(content), "webp"
    data = base64.b64encode(content).decode()
    return (
        f'<figure><img alt="{escape(caption, quote=True)}" src="data:image/{kind};base64,{data}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def _smaller(png: bytes) -> bytes:
    """Encode an image as lossless WebP, a third of the size."""
    buffer = BytesIO()
    with Image.open(BytesIO(png)) as image:
        image.save(buffer, "WEBP", lossless=True, exact=True)
    return buffer.getvalue()


def _table(caption: str, frame: pd.DataFrame) -> str:
    shown = [c for c in frame.columns if not _is_bound(frame, str(c))]
    columns = {name: column_cells(frame, name) for name in shown}
    # Text stands left, numbers right.
    right = {c: ' class="number"' if _is_number(frame[c]) else "" for c in shown}
    head = "".join(f"<th{right[c]}>{escape(heading(str(c)))}</th>" for c in shown)
    rows = "".join(
        "<tr>" + "".join(f"<td{right[c]}>{escape(columns[c][i])}</td>" for c in shown) + "</tr>\n"
        for i in range(len(frame))
    )
    return (
        f'<div class="wide"><table><caption>{escape(caption)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>\n{rows}</tbody></table></div>"
    )


def as_markdown(frame: pd.DataFrame) -> str:
    """Return a table for a Markdown page, with the headings and cells of :func:`write_report`."""
    shown = [str(name) for name in frame if not _is_bound(frame, str(name))]
    cells = zip(*(column_cells(frame, name) for name in shown), strict=True)
    rows = [[heading(name) for name in shown], ["---"] * len(shown), *map(list, cells)]
    return "\n".join("| " + " | ".join(row).replace("|e_v|", "abs e_v") + " |" for row in rows)


def heading(column: str) -> str:
    """Return a column's name for readers: ``"total_energy_kj"`` → ``"total energy [kJ]"``."""
    for suffix, unit in sorted(UNITS.items(), key=lambda item: -len(item[0])):
        if column.endswith(f"_{suffix}"):
            return f"{_words(column.removesuffix(f'_{suffix}'))} [{unit}]"
    return _words(column)


def _words(name: str) -> str:
    return " ".join(word.upper() if word in INITIALS else word for word in name.split("_"))


def _is_bound(frame: pd.DataFrame, column: str) -> bool:
    return any(
        column.endswith(end) and column.removesuffix(end) in frame for end in ("_low", "_high")
    )


def _is_number(values: pd.Series) -> bool:
    kinds = pd.api.types
    return kinds.is_numeric_dtype(values) and not kinds.is_bool_dtype(values)


def column_cells(frame: pd.DataFrame, name: str) -> list[str]:
    """Return the cells of a column as text, with its interval where the frame has one."""
    values = frame[name]
    places = frame.attrs.get("decimals", _places(values))
    cells = [_cell(value, places) for value in values]
    if f"{name}_low" not in frame:
        return cells
    bounds = zip(frame[f"{name}_low"], frame[f"{name}_high"], strict=True)
    return [
        cell
        if not np.isfinite([low, high]).all()
        else f"{cell} ({_cell(low, places)} … {_cell(high, places)})"
        for cell, (low, high) in zip(cells, bounds, strict=True)
    ]


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
    if isinstance(value, str):
        return value
    if value is None or bool(pd.isna(value)):  # type: ignore[call-overload]
        return MISSING
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    if isinstance(value, (int, np.integer)):
        return f"{value:,}"
    if isinstance(value, (float, np.floating)):
        if not np.isfinite(value):
            return MISSING
        text = f"{value:,.{places}f}"
        return text.replace("-", "−")
    return str(value)
