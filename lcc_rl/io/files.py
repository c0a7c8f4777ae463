"""Atomic writing and checked reading of parquet tables."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq
from pyarrow import fs

from lcc_rl.errors import ResultsError
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.memory import require_memory
from lcc_rl.version import __version__

SCHEMA_VERSION = "1"
PROCESSOR = "lcc_rl.processor"  # in a table's metadata
# The rows of a table, read; or, of many rows, files that are read when asked.
Rows: TypeAlias = pd.DataFrame | ds.Dataset
FEW = 200_000  # rows that are read at once without a thought
TEXT = pa.dictionary(pa.int32(), pa.string())


def write_parquet(
    frame: pd.DataFrame | Iterable[pd.DataFrame],
    path: str | Path,
    metadata: Mapping[str, str] | None = None,
) -> None:
    """Write a table atomically, with schema, package, torch and processor in its metadata.

    The processor is recorded because trainings differ between processors as between seeds.

    Args:
        frame: the table; its index is not kept. Or its parts, at least one, all of the same
            columns: each becomes a row group, and one at a time is held in memory.
        path: destination.
        metadata: further entries, such as a config hash.

    Raises:
        ResultsError: if the file cannot be written, or a number is infinite; it names column and
            row. NaN is a missing value and is written as null.
    """
    own = {
        "lcc_rl.schema": SCHEMA_VERSION,
        "lcc_rl.version": __version__,
        "lcc_rl.torch": installed("torch"),
        PROCESSOR: processor(),
    }
    parts = iter([frame] if isinstance(frame, pd.DataFrame) else frame)
    table = _finite(next(parts), path)
    schema = table.schema.with_metadata(
        {**(table.schema.metadata or {}), **own, **(metadata or {})}
    )
    with (
        atomic_path(path) as temporary,
        pq.ParquetWriter(temporary, schema, compression="zstd", write_page_checksum=True) as file,
    ):
        file.write_table(table.cast(schema))
        for part in parts:
            file.write_table(_finite(part, path).cast(schema))


def _finite(frame: pd.DataFrame, path: str | Path) -> pa.Table:
    """Return a data frame as a table whose numbers are finite."""
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
        _, found, after = Path("/proc/cpuinfo").read_text().partition("model name")
    except OSError:
        found = ""
    return after.splitlines()[0].lstrip("\t :") if found else platform.processor() or "unknown"


def read_parquet(path: str | Path) -> pd.DataFrame:
    """Read a table.

    Raises:
        ResultsError: if the file is missing, damaged or of a newer schema.
        ConfigError: if it does not fit into memory.
    """
    # As a table, as a data frame, and once more while it is checked.
    require_memory({f"reading {path}": 3 * _read(path, _unpacked_size)})
    _schema(Path(path))
    table = _read(path, partial(pq.read_table, page_checksum_verification=True))
    frame: pd.DataFrame = table.to_pandas()
    return frame


def as_rows(path: Path) -> Rows:
    """Return a table: read where it has :data:`FEW` rows at most, else as a dataset.

    Raises:
        ResultsError: if it is missing, damaged or of a newer schema.
    """
    many = _read(path, pq.read_metadata).num_rows > FEW
    return as_dataset([path]) if many else read_parquet(path)


def as_dataset(
    paths: Sequence[Path], columns: Sequence[Mapping[str, Any]] | None = None
) -> ds.Dataset:
    """Return tables as one dataset of pyarrow, whose rows are read when asked.

    Text is dictionary-encoded. A column that a table lacks is null there.

    Args:
        paths: the tables.
        columns: further columns, constant within each table.

    Raises:
        ResultsError: if a table is missing, damaged, of a newer schema, or has another type of
            column than the rest.
    """
    schemas = [_schema(path) for path in paths]
    try:
        schema = pa.unify_schemas(schemas, promote_options="permissive")
    except pa.ArrowException as error:
        raise ResultsError(f"{paths[0].parent}: tables differ: {error}") from error
    texts = [field.name for field in schema if _is_text(field.type)]
    for name in texts:
        schema = schema.set(schema.get_field_index(name), pa.field(name, TEXT))
    extra = [dict(each) for each in columns or [{}] * len(paths)]
    own = pa.Table.from_pylist(extra).schema
    own = pa.schema([(x.name, TEXT if _is_text(x.type) else x.type) for x in own])
    fields = [*schema, *(field for field in own if field.name not in schema.names)]
    return ds.FileSystemDataset.from_paths(
        [str(path) for path in paths],
        schema=pa.schema(fields),
        format=ds.ParquetFileFormat(
            ds.ParquetReadOptions(dictionary_columns=texts),
            ds.ParquetFragmentScanOptions(page_checksum_verification=True),
        ),
        filesystem=fs.LocalFileSystem(),
        partitions=[_constants(each) for each in extra],
    )


def _schema(path: Path) -> pa.Schema:
    """Return the columns of a table of the present schema version, or of other origin."""
    found: pa.Schema = _read(path, pq.read_schema)
    version = (found.metadata or {}).get(b"lcc_rl.schema", SCHEMA_VERSION.encode()).decode()
    if version != SCHEMA_VERSION:
        raise ResultsError(f"{path}: schema version {version[:20]!r}; expected {SCHEMA_VERSION}")
    return found.remove_metadata()


def _is_text(kind: pa.DataType) -> bool:
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def _constants(columns: Mapping[str, Any]) -> ds.Expression:
    """Return constant columns as the expression that a dataset's file has them by."""
    found = ds.scalar(True)
    for name, value in columns.items():
        same = ds.field(name).is_null() if value is None else ds.field(name) == value
        found = found & same
    return found


def _unpacked_size(path: Path) -> int:
    found = pq.read_metadata(path)
    return sum(found.row_group(place).total_byte_size for place in range(found.num_row_groups))


def _read(path: str | Path, reader: Callable[[Path], Any]) -> Any:
    """Read a parquet file, or raise a ResultsError of one line."""
    path = Path(path)
    if not path.is_file():
        raise ResultsError(f"{path}: no such file")
    try:
        return reader(path)
    except (pa.ArrowException, OSError) as error:
        raise ResultsError(f"{path}: not a readable parquet file: {error}") from error


def parquet_metadata(path: str | Path) -> dict[str, str]:
    """Return the text metadata of a parquet file, without pandas' own entry.

    Raises:
        ResultsError: if the file is missing or damaged.
    """
    raw = _read(path, pq.read_schema).metadata or {}
    return {key.decode(): value.decode() for key, value in raw.items() if key != b"pandas"}
