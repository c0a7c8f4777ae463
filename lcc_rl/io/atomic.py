"""Files that are written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lcc_rl.errors import ResultsError

# Of a run; other folders in it are runs of their own.
SUBFOLDERS = ("figures", "policies", "blocks")


def new_file(path: str | Path, option: str, own: Callable[[Path], bool] | None = None) -> Path:
    """Return the path of a file to write: the one door of commands that are given its name.

    Args:
        path: what was given.
        option: the option that gave it, for the message.
        own: whether a regular file that is there is this command's, to be replaced.

    Raises:
        ResultsError: if something else is there.
    """
    path = _spelled(path)
    if os.path.lexists(path) and not (
        own and not path.is_symlink() and path.is_file() and own(path)
    ):
        raise ResultsError(f"{path} is already there; choose another {option}, or remove it")
    return path


def own_folder(path: str | Path, option: str, own: Callable[[set[str]], bool]) -> Path:
    """Return the path of a folder to write into, the one door as above.

    Args:
        path: what was given.
        option: the option that gave it, for the message.
        own: whether the names in it, none of them hidden, are those of this command.

    Raises:
        ResultsError: if it holds something else, or is no folder.
    """
    path = _spelled(path)
    if os.path.lexists(path):
        if not path.is_dir():
            raise ResultsError(f"{path} is no folder; choose another {option}")
        names = {item.name for item in path.iterdir() if not item.name.startswith(".")}
        if names and not own(names):
            raise ResultsError(
                f"{path} already holds {min(names)}, which is not this command's; choose another "
                f"{option}"
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
