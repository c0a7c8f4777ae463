"""Tables of measurements in files: CSV with any usual separator, plain or gzipped, and parquet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import NoReturn

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from lcc_rl.data.delimited import Delimited
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.io.memory import require_memory

PARQUET = (".parquet", ".pq")
UNPACKED = 8  # bytes of memory that reading a byte of parquet takes
LARGEST = 1e12  # in SI: beyond any time or place, and within every type
SHOWN = 40  # names of columns that a message lists


@dataclass
class Table:
    """Columns of one file, converted and checked on access.

    Args:
        file: its name, for messages.
        header: names of all of its columns.
        columns: what the columns in use are called there, by their key here.
        content: those columns, by key.
        option: the option that says what the columns are called, for messages.
        preamble: lines before the header, by their first cell.
        notes: lines on what was found, such as the separator.
    """

    file: str
    header: list[str]
    columns: dict[str, str]
    content: dict[str, pa.ChunkedArray]
    option: str
    preamble: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    decimal_comma: bool = False

    def __len__(self) -> int:
        return len(next(iter(self.content.values())))

    def numbers(self, key: str, factor: float = 1.0, blank: bool = False) -> NDArray[np.float64]:
        """Return a column of finite numbers, times a factor.

        Args:
            key: of the column.
            factor: to SI.
            blank: whether cells may be blank or NaN; they are NaN in the result.

        Raises:
            DataError: naming the first row at fault.
        """
        column = self.content[key]
        try:
            numbers = self._cast(column)
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
            self._not_a_number(key, error)
        values = np.asarray(numbers.to_numpy(), dtype=np.float64)
        wrong = np.isinf(values) if blank else ~np.isfinite(values)
        self.refuse(wrong, key, "is not a number")
        values = values * factor
        self.refuse(np.abs(values) > LARGEST, key, f"is beyond {LARGEST:g}")
        return values

    def texts(self, key: str, blank: bool = False) -> NDArray:
        """Return a column as text, ``""`` for blank; refused unless ``blank``.

        Raises:
            DataError: naming the first row at fault.
        """
        column = pc.utf8_trim_whitespace(pc.cast(self.content[key], pa.string()))
        values = pc.fill_null(column, "").to_numpy().astype(str)
        if not blank:
            self.refuse(values == "", key, "is empty")
        return values

    def refuse(self, wrong: NDArray[np.bool_], key: str, words: str) -> None:
        """Raise a DataError that names the first row at fault and its cell, if there is one."""
        if not np.any(wrong):
            return
        row = int(np.argmax(wrong))
        cell = self.content[key][row].as_py() if key in self.content else None
        shown = "blank" if cell is None else repr(cell)[:40]
        place = f"data row {row + 1}, column {self.columns.get(key, key)!r}"
        raise DataError(f"{self.file}: {place} {words}: {shown}")

    def _cast(self, column: pa.ChunkedArray) -> pa.ChunkedArray:
        if pa.types.is_boolean(column.type) or pa.types.is_temporal(column.type):
            raise pa.ArrowInvalid(f"the column holds {column.type}")
        if not pa.types.is_string(column.type):
            return pc.cast(column, pa.float64())
        if self.decimal_comma:
            column = pc.replace_substring(column, ",", ".")
        try:
            return pc.cast(column, pa.float64())
        except pa.ArrowInvalid:
            return pc.cast(pc.utf8_trim_whitespace(column), pa.float64())

    def _not_a_number(self, key: str, error: Exception) -> NoReturn:
        """Name the first cell that is no number, found by bisection."""
        column, low = self.content[key], 0
        high = len(column)
        while high - low > 1:
            middle = (low + high) // 2
            try:
                self._cast(column[low:middle])
                low = middle
            except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
                high = middle
        self.refuse(np.arange(len(column)) == low, key, "is not a number")
        raise DataError(f"{self.file}: column {self.columns[key]!r}: {error}") from error


def read_table(
    path: str | Path, columns: Mapping[str, str | None], option: str, only: bool = True
) -> Table:
    """Read columns of a table.

    Of text, the separator is detected: comma, semicolon, tab, bar or spaces. Where it is the
    semicolon, numbers may have a decimal comma. The lines before the header of a native OpenACC
    file are kept apart.

    Args:
        path: a .csv file or the like, gzipped or not, or a .parquet file.
        columns: what they are called in the file, by their key; None for one that there is not.
        option: where the configuration has these names, for messages.
        only: read these columns only; otherwise the others, too, under their own names.

    Raises:
        DataError: if the file is missing, damaged or no table, or lacks a column.
        ConfigError: if it does not fit into memory.
    """
    file = Path(path).expanduser()
    if not file.is_file():
        raise DataError(f"{file}: no such file; expected a table, .csv or .parquet")
    wanted = {key: name for key, name in columns.items() if name is not None}
    twice = {name for name in wanted.values() if [*wanted.values()].count(name) > 1}
    if twice:
        raise ConfigError(f"{option} names the column {sorted(twice)[0]!r} twice")
    read = _read_parquet if file.suffix in PARQUET else _read_text
    return read(file, wanted, option, only)


def _chosen(table: Table, wanted: dict[str, str], only: bool) -> dict[str, str]:
    """Check that a header has what is wanted; return the name of each column to read by key."""
    missing = [name for name in wanted.values() if name not in table.header]
    if missing:
        raise DataError(_lacking(table, missing))
    for name in wanted.values():
        if table.header.count(name) > 1:
            raise DataError(f"{table.file}: has column {name!r} twice; expected it once")
    others = () if only else (name for name in table.header if name not in wanted.values())
    return {**wanted, **{name: name for name in others}}


def _lacking(table: Table, missing: list[str]) -> str:
    """Say which columns a file lacks, which it has, and what to do."""
    folded = {name.lower(): name for name in table.header}
    near = [
        f"{folded[found]!r} for {name!r}?"
        for name in missing
        for found in get_close_matches(name.lower(), folded, n=1)
    ]
    has = ", ".join(table.header[:SHOWN]) + (", …" if len(table.header) > SHOWN else "")
    hint = f" ({' '.join(near)})" if near else ""
    words = f"{table.file}: lacks the column {', '.join(missing)}; it has {has}{hint}"
    numbers = all(cell.replace(".", "").replace("-", "").isdigit() for cell in table.header)
    if numbers:
        words += "; its first line holds numbers, expected the names of the columns"
    return f"{words}; say which is which by {table.option}={{…}}"


# -- parquet ---------------------------------------------------------------------------------------


def _read_parquet(file: Path, wanted: dict[str, str], option: str, only: bool) -> Table:
    require_memory({f"reading {file}": UNPACKED * file.stat().st_size})
    try:
        table = Table(str(file), list(pq.read_schema(file).names), wanted, {}, option)
        table.columns = _chosen(table, wanted, only)
        frame = pq.read_table(file, columns=[*table.columns.values()])
        frame.validate(full=True)  # damaged text would fail only when used
    except DataError:
        raise
    except Exception as error:  # a damaged parquet file raises errors of many kinds
        raise DataError(f"{file}: not a readable table: {error}") from error
    for key, name in table.columns.items():
        column = frame[name]
        kind = column.type
        if pa.types.is_dictionary(kind):
            column = pc.cast(column, kind.value_type)
        if pa.types.is_large_string(column.type):
            column = pc.cast(column, pa.string())
        table.content[key] = column
    return table


def _read_text(file: Path, wanted: dict[str, str], option: str, only: bool) -> Table:
    text = Delimited(file)
    table = Table(str(file), text.header, wanted, {}, option, text.preamble, text.notes)
    table.columns, table.decimal_comma = _chosen(table, wanted, only), text.decimal_comma
    places = {key: text.header.index(name) for key, name in table.columns.items()}
    parsed = text.parse([*places.values()])
    table.content = {key: parsed[str(place)] for key, place in places.items()}
    return table
