"""Text files: decompression, encodings, separators and parsing into columns of text."""

from __future__ import annotations

import csv
import gzip
import re
import zlib
from codecs import EncodedFile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from io import BufferedReader
from itertools import takewhile
from operator import add
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv as pa_csv

from lcc_rl.errors import Concern, DataError

BLANK = ["", "NA", "N/A", "n/a", "nan", "NaN", "NAN", "NULL", "null", "None", "-"]
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}
PREAMBLE = 20  # lines within which the header of a native OpenACC file begins
LONG_ROW = 3  # rows with more columns than this multiple of the header's hold several samples
BLOCK_BYTES, LONGEST_LINE = 1 << 22, 1 << 24  # bytes per block; longest line
UTF16 = b"\xff\xfe", b"\xfe\xff"
NUMBER = r"^-?(([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[iI][nN][fF]|[nN][aA][nN])$"
RELATIVE = r"\b(rel|relative|delta|closing|range rate|dv)\b"  # in names of columns of speeds
OF_POSITIONS = (
    "; data=table has gaps of positions: data.columns={vehicle: …, position: …, length: …}"
)
# Other formats by their first bytes, with the remedy.
OTHER_FORMATS = {
    b"PK\x03\x04": " but a spreadsheet (xlsx, ods) or zip archive; save the table as CSV",
    b"\xd0\xcf\x11\xe0": " but an Excel workbook (xls); save the table as CSV",
    b"MATLAB": " but a MATLAB file (mat); save the table with writetable(…, 'x.csv')",
    b"\x89HDF": " but an HDF5 or MATLAB file (mat); save the table as CSV",
    b"PAR1": " but a parquet file; name it .parquet",
    **dict.fromkeys(UTF16, " but in UTF-16; save it in UTF-8"),
}
NO_TABLE = {
    b"version https://git-lfs": "a Git LFS pointer in place of the file: run git lfs pull",
    b"File created on ": "a VBOX file (vbo): save its [data] as CSV, with times as hh:mm:ss",
    b"MDF  ": "an MDF measurement: save its channels as a table with asammdf (docs/data.md)",
    b"<": "XML or HTML; save the table as CSV (SUMO: --fcd-output fcd.csv)",
}


@contextmanager
def opened(name: str | Path) -> Iterator[BufferedReader]:
    """Open a plain or gzipped file, distinguished by its first bytes.

    Raises:
        DataError: if it cannot be read or is damaged.
    """
    if Path(name).exists() and not Path(name).is_file():  # opening a pipe would block
        raise DataError(f"{name}: cannot be read: a folder, pipe or device; expected a file")
    try:
        with open(name, "rb") as file:
            packed = file.read(2) == b"\x1f\x8b"
            file.seek(0)
            yield BufferedReader(gzip.GzipFile(fileobj=file)) if packed else file
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise DataError(f"{name}: the compressed file is damaged or cut off: {error}") from error
    except OSError as error:
        raise DataError(f"{name}: cannot be read: {error.strerror or error}") from error


def line_chunks(path: Path, notes: list[str]) -> Iterator[bytes]:
    """Yield whole lines of a file as UTF-8, some megabytes at a time.

    Args:
        path: the file, in UTF-8, UTF-16 or else Latin-1.
        notes: gets a line if the file is not in UTF-8.

    Raises:
        DataError: if it cannot be read, or is no text.
    """
    rest = b""
    with opened(path) as file:
        wide = file.peek(2)[:2] in UTF16
        source: Any = EncodedFile(file, "utf-8", "utf-16") if wide else file
        notes += [f"{path}: is not UTF-8 and was read as UTF-16"] * wide
        try:
            while data := source.read(BLOCK_BYTES):
                lines, end, rest = (rest + data).rpartition(b"\n")
                if end:
                    yield _as_utf8(lines + end, path, notes)
                if len(rest) > LONGEST_LINE:
                    raise DataError(f"{path}: is not a text table; expected lines")
        except UnicodeError:
            raise DataError(f"{path}: is not UTF-8 text{OTHER_FORMATS[UTF16[0]]}") from None
    if rest:
        yield _as_utf8(rest, path, notes)


def _as_utf8(content: bytes, path: Path, notes: list[str]) -> bytes:
    """Return text in UTF-8, converted from Latin-1 if necessary."""
    with suppress(UnicodeDecodeError):
        if b"\0" not in content and (content.isascii() or content.decode("utf-8")):
            return content
    if content.startswith((b"\0", *OTHER_FORMATS)) or b"\0" in content:
        kinds = (kind for start, kind in OTHER_FORMATS.items() if content.startswith(start))
        raise DataError(f"{path}: is not UTF-8 text{next(kinds, '; expected a table')}")
    line = f"{path}: is not UTF-8 and was read as Latin-1"
    notes += [line] * (line not in notes)
    return content.decode("Latin-1").encode()


def single_spaces(lines: bytes) -> bytes:
    """Return lines with one space between columns and none around the row."""
    lines = re.sub(rb" {2,}", b" ", lines.replace(b"\t", b" "))
    lines = lines.replace(b" \r", b"\r").replace(b" \n", b"\n").replace(b"\n ", b"\n")
    return lines.strip(b" ")


def cells_of(line: bytes, separator: str) -> list[str]:
    """Return the cells of a line; none if it cannot be divided, e.g. at a stray line end."""
    with suppress(csv.Error):
        return next(csv.reader([line.decode().rstrip("\r\n")], delimiter=separator), [])
    return []


def preamble(content: bytes) -> tuple[dict[str, str], bytes]:
    """Return the lines before the header of a native OpenACC file by first cell, and the rest."""
    if re.match(rb"Version:.*OpenSCENARIO:", content):  # the first line of esmini's files
        return {}, content.partition(b"\n")[2]
    lines = content.split(b"\n", PREAMBLE)[:PREAMBLE]
    for number, line in enumerate(lines):
        if line.startswith(b"Time,") and b",Speed1," in line:
            cells = (text.decode().strip("\r, ").partition(",") for text in lines[:number])
            return {name: value for name, _, value in cells}, content.split(b"\n", number)[number]
    return {}, content


def separator_of(content: bytes) -> str:
    """Return the separator that divides the header and the next row equally, into most cells."""
    first, second = [*content.split(b"\n", 2)[:2], b""][:2]
    best, most, wide = ",", 1, ","
    for separator in SEPARATORS:
        lines = first, second
        if separator == " ":
            if most > 1:  # names may contain spaces
                break
            lines = single_spaces(first), single_spaces(second)
        counts = [len(cells_of(line, separator)) for line in lines]
        blank = second.rstrip(b"\r").endswith(separator.encode())  # a last cell without a name
        if counts[0] > most and (counts[0] in (counts[1], counts[1] - blank) or not second.strip()):
            best, most = separator, counts[0]
        elif counts[1] > LONG_ROW * counts[0] > LONG_ROW and separator != " ":
            wide = separator
    return best if most > 1 else wide


def stem(file: str | Path) -> str:
    """Return the name of a file without folder and endings, ``a`` for ``x/a.csv.gz``."""
    return Path(Path(file).name.removesuffix(".gz")).stem


def labels(files: Sequence[str]) -> list[str]:
    """Return the names of files' recordings: the stems, or folder and file where these repeat."""
    stems = [stem(name) for name in files]
    counts = Counter(stems)
    folders = [Path(name).parent.parts for name in files if counts[stem(name)] > 1]
    common = len([*takewhile(lambda parts: len({*parts}) == 1, zip(*folders, strict=False))])
    return [
        x if counts[x] == 1 else "/".join(Path(name).parts[common:])
        for x, name in zip(stems, files, strict=True)
    ]


def alike(lines: Iterable[str], files: Iterable[str]) -> list[str]:
    """Return distinct lines, one for more than three that differ by file and numbers only."""
    lines, names = list(dict.fromkeys(lines)), {*files}

    def kind(line: str) -> str:
        tokens = ("…" if word.rstrip(":,") in names else word for word in line.split(" "))
        return re.sub(r"[0-9][0-9,.]*", "…", " ".join(tokens))

    kinds = list(map(kind, lines))
    counts, first = Counter(kinds), dict(zip(kinds[::-1], lines[::-1], strict=True))
    merged = []
    for line, pattern in zip(lines, kinds, strict=True):
        if counts[pattern] <= 3:
            merged.append(line)
        elif first[pattern] is line:
            merged.append(type(line)(f"{line} (and {counts[pattern] - 1:,} lines alike)"))
    return merged


def parse_text(
    rows: bytes, width: int, separator: str, places: Sequence[str], source: str, before: int
) -> pa.Table:
    """Parse rows of text into columns of text, named by index from 0.

    Args:
        rows: the lines, without header.
        width: number of columns.
        separator: separator of columns.
        places: indices of the columns to return.
        source: the file, for messages.
        before: number of data rows before these in the file.

    Raises:
        DataError: if a row has more or fewer columns, or a quote is not closed.
    """
    odd: list[pa_csv.InvalidRow] = []

    def note(row: pa_csv.InvalidRow) -> str:
        odd.append(row)
        return "error"

    try:
        table = pa_csv.read_csv(
            pa.BufferReader(rows),
            pa_csv.ReadOptions(
                use_threads=False,
                column_names=[str(where) for where in range(width)],
                block_size=min(len(rows) + 1, 1 << 30),
            ),
            pa_csv.ParseOptions(delimiter=separator, invalid_row_handler=note),
            pa_csv.ConvertOptions(
                include_columns=list(places),
                column_types=dict.fromkeys(places, pa.string()),
                null_values=BLANK,
                strings_can_be_null=True,
            ),
        )
    except pa.ArrowException as error:
        if odd:
            raise _odd_row(odd[0], rows, width, source, before) from error
        reason = str(error).splitlines()[0]
        raise DataError(f"{source}: not a readable table: {reason}") from error
    # An unclosed quote merges lines without an error.
    count = rows.count(b"\n") + (not rows.endswith(b"\n"))
    if table.num_rows != count and table.num_rows != len(re.findall(rb"[^\r\n]+", rows)):
        where = f", from data row {before + 1} on" if before else ""
        raise DataError(f"{source}: a quote is not closed, or a line end is stray{where}")
    return table


def unended(rows: bytes, place: str) -> list[Concern]:
    """Return a warning if the last row has no line end, so its last cell may be truncated."""
    if rows.endswith(b"\n"):
        return []
    shown = rows[rows.rfind(b"\n") + 1 :].decode()[-40:]
    return [
        Concern(f"{place}, the last, ends in {shown!r} without a line end; is the file cut off?")
    ]


def _odd_row(
    row: pa_csv.InvalidRow, rows: bytes, width: int, source: str, before: int
) -> DataError:
    """Return the error for a row with another number of columns."""
    text, count = row.text.encode(), row.actual_columns
    lines = re.findall(rb"[^\r\n]+", rows)  # blank lines are no rows
    number = lines.index(text) if text in lines else 0
    where = f"data row {before + number + 1}"
    last = number == len(lines) - 1 and count < width
    where, cut = (f"{where}, the last,", "; is the file cut off?") if last else (where, "")
    if count > LONG_ROW * width:
        cut = ": is it a whole trajectory, as in pNEUMA's files? Write a row per vehicle and time"
    return DataError(f"{source}: {where} has {count} columns; expected {width}{cut}")


def is_relative(name: str) -> bool:
    """Return whether the name of a column is that of a relative speed."""
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z][a-z])|[^\w/]|_", " ", name).lower()
    return re.search(RELATIVE, spaced) is not None


def lacking(source: str, missing: Sequence[str], header: Sequence[str], option: str) -> DataError:
    """Return the error for missing columns of a table."""
    folded = {name.lower(): name for name in header}
    nearest = [get_close_matches(name.lower(), folded, n=1) for name in missing]
    hints = [f" (is it {folded[near[0]]!r}?)" if near else "" for near in nearest]
    fix = f"; name the columns by {option}={{…}}" if option else "; convert them to SI, rename them"
    if relative := next(filter(is_relative, header), None) if "speed" in missing[0] else None:
        hints[0] = f" ({relative!r} is relative: add the follower's speed)"
        if missing[0] == "leader_speed_mps":
            hints[0] = f" (set data.columns.relative_speed={relative})"
    if "gap_m" in missing and any("pos" in name.lower() for name in header):
        fix = OF_POSITIONS
    stems = Counter(name.rstrip("0123456789") for name in header if name[-1:].isdigit())
    if sum(count > 1 for count in stems.values()) > 1:  # speed1, speed2, gap1, gap2
        fix = "; does a row hold several vehicles? Expected a row per vehicle, or pair, and time"
    if sum(map(bool, header)) == 1 or header[0].startswith(("#", "%")):
        fix = ": is it a title or a comment? The first line must name the columns"
    if all(re.fullmatch(NUMBER, name) for name in header if name):
        fix = ": is the header missing? The first line must name the columns"
    lacks = ", ".join(map(add, missing, hints))
    return DataError(f"{source}: lacks the column {lacks}; it has {', '.join(header)[:400]}{fix}")
