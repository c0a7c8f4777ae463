"""Atomic writing of files."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lcc_rl.errors import ResultsError

# Folders of a run; other folders in it are separate runs.
SUBFOLDERS = ("figures", "policies", "blocks")


def new_file(path: str | Path, option: str, own: Callable[[Path], bool] | None = None) -> Path:
    """Return the checked path of a file that a command is to write.

    Args:
        path: the given path.
        option: its option, for the message.
        own: whether an existing regular file belongs to this command and is replaced.

    Raises:
        ResultsError: if another file exists.
    """
    path = _spelled(path)
    if os.path.lexists(path) and not (
        own and not path.is_symlink() and path.is_file() and own(path)
    ):
        raise ResultsError(f"{path} exists already; choose another {option}, or remove it")
    return path


def own_folder(path: str | Path, own: Callable[[set[str]], bool]) -> Path:
    """Return the checked path of a folder that a command is to write into.

    Args:
        path: the given path, of the option ``--out``.
        own: whether the names in it, without hidden ones, belong to this command.

    Raises:
        ResultsError: if it contains other files, or is no folder.
    """
    path = _spelled(path)
    if os.path.lexists(path):
        if not path.is_dir():
            raise ResultsError(f"{path} is no folder; choose another --out")
        names = {item.name for item in path.iterdir() if not item.name.startswith(".")}
        if names and not own(names):
            raise ResultsError(
                f"{path} already holds {min(names)}, which is not this command's; choose another "
                "--out"
            )
    return path


def _spelled(path: str | Path) -> Path:
    if "\0" in str(path):
        raise ResultsError(f"{str(path)!r} cannot be the name of a file or folder")
    return Path(path)


@contextmanager
def atomic_path(path: str | Path, durable: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that replaces it only when the block succeeds.

    Args:
        path: the final path; its folder is created if necessary.
        durable: flush to disk, so that the file survives a power failure.

    Raises:
        ResultsError: if ``path`` exists and is no regular file, or cannot be written (disk full,
            folder read-only …); an existing file is kept and the temporary one removed.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise ResultsError(f"{path}: is no regular file; choose another path")
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
    """Flush a rename in a folder to disk, if the system supports it."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files of killed writers from a run's folder and its own subfolders.

    It must not be called while a writer is active.
    """
    for place in (folder, *(folder / name for name in SUBFOLDERS)):
        for path in place.glob(".*.tmp"):
            with suppress(OSError):
                path.unlink()
