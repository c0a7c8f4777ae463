"""Atomic writing and checked reading of parquet tables."""

from __future__ import annotations

import platform
from collections.abc import Callable, Mapping
from functools import cache, partial
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from lcc_rl.errors import ResultsError
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.memory import require_memory
from lcc_rl.version import __version__

SCHEMA_VERSION = "1"
# Changes of a table from one schema version to the next, by the older version.
MIGRATIONS: dict[int, Callable[[pd.DataFrame], pd.DataFrame]] = {}
PROCESSOR = "lcc_rl.processor"  # in a table's metadata


def write_parquet(
    frame: pd.DataFrame, path: str | Path, metadata: Mapping[str, str] | None = None
) -> None:
    """Write a table atomically, with schema, package, torch and processor in its metadata.

    The processor is recorded because trainings differ between processors as between seeds.

    Args:
        frame: the table; its index is not kept.
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
    table = pa.Table.from_pandas(frame, preserve_index=False)
    for name, column in zip(table.column_names, table.columns, strict=True):
        if pa.types.is_floating(column.type) and pc.any(pc.is_inf(column)).as_py():
            row = pc.index(pc.is_inf(column), True).as_py()
            raise ResultsError(f"{path}: row {row}, column {name!r} is infinite; expected a number")
    table = table.replace_schema_metadata(
        {**(table.schema.metadata or {}), **own, **(metadata or {})}
    )
    with atomic_path(path) as temporary:
        pq.write_table(table, temporary, compression="zstd", write_page_checksum=True)


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
    table = _read(path, partial(pq.read_table, page_checksum_verification=True))
    # Tables of other origin have no schema version and are read unchanged.
    version = (table.schema.metadata or {}).get(b"lcc_rl.schema", SCHEMA_VERSION.encode()).decode()
    if version not in map(str, range(1, int(SCHEMA_VERSION) + 1)):
        found = f"schema version {version[:20]!r}"
        raise ResultsError(f"{path}: {found}; this package reads 1 to {SCHEMA_VERSION}")
    return migrated(table.to_pandas(), int(version))


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


def migrated(frame: pd.DataFrame, version: int) -> pd.DataFrame:
    """Convert a table of an older schema to the present one, version by version."""
    for old in range(version, int(SCHEMA_VERSION)):
        frame = MIGRATIONS[old](frame)
    return frame


def parquet_metadata(path: str | Path) -> dict[str, str]:
    """Return the text metadata of a parquet file, without pandas' own entry.

    Raises:
        ResultsError: if the file is missing or damaged.
    """
    raw = _read(path, pq.read_schema).metadata or {}
    return {key.decode(): value.decode() for key, value in raw.items() if key != b"pandas"}
