"""Rows of an NGSIM file as text columns, read in blocks and checked."""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pa_csv
from numpy.typing import NDArray

from lcc_rl.data.ngsim_layouts import Layout, detect_layout
from lcc_rl.errors import DataError

BLANK = ["", "NA", "N/A", "nan", "NaN", "NAN", "NULL", "null", "None", "-"]
BLOCK_BYTES = 1 << 22
LONGEST_LINE = 1 << 24
THOUSANDS = r"^-?[0-9]{1,3}(,[0-9]{3})+(\.[0-9]*)?$"


class Block:
    """Consecutive rows of a file as text columns, converted and checked on access.

    Args:
        path: the file, for messages.
        lines: the text of the rows.
        first_line: number of the first line in the file, from 1.
        layout: how the rows are laid out.
    """

    def __init__(self, path: str, lines: bytes, first_line: int, layout: Layout) -> None:
        self.path, self.lines, self.first_line = path, lines, first_line
        self.table = self._parse(layout)
        self.rows_read = self.table.num_rows
        self._kept: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return int(self.table.num_rows)

    def has(self, name: str) -> bool:
        """Whether the file has this column."""
        return name in self.table.column_names

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Keep only the rows where ``mask`` holds; messages still name lines of the file."""
        kept = np.flatnonzero(mask)
        self._kept = kept if self._kept is None else self._kept[kept]
        self.table = self.table.filter(pa.array(mask))

    def locations(self) -> tuple[list[str], NDArray[np.int64]]:
        """Names in the Location column (lower case, '' where blank) and each row's index of it."""
        encoded = self.table["Location"].combine_chunks().dictionary_encode()
        if isinstance(encoded, pa.ChunkedArray):
            encoded = encoded.combine_chunks()
        names = [str(name).strip().lower() for name in encoded.dictionary.to_pylist()]
        codes = encoded.indices.fill_null(len(names)).to_numpy(zero_copy_only=False)
        return [*names, ""], codes.astype(np.int64)

    def numbers(self, name: str, unit: str, blank: float | None = None) -> NDArray[np.float64]:
        """Read a column of finite numbers.

        Args:
            name: official column name.
            unit: what the numbers are, for messages.
            blank: what a blank cell stands for; None where cells must not be blank.

        Raises:
            DataError: at a cell that is no finite number, or blank where that is not allowed.
        """
        column = self.table[name]
        try:
            numbers = pc.cast(column, pa.float64())
        except pa.ArrowInvalid:
            numbers = self._spelled(column, name, unit)
        values: NDArray[np.float64] = numbers.to_numpy()
        bad = ~np.isfinite(values)
        if not bad.any():
            return values
        # Blank cells and the word NaN both arrive here as NaN.
        wrong = bad if blank is None else np.isinf(values)
        if wrong.any():
            self.fail(int(np.argmax(wrong)), name, f"{unit}, a finite number")
        return np.nan_to_num(values, nan=blank or 0.0)

    def integers(
        self, name: str, low: int, high: int, blank: int | None = None
    ) -> NDArray[np.int64]:
        """Read a column of whole numbers within [low, high]; ``2322.0`` counts as whole.

        Raises:
            DataError: at a cell that is not such a number.
        """
        expected = f"a whole number of {low} to {high}"
        values = self.numbers(name, expected, None if blank is None else float(blank))
        wrong = (values != np.rint(values)) | (values < low) | (values > high)
        if blank is not None:
            wrong &= values != blank
        if wrong.any():
            self.fail(int(np.argmax(wrong)), name, expected)
        return values.astype(np.int64)

    def fail(self, row: int, name: str, expected: str) -> None:
        """Raise the DataError for the cell at ``row`` of column ``name``."""
        cell = self.table[name][row].as_py()
        place = row if self._kept is None else int(self._kept[row])
        shown = "is blank or NaN" if cell is None else f"holds {cell[:40]!r}"
        raise DataError(
            f"{self.path}: line {self._line_of_row(place)}, column {name!r} {shown}; "
            f"expected {expected}"
        )

    def _spelled(self, column: pa.ChunkedArray, name: str, unit: str) -> pa.ChunkedArray:
        """Convert numbers with surrounding spaces or thousands separators."""
        text = pc.utf8_trim_whitespace(column)
        # Only true thousands: a comma anywhere else would silently change the number.
        grouped = pc.match_substring_regex(text, THOUSANDS)
        text = pc.if_else(grouped, pc.replace_substring(text, ",", ""), text)
        text = pc.if_else(pc.equal(text, ""), pa.scalar(None, pa.string()), text)
        try:
            return pc.cast(text, pa.float64())
        except pa.ArrowInvalid:
            self.fail(_first_not_number(text.combine_chunks()), name, f"{unit}, a number")
            raise

    def _parse(self, layout: Layout) -> pa.Table:
        if not _is_text(self.lines):
            line = self._line_where(lambda found: not _is_text(found))
            raise DataError(f"{self.path}: line {line} is not text; expected UTF-8")
        names = [str(place) for place in range(layout.width)]
        wanted = {str(place): name for name, place in layout.places.items()}
        odd: list[pa_csv.InvalidRow] = []

        def note(row: pa_csv.InvalidRow) -> str:
            odd.append(row)
            return "error"

        try:
            table = pa_csv.read_csv(
                pa.BufferReader(self.lines),
                pa_csv.ReadOptions(
                    use_threads=False, column_names=names, block_size=len(self.lines) + 1
                ),
                pa_csv.ParseOptions(
                    delimiter=" " if layout.spaced else ",", invalid_row_handler=note
                ),
                pa_csv.ConvertOptions(
                    include_columns=list(wanted),
                    column_types=dict.fromkeys(wanted, pa.string()),
                    null_values=BLANK,
                    strings_can_be_null=True,
                ),
            )
        except pa.ArrowException as error:
            raise DataError(self._parse_message(odd, layout, error)) from error
        self._check_count(table.num_rows)
        return table.rename_columns([wanted[name] for name in table.column_names])

    def _parse_message(
        self, odd: list[pa_csv.InvalidRow], layout: Layout, error: pa.ArrowException
    ) -> str:
        if odd:
            text = odd[0].text.encode()
            line = self._line_where(lambda found: found.rstrip(b"\r") == text)
            return (
                f"{self.path}: line {line} has {odd[0].actual_columns} columns; "
                f"expected {layout.width} as in the first line"
            )
        reason = str(error).splitlines()[0]
        return f"{self.path}: from line {self.first_line}: expected rows of text: {reason}"

    def _check_count(self, parsed: int) -> None:
        """Check that no line was lost: an unclosed quote merges lines without an error."""
        if parsed == self.lines.count(b"\n") + (not self.lines.endswith(b"\n")):
            return
        if parsed == sum(1 for line in self.lines.split(b"\n") if line.strip(b"\r")):
            return
        line = self._line_where(lambda found: found.count(b'"') % 2 == 1 or b"\r" in found[:-1])
        raise DataError(
            f"{self.path}: line {line or self.first_line} has a quote that is not closed or a "
            "stray line end; expected one row per line"
        )

    def _line_where(self, holds: Callable[[bytes], bool]) -> int | None:
        lines = enumerate(self.lines.split(b"\n"), self.first_line)
        return next((number for number, line in lines if holds(line)), None)

    def _line_of_row(self, row: int) -> int:
        """Line number of a row; blank lines hold no row."""
        lines = enumerate(self.lines.split(b"\n"), self.first_line)
        return [number for number, line in lines if line.strip(b"\r")][row]


def read_blocks(path: str | Path) -> Iterator[Block]:
    """Read a plain or gzipped file in any published layout.

    Yields:
        Blocks of rows, in the order of the file.

    Raises:
        DataError: if the file is missing, damaged, empty, not text, or of no known layout.
    """
    name = str(path)
    layout: Layout | None = None
    first_line = 1
    empty = True
    for raw in _line_chunks(name):
        lines = raw
        if layout is None:
            lines = lines.removeprefix(b"\xef\xbb\xbf")
            bare = lines.lstrip(b" \t\r\n")
            if not bare:
                first_line += raw.count(b"\n")
                continue
            first_line += lines[: len(lines) - len(bare)].count(b"\n")
            layout, lines = detect_layout(name, bare)
            first_line += layout.header
        if layout.spaced:
            lines = single_spaces(lines)
        if lines.strip(b"\r\n"):
            empty = False
            yield Block(name, lines, first_line, layout)
        first_line += lines.count(b"\n")
    if empty:
        what = "is empty" if layout is None else "has a header but no rows"
        raise DataError(f"{name}: {what}; expected NGSIM trajectories")


def _line_chunks(name: str) -> Iterator[bytes]:
    """Whole lines of the decompressed file, some megabytes at a time."""
    rest = b""
    try:
        with opened(name) as file:
            while data := file.read(BLOCK_BYTES):
                cut = data.rfind(b"\n") + 1
                if cut:
                    yield rest + data[:cut]
                    rest = data[cut:]
                else:
                    rest += data
                if len(rest) > LONGEST_LINE:
                    raise DataError(f"{name}: is not a text table; expected lines of 18 columns")
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise DataError(f"{name}: the compressed file is damaged or cut off: {error}") from error
    except OSError as error:
        raise DataError(f"{name}: cannot be read: {error.strerror or error}") from error
    if rest:
        yield rest


def opened(name: str) -> IO[bytes]:
    """Open a file, decompressed where its first bytes are those of gzip."""
    if Path(name).exists() and not Path(name).is_file():  # a pipe would be waited for
        raise DataError(f"{name}: cannot be read: a folder, pipe or device; expected a file")
    with open(name, "rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
    return gzip.open(name, "rb") if packed else open(name, "rb")  # type: ignore[return-value]


def _is_text(lines: bytes) -> bool:
    try:
        return lines.isascii() or bool(lines.decode("utf-8"))
    except UnicodeDecodeError:
        return False


def single_spaces(lines: bytes) -> bytes:
    """Lines with one space between columns and none around the row."""
    lines = re.sub(rb" {2,}", b" ", lines.replace(b"\t", b" "))
    lines = lines.replace(b" \r", b"\r").replace(b" \n", b"\n").replace(b"\n ", b"\n")
    return lines.strip(b" ")


def _first_not_number(text: pa.Array) -> int:
    """Index of the first cell that is not a number, by bisection."""
    low, high = 0, len(text)
    while high - low > 1:
        middle = (low + high) // 2
        try:
            pc.cast(text[low:middle], pa.float64())
            low = middle
        except pa.ArrowInvalid:
            high = middle
    return low
