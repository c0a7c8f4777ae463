"""Reader of tables of measurements in CSV or parquet files.

Each reader lists its columns as :class:`Column`. :meth:`TableFile.read` checks every cell: numbers
are finite, in SI and within the range of their quantity.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from os.path import expanduser, getsize, isfile  # pathlib's raises for an unknown user
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pandas.api.types import union_categoricals

from lcc_rl.data.columns import QUESTIONS, SI, UNITS, Column, Names, Units, named_unit, unit_size
from lcc_rl.data.text import (
    NO_TABLE,
    NUMBER,
    SEPARATORS,
    cells_of,
    is_relative,
    labels,
    lacking,
    line_chunks,
    parse_text,
    preamble,
    separator_of,
    single_spaces,
    stem,
    unended,
)
from lcc_rl.data.trajectories import BATCH, listed
from lcc_rl.errors import Concern, DataError, in_short, raised_as
from lcc_rl.io.memory import require_memory

log = logging.getLogger("lcc_rl")

PARQUET = (".parquet", ".pq")
EVERY = 10.0  # time between lines on the progress [s]
LONGEST_TEXT = 1000  # most characters of a name
LARGEST_ID = 2**53  # larger whole numbers do not fit a float
THOUSANDS = r"^-?[0-9]{1,3}(,[0-9]{3})+(\.[0-9]*)?$"
NUMERIC_TYPES = (pa.types.is_floating, pa.types.is_integer, pa.types.is_null, pa.types.is_decimal)
CLOCK_TIME = r"^ *([01]?[0-9]|2[0-3]):[0-5][0-9]:[0-5][0-9]([.,][0-9]+)? *$"
APART = "no row has all columns: merge signals at their own times, such as by table.set_index"
APART += "({time!r}).interpolate('index').dropna() of pandas"
Cells = Any  # a pyarrow array, chunked or not
Fault = Callable[[int, str], DataError]  # returns the error for a row and words


class TableFile:
    """Table in a file; its columns are read once, on demand.

    The separator of text is the one that divides the header and the next row equally: comma,
    semicolon, tab, bar or spaces. With semicolons, numbers may have a decimal comma. ``preamble``
    holds the lines before the header of a native OpenACC file, ``folders`` the columns that
    folders such as ``day=3`` add to the header.

    Args:
        path: a .csv or other text file, gzipped or not, or a .parquet file.
        spelled: maps a name in the header to that of a column.
        bare: names of the columns of text without a header.
        label: its name as a recording or drive; by default the stem.

    Raises:
        DataError: if the file is missing, damaged or no table.
    """

    def __init__(
        self,
        path: str | Path,
        spelled: Callable[[str], str] = str.strip,
        bare: Sequence[str] = (),
        label: str = "",
    ) -> None:
        self.path, self.label = Path(expanduser(path)), label or stem(path)
        self.preamble: dict[str, str] = {}
        self.notes: list[str] = []
        self.names: dict[str, str] = {}
        self.first: list[str] = []  # cells of the first row of text
        self.count = 0  # number of rows, known after reading
        self.comma = False  # whether numbers have a decimal comma
        self.units = ""  # place of the units in the configuration, if they are settings
        if not self.path.is_file():
            raise DataError(f"{self.path}: no such file; expected a table, .csv or .parquet")
        self.parquet = self.path.suffix in PARQUET
        if self.parquet:
            with raised_as(DataError, f"{self.path}: not a readable table", Exception):
                self.header = [*pq.read_schema(self.path).names]
        else:
            self._open_text(spelled, bare)
        keys = dict(folder.split("=", 1) for folder in self.path.parent.parts if "=" in folder)
        self.folders = {key: keys[key] for key in keys if key not in self.header}
        self.width, self.header = len(self.header), [*self.header, *self.folders]

    def read(
        self,
        columns: Iterable[Column],
        names: Names,
        units: Units | None = None,
        option: str = "",
        measured: Iterable[str] = (),
    ) -> dict[str, Any]:
        """Read columns and check every cell.

        Args:
            columns: the columns, with keys and kinds.
            names: the file's names, by key; None for a missing column.
            units: units by key; by default SI.
            option: place of the names in the configuration, for messages.
            measured: keys of columns; rows with a blank cell in one of them are left out.

        Returns:
            The columns by key, in SI, text as a categorical with sorted categories, and ``row``,
            the number of each row in the file, from 0.

        Raises:
            DataError: if a column is missing, or naming the row and column of a cell at fault, or
                if every row has a blank cell.
        """
        self.units = option and f"{option.removesuffix('columns')}units"
        self.names = {c.key: name for c in columns if (name := names.get(c.key)) is not None}
        missing = [name for name in self.names.values() if name not in self.header]
        if missing:
            raise lacking(str(self.path), missing, self.header, option)
        for column in columns:
            unit = (units or {}).get(column.key, SI.get(column.quantity))
            if column.key not in self.names and unit != SI.get(column.quantity):
                at = f"{self.units}.{column.key}={unit}"
                raise DataError(f"{self.path}: {at} has no effect: no column is {column.key}")
        for key, used in ((c.key, c.used) for c in columns if c.key in self.header):
            if key not in names and key not in self.names.values():
                message = f"column {key!r} is not read"
                message += f" unless {option}.{key} names it{used}" * bool(option)
                self.notes.append(Concern(f"{self.path}: {message}"))
        scales = {
            column: self._scale(column, units or {}, option)
            for column in columns
            if column.key in self.names
        }
        parts = [
            {x.key: block.values(x, self.names[x.key], scale) for x, scale in scales.items()}
            for block in self.blocks([*self.names.values()])
        ]
        read = joined_columns(parts)
        self.count = len(next(iter(read.values())))
        return self._measured({**read, "row": np.arange(self.count)}, measured)

    def _measured(self, read: dict[str, Any], keys: Iterable[str]) -> dict[str, Any]:
        """Return columns without rows in which one of ``keys`` is blank; the notes count them."""
        blank = {key: np.isnan(read[key]) for key in keys if key in read}
        wrong = np.logical_or.reduce([np.zeros(self.count, dtype=bool), *blank.values()])
        if not wrong.any():
            return read
        row = int(np.argmax(wrong))
        first = self.fault(row, next(key for key in blank if blank[key][row]), "is blank or NaN")
        if wrong.all() and not any(column.all() for column in blank.values()):
            raise DataError(f"{first}; {APART.format(time=self.names.get('time'))}")
        if wrong.all():
            raise first
        line = f"left out {int(wrong.sum()):,} rows with a blank cell, the first: {first}"
        self.notes.append(line)
        return chosen(read, ~wrong)

    def _scale(self, column: Column, units: Units, option: str) -> float:
        """Return the size of a column's unit in SI; refuse another unit in its name."""
        unit, name = units.get(column.key, SI.get(column.quantity, "")), self.names[column.key]
        scale = (unit and unit_size(column.quantity, unit)) or 1.0
        if column.quantity == "speed" and is_relative(name) and column.key != "relative_speed":
            message = f"column {name!r} holds a relative speed; add the other car's, or rename it"
            if column.key == "leader_speed":
                message = f"column {name!r} is relative: name it data.columns.relative_speed"
            raise DataError(f"{self.path}: {message}")
        named = named_unit(name, column.quantity)
        if option and named and UNITS[column.quantity][named] != scale:
            where = f"{option.removesuffix('columns')}units.{column.key}={named}"
            raise DataError(
                f"{self.path}: the name of column {name!r} contains {named}, but it is read in "
                f"{unit}; set {where}, or rename the column"
            )
        return scale

    def blocks(self, names: Sequence[str]) -> Iterator[Block]:
        """Yield the rows in blocks, some megabytes each for text; at least one, possibly empty.

        Args:
            names: the columns to read, as in the header.
        """
        for name in names:
            if self.header.count(name) > 1:
                message = f"has column {name!r} twice; expected it once, and common times"
                raise DataError(f"{self.path}: {message}")
        for rows, before in self._rows([name for name in names if name not in self.folders]):
            for name in (name for name in names if name in self.folders):
                cells = pa.array([self.folders[name]] * rows.num_rows, pa.string())
                rows = rows.append_column(name, cells)
            yield Block(self, rows, before)

    def _rows(self, names: Sequence[str]) -> Iterator[tuple[pa.Table, int]]:
        """Yield rows of the file, and the number of rows before them."""
        if self.parquet:
            with (
                raised_as(DataError, f"{self.path}: not a readable table", Exception),
                pq.ParquetFile(self.path, read_dictionary=[*names], buffer_size=2**20) as file,
            ):
                row = 0
                for group in range(file.num_row_groups):  # all at once are all in the memory
                    for batch in file.iter_batches(BATCH, row_groups=[group], columns=[*names]):
                        batch.validate(full=True)  # else damaged text would fail only when used
                        yield pa.Table.from_batches([batch]), row
                        row += len(batch)
                if not row:
                    yield file.schema_arrow.empty_table().select([*names]), 0
            return
        places, row = {str(self.header.index(name)): name for name in names}, 0
        for lines in self.lines:
            if self.separator == " ":
                lines = single_spaces(lines)
            if not lines.strip():
                continue
            source = str(self.path)
            table = parse_text(lines, self.width, self.separator, [*places], source, row)
            yield table.rename_columns([places[x] for x in table.column_names]), row
            row += table.num_rows
            self.notes += unended(lines, f"{self.path}: data row {row}")
        if not row:
            yield pa.table({name: pa.array([], pa.string()) for name in names}), 0

    def fault(self, row: int, key: str, words: str) -> DataError:
        """Return the error about a cell."""
        name, units = self.names.get(key, key), chain.from_iterable(UNITS.values())
        if row == 0 and {cell.strip(" []()") for cell in self.first} & {*units}:
            words = f"{words}; does this row hold units? Remove it, and set units={{…}}"
        return DataError(f"{self.path}: data row {row + 1}, column {name!r} {words}")

    def _open_text(self, spelled: Callable[[str], str], bare: Sequence[str]) -> None:
        chunks = line_chunks(self.path, self.notes)
        content = next(chunks, b"").removeprefix(b"\xef\xbb\xbf")
        self.preamble, content = preamble(re.sub(rb"\A([ \t]*\r?\n)+", b"", content))
        for start in filter(content.startswith, NO_TABLE):
            raise DataError(f"{self.path}: is {NO_TABLE[start]}")
        self.separator = separator_of(content)
        first, _, rows = content.partition(b"\n")
        if self.separator == " ":
            first = single_spaces(first)
        self.header = [spelled(name) for name in cells_of(first, self.separator)]
        if not self.header:
            raise DataError(f"{self.path}: not a readable table: empty, or names no columns")
        if bare and re.match(NUMBER, self.header[0].replace(",", "")):
            if len(self.header) != len(bare):
                raise DataError(
                    f"{self.path}: the first line has {len(self.header)} columns and no header; "
                    f"expected the {len(bare)} columns of the native layout"
                )
            self.header, rows = [*bare], content
        self.lines = chain([rows], chunks)
        self.first = cells = cells_of(rows.partition(b"\n")[0], self.separator)
        if len(cells) == len(self.header) + 1 and not cells[-1].strip():
            self.header.append("")  # rows end in a separator
        if self.separator != ",":
            note = f"columns are separated by {SEPARATORS[self.separator]}"
            self.notes.append(f"{self.path}: {note}")
        self.comma = self.separator == ";" and b"," in rows and b"." not in rows
        if self.comma:
            self.notes.append(f"{self.path}: numbers have a decimal comma")


def tables_of(files: Sequence[str]) -> Iterator[TableFile]:
    """Yield the tables of files, and log the progress every few seconds.

    Raises:
        ConfigError: if reading them needs more memory than is free.
    """
    require_memory({f"reading {listed(files)}": sum(map(_memory, filter(isfile, files)))})
    due = monotonic() + EVERY
    for number, (name, label) in enumerate(zip(files, labels(files), strict=True)):
        if monotonic() > due:
            log.info("read %d of %d files", number, len(files))
            due = monotonic() + EVERY
        yield TableFile(name, label=label)


def _memory(file: str) -> float:
    """Return the memory for reading a file, as measured with millions of rows [bytes]."""
    if Path(file).suffix in PARQUET:
        with suppress(pa.ArrowException):  # the reader refuses a damaged file
            metadata = pq.read_metadata(file)
            return 40.0 * metadata.num_rows * metadata.num_columns
    return 10.0 * getsize(file)


class Block:
    """Consecutive rows of a table; cells are converted and checked on demand.

    Args:
        cells: unconverted cells by the names in the header.
        before: number of rows before these in the file.
    """

    def __init__(self, file: TableFile, cells: pa.Table, before: int = 0) -> None:
        self.file, self.cells = file, cells
        self.row = before + np.arange(len(self))

    def __len__(self) -> int:
        return int(self.cells.num_rows)

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Keep only the rows where ``mask`` is true; messages still name rows of the file."""
        self.row, self.cells = self.row[mask], self.cells.filter(pa.array(mask))

    def values(self, column: Column, name: str, scale: float = 1.0) -> Any:
        """Return the values of a column in SI, see :func:`checked_cells`."""

        def fault(row: int, words: str) -> DataError:
            return self.file.fault(int(self.row[row]), column.key, words)

        return checked_cells(self.cells[name], column, fault, scale, self.file)


# -- cells -----------------------------------------------------------------------------------------


def checked_cells(cells: Cells, column: Column, fault: Fault, scale: float, file: TableFile) -> Any:
    """Return the checked values of a column, numbers or a categorical.

    Args:
        cells: unconverted cells.
        column: the column, with the valid range.
        fault: returns the error for a row.
        scale: factor to SI.
        file: the file of the cells.

    Raises:
        DataError: for the first wrong cell.
    """
    if column.quantity == "text":
        texts = categorical(cells)
        for text in texts.categories[texts.categories.str.len() > LONGEST_TEXT]:
            row = int(np.argmax(texts == text))
            raise fault(row, f"holds a text of {len(text):,} characters; expected a name")
        if not column.blank and (blank := texts == "").any():
            raise fault(int(np.argmax(blank)), "is blank")
        return texts
    values = numbers_of(_seconds(cells) if column.quantity == "time" else cells, fault, file.comma)
    if scale != 1.0:
        values = values * scale
    least, most = (values.min(), values.max()) if len(values) else (column.least, column.most)
    inside = column.least <= least and most <= column.most  # false for NaN
    if inside and not (column.whole and (values != np.rint(values)).any()):
        return values
    wrong = ~((values >= column.least) & (values <= column.most))
    if column.whole:
        wrong |= values != np.rint(values)
    if column.blank:
        wrong &= ~np.isnan(values)
    if wrong.any():
        row = int(np.argmax(wrong))
        hint = f", {column.least / scale:g} to {column.most / scale:g} in its unit"
        if scale == 1.0:
            unit = f"{file.units}.{column.key}" if file.units else "convert it"
            hint = QUESTIONS.get(column.quantity, "").format(unit)
        raise fault(row, f"holds {_shown(cells[row])}; expected {column.expected}{hint}")
    return values


def categorical(cells: Cells) -> pd.Categorical:
    """Return trimmed texts, ``""`` for blank cells; each text is stored once."""
    if isinstance(cells, pa.ChunkedArray):
        return joined([categorical(chunk) for chunk in cells.chunks or [pa.array([], pa.string())]])
    encoded = cells.dictionary_encode()
    names = pc.utf8_trim_whitespace(pc.cast(encoded.dictionary, pa.string())).fill_null("")
    trimmed = [*names.to_pylist(), *[""] * (encoded.null_count > 0)]
    texts, inverse = np.unique(np.array(trimmed, dtype=object), return_inverse=True)
    codes = inverse[np.asarray(encoded.indices.fill_null(len(names)))]
    return pd.Categorical.from_codes(codes, pd.Index(texts, dtype=object))


def chosen(read: Mapping[str, Any], rows: NDArray[np.bool_]) -> dict[str, Any]:
    """Return some rows of columns, with the categories that they use."""
    columns = {key: values[rows] for key, values in read.items()}
    return {
        key: x.remove_unused_categories() if isinstance(x, pd.Categorical) else x
        for key, x in columns.items()
    }


def same_text(text: str, rows: int) -> pd.Categorical:
    """Return a column with one text in all rows."""
    return pd.Categorical.from_codes(np.zeros(rows, np.int8), pd.Index([text], dtype=object))


def joined(parts: Sequence[Any]) -> Any:
    """Return consecutive parts of a column; the categories of all are sorted."""
    if isinstance(parts[0], pd.Categorical):
        return parts[0] if len(parts) == 1 else union_categoricals([*parts], sort_categories=True)
    return np.concatenate(parts)


def joined_columns(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the joined columns of consecutive parts, which are emptied to spare memory."""
    whole = {}
    for key in [*parts[0]]:
        whole[key] = joined([part.pop(key) for part in parts])
        pa.default_memory_pool().release_unused()
    return whole


def _shown(cell: pa.Scalar) -> str:
    value = cell.as_py()
    return "nothing" if value is None else in_short(value, 40)


def _seconds(cells: Cells) -> Cells:
    """Return ISO 8601 times as seconds since 1970, clock times since midnight, else the numbers.

    Those in single precision become their shortest decimals: 407.9, not 407.89999.
    """
    if pa.types.is_float32(cells.type):
        return pc.cast(pc.cast(cells, pa.string()), pa.float64())
    if not (pa.types.is_string(cells.type) or pa.types.is_timestamp(cells.type)):
        return cells
    for kind in (pa.timestamp("ns"), pa.timestamp("ns", "UTC")):
        with suppress(pa.ArrowInvalid):
            count = pc.cast(pc.cast(cells, kind), pa.int64())
            return pc.multiply(pc.cast(count, pa.float64(), safe=False), 1e-9)
    match = pc.match_substring_regex
    if pa.types.is_string(cells.type) and pc.any(match(cells[:99], CLOCK_TIME)).as_py():
        which, text = match(cells, CLOCK_TIME), pc.utf8_trim_whitespace(cells)
        text = pc.replace_substring_regex(pc.replace_substring(text, ",", "."), "^(.):", r"0\1:")
        stamps = pc.binary_join_element_wise("1970-01-01T", text, "")
        seconds = _seconds(pc.if_else(which, stamps, pa.scalar(None, pa.string())))
        return pc.if_else(which, pc.cast(seconds, pa.string()), cells)
    return cells


def numbers_of(cells: Cells, fault: Fault, comma: bool) -> NDArray[np.float64]:
    """Return cells as numbers, NaN for blank ones; decimal commas or thousands are allowed.

    Raises:
        DataError: for the first cell that is no number.
    """
    if pa.types.is_dictionary(cells.type):
        cells = pc.cast(cells, cells.type.value_type)
    if pa.types.is_string(cells.type) or pa.types.is_large_string(cells.type):
        texts = cells
        if comma:
            cells = pc.replace_substring(cells, ",", ".")
        with suppress(pa.ArrowInvalid):
            return np.asarray(pc.cast(cells, pa.float64()), dtype=np.float64)
        cells = pc.utf8_trim_whitespace(cells)
        # Only true thousands: another comma would silently change the number.
        grouped = pc.match_substring_regex(cells, THOUSANDS)
        cells = pc.if_else(grouped, pc.replace_substring(cells, ",", ""), cells)
        cells = pc.if_else(pc.equal(cells, ""), pa.scalar(None, cells.type), cells)
        sound = np.asarray(pc.fill_null(pc.match_substring_regex(cells, NUMBER), True))
        if not sound.all():
            row = int(np.argmin(sound))
            clock = ", or hh:mm:ss, or a time of ISO 8601" if ":" in str(texts[row]) else ""
            raise fault(row, f"holds {_shown(texts[row])}; expected a number{clock}")
    elif not any(kind(cells.type) for kind in NUMERIC_TYPES):
        raise fault(0, f"is of type {cells.type}; expected numbers")
    return np.asarray(pc.cast(cells, pa.float64(), safe=False), dtype=np.float64)


def whole_numbers(texts: NDArray) -> NDArray[np.int64] | None:
    """Return texts as numbers if all are whole numbers, else None."""
    try:
        values = texts.astype(np.float64)
    except ValueError:
        return None
    if not (np.abs(values) < LARGEST_ID).all() or (values != np.rint(values)).any():
        return None
    return values.astype(np.int64)
