"""Files that are written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lcc_rl.errors import ResultsError

# Of a run; other folders in it are runs of their own.
SUBFOLDERS = ("figures", "policies", "blocks")


def new_file(path: str | Path, option: str) -> Path:
    """Return the path of a file to write that must not be there yet.

    Raises:
        ResultsError: if it is.
    """
    path = Path(path)
    if path.exists() or path.is_symlink():
        raise ResultsError(f"{path} is already there; choose another {option}, or remove it")
    return path


@contextmanager
def atomic_path(path: str | Path, durable: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that replaces it only when the block succeeds.

    Args:
        path: the final path; its folder is made where it does not exist.
        durable: flush to disk, so that the file survives a power cut.

    Raises:
        ResultsError: if ``path`` is there and no regular file, such as a folder or a device.
        ResultsError: if it cannot be written (disk full, folder read-only …); a former
            file at ``path`` is kept and the temporary one removed.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise ResultsError(f"{path}: is no regular file; choose another place to write")
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
