"""Atomic writing and checked reading of parquet tables."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq
from pyarrow import fs

from lcc_rl.errors import ResultsError, raised_as
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.paths import check_file
from lcc_rl.version import code_version

SCHEMA_VERSION = "1"
# Keys in a table's metadata; the last one is of the hash of its configuration.
VERSION, PROCESSOR, IDENTITY = "lcc_rl.version", "lcc_rl.processor", "lcc_rl.config"
# The rows of a table, or, for many rows, a dataset that is read on demand.
Rows: TypeAlias = pd.DataFrame | ds.Dataset
NO_FRAME = "damaged, no data frame"
FEW = 200_000  # most rows that are read at once
TEXT = pa.dictionary(pa.int32(), pa.string())


def write_parquet(
    frame: pd.DataFrame | Iterable[pd.DataFrame],
    path: str | Path,
    metadata: Mapping[str, str] | None = None,
) -> None:
    """Write a table atomically, with schema, package, torch and processor in its metadata.

    The processor is recorded because trainings differ between processors as between seeds.

    Args:
        frame: the table, without its index; or at least one part with equal columns, each of
            which becomes a row group, so that one part at a time is in memory.
        path: destination.
        metadata: further entries, such as a config hash.

    Raises:
        ResultsError: if the file cannot be written, or naming column and row of an infinite
            number. NaN is written as null.
    """
    entries = {
        "lcc_rl.schema": SCHEMA_VERSION,
        VERSION: code_version(),
        "lcc_rl.torch": installed("torch"),
        PROCESSOR: processor(),
    }
    blocks = iter([frame] if isinstance(frame, pd.DataFrame) else frame)
    table = _finite(next(blocks), path)
    schema = table.schema.with_metadata(
        {**(table.schema.metadata or {}), **entries, **(metadata or {})}
    )
    with (
        atomic_path(path) as temporary,
        pq.ParquetWriter(temporary, schema, compression="zstd", write_page_checksum=True) as file,
    ):
        file.write_table(table.cast(schema))
        for block in blocks:
            file.write_table(_finite(block, path).cast(schema))


def write_table(frame: pd.DataFrame, path: Path) -> None:
    """Write a table for other programs atomically: ``.csv``, or as :func:`write_parquet` does."""
    if path.suffix == ".parquet":
        write_parquet(frame, path)
    else:
        with atomic_path(path) as temporary:
            frame.to_csv(temporary, index=False)


def _finite(frame: pd.DataFrame, path: str | Path) -> pa.Table:
    """Return a data frame as a table after a check for infinite numbers."""
    table = pa.Table.from_pandas(frame, preserve_index=False)
    for name, column in zip(table.column_names, table.columns, strict=True):
        if pa.types.is_floating(column.type) and pc.any(pc.is_inf(column)).as_py():
            row = pc.index(pc.is_inf(column), True).as_py()
            raise ResultsError(f"{path}: row {row}, column {name!r} is infinite; expected a number")
    return table


@cache
def processor() -> str:
    """Return the name of this machine's processor."""
    try:
        _, key, after = Path("/proc/cpuinfo").read_text(encoding="utf-8").partition("model name")
    except OSError:
        key = ""
    return after.splitlines()[0].lstrip("\t :") if key else platform.processor() or "unknown"


def read_parquet(path: str | Path) -> pd.DataFrame:
    """Read a table.

    Raises:
        ResultsError: if the file is missing, damaged or of a newer schema.
    """
    schema_of(path)
    table = read_table(path)
    with raised_as(ResultsError, f"{path}: {NO_FRAME}", Exception):  # of pandas' own metadata
        frame: pd.DataFrame = table.to_pandas()
    return frame


def read_table(path: str | Path, encoded: Sequence[str] = ()) -> pa.Table:
    """Read a table with dictionary encoding of some columns of text.

    Raises:
        ResultsError: if it is missing or damaged.
    """

    def read(place: Path) -> pa.Table:  # pq.read_table takes a third longer for small files
        options = {"page_checksum_verification": True, "read_dictionary": list(encoded)}
        with pq.ParquetFile(place, **options) as file:
            return file.read()

    return _read(path, read)


def as_rows(path: Path) -> Rows:
    """Return a table with at most :data:`FEW` rows, else a dataset.

    Raises:
        ResultsError: if it is missing, damaged or of a newer schema.
    """
    many = _read(path, pq.read_metadata).num_rows > FEW
    return as_dataset({path: {}}, schema_of(path)) if many else read_parquet(path)


def as_dataset(tables: Mapping[Path, Mapping[str, Any]], schema: pa.Schema) -> ds.Dataset:
    """Return tables as one dataset of pyarrow, which is read on demand.

    Args:
        tables: constant columns of each file; all files have the same ones.
        schema: columns of the files, see :func:`schema_of`; missing ones are null.
    """
    constant = pa.Table.from_pylist([dict(columns) for columns in tables.values()]).schema
    for field in _texts_encoded(constant):
        schema = schema.append(field)
    return ds.FileSystemDataset.from_paths(
        [str(path) for path in tables],
        schema=schema,
        format=ds.ParquetFileFormat(
            ds.ParquetReadOptions(dictionary_columns=texts_of(schema)),
            ds.ParquetFragmentScanOptions(page_checksum_verification=True),
        ),
        filesystem=fs.LocalFileSystem(),
        partitions=[_constants(columns) for columns in tables.values()],
    )


def schema_of(path: str | Path, needed: Iterable[str] = ()) -> pa.Schema:
    """Return the columns of a table of the present schema version or of other origin.

    Text is dictionary-encoded.

    Raises:
        ResultsError: if it is missing, damaged, of another schema version, no data frame, or lacks
            a needed column.
    """
    schema: pa.Schema = _read(path, pq.read_schema)
    version = _decoded((schema.metadata or {}).get(b"lcc_rl.schema", SCHEMA_VERSION.encode()))
    if version != SCHEMA_VERSION:
        raise ResultsError(f"{path}: schema version {version[:20]!r}; expected {SCHEMA_VERSION}")
    with raised_as(ResultsError, f"{path}: {NO_FRAME}", ValueError):
        _ = schema.pandas_metadata
    for name in needed:
        if name not in schema.names:
            raise ResultsError(f"{path}: not written by a run: it has no column {name}")
    return _texts_encoded(schema.remove_metadata())


def unified(schema: pa.Schema, other: pa.Schema, path: Path) -> pa.Schema:
    """Return the columns of two schemas.

    Raises:
        ResultsError: if the type of a column differs; ``path`` is the file of ``other``.
    """
    with raised_as(ResultsError, str(path), pa.ArrowException):
        return pa.unify_schemas([schema, other], promote_options="permissive")


def texts_of(schema: pa.Schema) -> list[str]:
    """Return the names of the columns of text."""
    return [field.name for field in schema if field.type == TEXT]


def _texts_encoded(schema: pa.Schema) -> pa.Schema:
    texts = (pa.string(), pa.large_string())
    return pa.schema([(x.name, TEXT if x.type in texts else x.type) for x in schema])


def _constants(columns: Mapping[str, Any]) -> ds.Expression:
    """Return constant columns as the partition expression of a file."""
    partition = ds.scalar(True)
    for name, value in columns.items():
        equal = ds.field(name).is_null() if value is None else ds.field(name) == value
        partition = partition & equal
    return partition


def _read(path: str | Path, reader: Callable[[Path], Any]) -> Any:
    """Read a parquet file, or raise a ResultsError of one line."""
    path = Path(path)
    faults = pa.ArrowException, OSError, UnicodeDecodeError  # the last of damaged names
    with raised_as(ResultsError, f"{path}: not readable as parquet", *faults):
        check_file(path)
        return reader(path)


def _decoded(text: bytes) -> str:
    return text.decode(errors="replace")


def parquet_metadata(path: str | Path) -> dict[str, str]:
    """Return the text metadata of a parquet file, without pandas' own entry.

    Raises:
        ResultsError: if the file is missing or damaged.
    """
    raw = _read(path, pq.read_schema).metadata or {}
    return {_decoded(key): _decoded(value) for key, value in raw.items() if key != b"pandas"}
