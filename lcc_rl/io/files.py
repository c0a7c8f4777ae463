"""Atomic writing and checked reading of parquet tables and tensors."""

from __future__ import annotations

import os
import platform
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import torch

from lcc_rl.errors import ResultsError
from lcc_rl.io.memory import require_memory
from lcc_rl.version import __version__

SCHEMA_VERSION = "1"
# Changes of a table from one schema version to the next, by the older version.
MIGRATIONS: dict[int, Callable[[pd.DataFrame], pd.DataFrame]] = {}
SUBFOLDERS = ("figures", "policies")  # of a run; other folders in it are runs of their own
PROCESSOR = "lcc_rl.processor"  # in a table's metadata


@contextmanager
def atomic_path(path: str | Path, durable: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that replaces it only when the block succeeds.

    Args:
        path: the final path; its folder is made where it does not exist.
        durable: flush to disk, so that the file survives a power cut.

    Raises:
        ResultsError: if the file cannot be written (disk full, folder read-only …); a former
            file at ``path`` is kept and the temporary one removed.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        if durable:
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
        os.replace(temporary, path)
        if durable:
            _sync_folder(path.parent)
    except OSError as error:
        raise ResultsError(f"{path}: cannot be written: {error}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Flush a rename in a folder to disk, where the system supports it."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files of killed writers from a run's folder and its own subfolders.

    Call it only while no writer is active.
    """
    for place in (folder, *(folder / name for name in SUBFOLDERS)):
        for path in place.glob(".*.tmp"):
            with suppress(OSError):
                path.unlink()


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
        "lcc_rl.torch": torch.__version__,
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


def write_torch(content: Any, path: str | Path) -> None:
    """Write tensors atomically, in a form that loads with ``weights_only=True``.

    Raises:
        ResultsError: if the file cannot be written.
    """
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:
            # Torch hides what went wrong with the file behind a fault of its own.
            if isinstance(error.__context__, OSError):
                raise error.__context__ from None
            raise


def read_torch(path: str | Path) -> Any:
    """Read tensors without running code in the file.

    Raises:
        ResultsError: if the file is missing, damaged or holds anything but tensors and plain
            containers.
    """
    path = Path(path)
    if not path.is_file():
        raise ResultsError(f"{path}: {'not a file' if path.exists() else 'no such file'}")
    try:
        _check_sums(path)
        content = torch.load(path, weights_only=True, map_location="cpu")
        _check_sizes(content, path)
    except ResultsError:
        raise
    except Exception as error:  # torch raises many kinds for damaged or malicious files
        raise ResultsError(
            f"{path}: not a readable weights file: damaged, or made by something else"
        ) from error
    return content


def _check_sums(path: Path) -> None:
    """Check every part of a weights file against its checksum, which torch does not.

    Torch stores parts as they are. Compressed or overlapping ones could claim any size, and so
    could the format of former releases of torch, which is no archive.
    """
    with zipfile.ZipFile(path) as archive:
        parts = archive.infolist()
        packed = any(part.compress_type != zipfile.ZIP_STORED for part in parts)
        if packed or sum(part.file_size for part in parts) > path.stat().st_size:
            raise ResultsError(f"{path}: not a readable weights file: claims to be larger than it")
        damaged = archive.testzip()
    if damaged is not None:
        raise ResultsError(f"{path}: not a readable weights file: damaged at {Path(damaged).name}")


def _check_sizes(content: Any, path: Path) -> None:
    """Check that no tensor claims more than the file holds, and that all else is plain."""
    limit, seen, left = path.stat().st_size, set(), [content]
    while left:
        value = left.pop()
        if isinstance(value, torch.Tensor):
            size = value.numel() * value.element_size()
            if value.device.type != "cpu" or value.layout is not torch.strided:
                raise ResultsError(f"{path}: a tensor is not dense")
            if max(size, value.untyped_storage().nbytes()) > limit:
                raise ResultsError(f"{path}: a tensor claims {size} bytes, the file has {limit}")
        elif isinstance(value, (dict, list, tuple)):
            if id(value) not in seen:  # some are named many times over
                seen.add(id(value))
                left += [*value.keys(), *value.values()] if isinstance(value, dict) else value
        elif not isinstance(value, (str, int, float, bool, type(None), torch.device, torch.dtype)):
            raise ResultsError(f"{path}: holds {type(value).__name__}; expected plain values")
