"""Text tables: CSV with any usual separator, plain or gzipped."""

from __future__ import annotations

import csv
import gzip
import os
import zlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import pyarrow as pa
import pyarrow.csv as pa_csv

from lcc_rl.data.ngsim_blocks import BLANK, opened, single_spaces
from lcc_rl.errors import DataError
from lcc_rl.io.memory import require_memory

SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}
PREAMBLE = 20  # lines within which the header of a native OpenACC file begins
TAKEN = 3  # bytes of memory that reading a byte of text takes


class Delimited:
    """A text table: its header, and its rows to be parsed.

    The separator is the one that divides the header and the row after it alike: comma, semicolon,
    tab, bar or spaces. Where it is the semicolon, numbers may have a decimal comma. The lines
    before the header of a native OpenACC file are kept apart.

    Args:
        file: plain or gzipped.

    Raises:
        DataError: if the file cannot be read, is damaged, empty or no text.
        ConfigError: if it does not fit into memory.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        content = unpacked(file).removeprefix(b"\xef\xbb\xbf").lstrip(b"\r\n")
        try:
            content.isascii() or content.decode("utf-8")
        except UnicodeDecodeError as error:
            line = content[: error.start].count(b"\n") + 1
            raise DataError(f"{file}: line {line} is not text; expected UTF-8") from error
        if not content.strip():
            raise DataError(f"{file}: not a readable table: empty; expected a header and rows")
        self.preamble, content = _preamble(content)
        self.separator = _separator(content)
        if self.separator == " ":
            content = single_spaces(content)
        first, _, self.rows = content.partition(b"\n")
        self.header = [name.strip() for name in _cells(first, self.separator)]
        if not self.header:
            raise DataError(f"{file}: not a readable table: the first line names no columns")
        self.decimal_comma = self.separator == ";" and b"," in self.rows and b"." not in self.rows
        self.notes = []
        if self.separator != ",":
            self.notes.append(f"{file}: columns are separated by {SEPARATORS[self.separator]}")
        if self.decimal_comma:
            self.notes.append(f"{file}: numbers have a decimal comma")

    def parse(self, places: Sequence[int]) -> pa.Table:
        """Return the columns at some places as text, each named by its place, from 0.

        Raises:
            DataError: if a row has more or fewer columns than the header.
        """
        names = [str(place) for place in range(len(self.header))]
        wanted = [str(place) for place in places]
        if not self.rows.strip():
            return pa.table({name: pa.chunked_array([], pa.string()) for name in wanted})
        odd: list[pa_csv.InvalidRow] = []

        def note(row: pa_csv.InvalidRow) -> str:
            odd.append(row)
            return "error"

        try:
            return pa_csv.read_csv(
                pa.BufferReader(self.rows),
                pa_csv.ReadOptions(use_threads=False, column_names=names),
                pa_csv.ParseOptions(delimiter=self.separator, invalid_row_handler=note),
                pa_csv.ConvertOptions(
                    include_columns=wanted,
                    column_types=dict.fromkeys(wanted, pa.string()),
                    null_values=BLANK,
                    strings_can_be_null=True,
                ),
            )
        except pa.ArrowException as error:
            if not odd:
                raise DataError(f"{self.file}: not a readable table: {error}") from error
            raise DataError(
                f"{self.file}: data row {odd[0].number} has {odd[0].actual_columns} columns; "
                f"expected {odd[0].expected_columns} as in the header"
            ) from error


def unpacked_size(name: str) -> int:
    """Return the bytes of a file, of a compressed one those of its content; 0 for none."""
    if not Path(name).is_file():  # a pipe would be waited for; who reads it says so
        return 0
    with suppress(OSError), open(name, "rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
        size = file.seek(0, os.SEEK_END)
        if not packed:
            return size
        file.seek(max(0, size - 4))
        # Of the content, modulo 4 GiB, which is never less than the file itself.
        return max(size, int.from_bytes(file.read(4), "little"))
    return 0


def unpacked(file: Path) -> bytes:
    """Return the content of a plain or gzipped file.

    Raises:
        DataError: if it cannot be read or is damaged.
        ConfigError: if it does not fit into memory.
    """
    require_memory({f"reading {file}": TAKEN * unpacked_size(str(file))})
    try:
        with opened(str(file)) as stream:
            return stream.read()
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise DataError(f"{file}: the compressed file is damaged or cut off: {error}") from error
    except OSError as error:
        raise DataError(f"{file}: cannot be read: {error.strerror or error}") from error


def _preamble(content: bytes) -> tuple[dict[str, str], bytes]:
    """Lines before the header of a native OpenACC file, by their first cell, and what follows."""
    lines: list[bytes] = []
    rest = content
    for _ in range(PREAMBLE):
        line, found, after = rest.partition(b"\n")
        if line.startswith(b"Time,") and b",Speed1," in line:
            cells = (text.decode().strip("\r, ").partition(",") for text in lines)
            return {name: value for name, _, value in cells}, rest
        if not found:
            break
        lines.append(line)
        rest = after
    return {}, content


def _cells(line: bytes, separator: str) -> list[str]:
    """Cells of a line; none of one that cannot be divided, as with a stray line end in it."""
    with suppress(csv.Error):
        return next(csv.reader([line.decode().rstrip("\r\n")], delimiter=separator), [])
    return []


def _separator(content: bytes) -> str:
    """The separator that divides the header and the row after it alike, into most cells."""
    first, second = [*content.split(b"\n", 2)[:2], b""][:2]
    best, most = ",", 1
    for separator in SEPARATORS:
        lines = first, second
        if separator == " ":
            if most > 1:  # names may hold spaces
                break
            lines = single_spaces(first), single_spaces(second)
        counts = [len(_cells(line, separator)) for line in lines]
        if counts[0] > most and (counts[0] == counts[1] or not second.strip()):
            best, most = separator, counts[0]
    return best


def is_openacc(file: Path) -> bool:
    """Return whether a file is a native OpenACC file, by its first lines."""
    if file.suffix in (".parquet", ".pq") or not file.is_file():
        return False
    try:
        with opened(str(file)) as stream:
            return bool(_preamble(stream.read(1 << 16))[0])
    except (EOFError, zlib.error, OSError, UnicodeDecodeError):
        return False  # who reads it says what is wrong


def stem(file: str | Path) -> str:
    """Return the name of a file without folder and endings, ``a`` of ``x/a.csv.gz``."""
    name = Path(file).name
    return Path(name.removesuffix(".gz")).stem
