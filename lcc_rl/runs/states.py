"""State of a run (finished, running, stopped, failed) from its folder.

A run locks its folder, writes ``error.txt`` if it fails, and writes its main table last.
"""

from __future__ import annotations

import math
import os
import shutil
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from filelock import FileLock, Timeout

from lcc_rl.errors import ConfigError, Interrupted, LccError, ResultsError, input_error, line_of
from lcc_rl.io.atomic import SUBFOLDERS, atomic_path, remove_leftovers
from lcc_rl.io.settings import read_json, read_text
from lcc_rl.runs.interrupts import was_interrupted

LOCK, ERROR, PROGRESS, HYDRA_FOLDER = ".lock", "error.txt", "progress.json", ".hydra"
UNDRAWN = "undrawn"  # marks an evaluation whose figures are not drawn yet
# The last table of a run: of a training or evaluation, of a calibration.
RESULT_TABLES = ("episodes.parquet", "drivers.parquet")
PARQUET = b"PAR1"  # last bytes of a parquet file
CONFIG, CHECKPOINT = "config.yaml", "checkpoint.pt"
MARKS = {CONFIG, ERROR, LOCK, *RESULT_TABLES}
MOST_NAMED = 3  # most runs or tables in a message
STATES = ("finished", "running", "stopped", "failed")


def fresh_folder(kind: str, name: str) -> Path:
    """Return a new folder below ``outputs``, named by the time."""
    return Path("outputs", kind, f"{datetime.now():%Y-%m-%d_%H-%M-%S-%f}_{name}")


class Busy(LccError):
    """Another process works on this run."""


def busy(folder: Path) -> Busy:
    """Return the error for a folder that another process uses."""
    return Busy(f"{folder}: another process is working on this run")


@dataclass(frozen=True)
class RunState:
    """State of a run.

    Args:
        name: folder of the run, relative to the surveyed folder.
        state: one of ``STATES``.
        done: iterations done.
        total: total iterations; 0 if unknown.
        eta_s: estimated remaining time of a running run [s].
        error: first line of the error of a failed run, or of a finished one that was refused when
            it was to be repeated.
    """

    name: str
    state: str
    done: int = 0
    total: int = 0
    eta_s: float | None = None
    error: str = ""

    def __str__(self) -> str:
        return f"{self.state}: {self.error}".removesuffix(": ")


_locks: dict[Path, int | None] = {}  # locks of the folders that this process claims


def _inode(folder: Path) -> int | None:
    with suppress(OSError):
        return (folder / LOCK).stat().st_ino
    return None


@contextmanager
def claim(folder: Path) -> Iterator[None]:
    """Lock a run's folder and remove temporary files of killed processes.

    The lock is released at any end of the process.
    """
    made: list[Path] = []
    lock = FileLock(folder / LOCK)
    try:
        str(folder.resolve()).encode()  # pyarrow supports names in UTF-8 only
        made = [path for path in (folder, *folder.parents) if not path.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0.3)  # queries of the state hold the lock briefly
    except Timeout:
        raise busy(folder) from None
    except (OSError, NotImplementedError, ValueError) as error:  # ValueError: invalid name
        raise ResultsError(f"{folder}: cannot be written: {error}") from error
    _locks[folder.absolute()] = _inode(folder)
    try:
        remove_leftovers(folder)
        yield
    finally:
        with suppress(OSError):
            if _inode(folder) == _locks.pop(folder.absolute(), None):
                (folder / LOCK).unlink()
        lock.release()
        with suppress(OSError):  # not empty
            for path in made:
                path.rmdir()


def is_claimed(folder: Path) -> bool:
    """Whether a process on this machine holds a run's folder."""
    try:
        if (folder / LOCK).exists():
            with FileLock(folder / LOCK, timeout=0):
                return False
    except Timeout:
        return True
    except (OSError, NotImplementedError):  # file system without locks, or name too long
        return False
    return False


@contextmanager
def working(folder: Path) -> Iterator[None]:
    """Claim a folder and record an error raised inside."""
    with claim(folder):
        forget(folder)
        try:
            yield
        except (Interrupted, Busy):
            raise
        except Exception as error:
            # A finished run remains finished if it could not be repeated.
            if not any((folder / table).exists() for table in RESULT_TABLES):
                record(folder, error)
            raise


def check_present(folder: Path) -> None:
    """Check that the folder was not removed; writing would create it again, or harm a new run."""
    if not folder.is_dir():
        raise ResultsError(f"{folder}: cannot be written: the folder was removed during the run")
    if (lock := _inode(folder)) and lock != _locks.get(folder.absolute(), lock):
        raise busy(folder)


def forget(folder: Path) -> None:
    """Remove the record of an earlier failure."""
    with suppress(OSError):
        (folder / ERROR).unlink(missing_ok=True)


def withdraw(folders: Sequence[Path]) -> None:
    """Remove the folder of a run that did not begin, and its parents, if they are empty."""
    if _holds_only(folders[0], {HYDRA_FOLDER, ERROR, LOCK}):
        shutil.rmtree(folders[0])
        with suppress(OSError):  # not empty
            for folder in folders[1:]:
                folder.rmdir()


def clean(root: Path) -> list[Path]:
    """Remove the folders of failed runs without rows and states; return them."""
    failed = [root / run.name for run in survey(root) if run.state == "failed"]
    names = {HYDRA_FOLDER, ERROR, LOCK, CONFIG, PROGRESS, UNDRAWN}
    empty = [run for run in failed if _holds_only(run, names)]
    for folder in empty:
        shutil.rmtree(folder)
    return empty


def _holds_only(folder: Path, names: set[str]) -> bool:
    """Whether a folder holds only files of these names and logs."""
    with suppress(OSError):
        return {path.name for path in folder.iterdir() if path.suffix != ".log"} <= names
    return False


def record(folder: Path, error: BaseException) -> None:
    """Write ``error.txt``: the error in one line, with a traceback unless it is an input error.

    An error caused by an interrupt is no failure and leaves no file; nor does any in a folder that
    was removed, which a file would make anew.
    """
    if was_interrupted(error) or not folder.is_dir():
        return
    text = described_error(error) + "\n"
    if not isinstance(input_error(error) or error, (LccError, OSError)):
        text += "\n" + "".join(traceback.format_exception(error))
    with suppress(ResultsError), atomic_path(folder / ERROR) as temporary:
        temporary.write_text(text, encoding="utf-8")


def described_error(error: BaseException) -> str:
    """Return an error in one line, with its type unless it is an input error."""
    return line_of(input_error(error) or error, True)


def _is_whole(table: Path) -> bool:
    """Whether a parquet file ends with its mark; its rows are not read."""
    with open(table, "rb") as file:
        file.seek(-min(len(PARQUET), table.stat().st_size), os.SEEK_END)
        return file.read() == PARQUET


def inspect_run(folder: Path, name: str | None = None) -> RunState:
    """Return the state of the run in a folder; failed if the folder cannot be read."""
    name = folder.name if name is None else name
    try:
        return _inspected(folder, name)
    except OSError as error:
        return RunState(name, "failed", error=f"cannot be read: {error.strerror}")


def _inspected(folder: Path, name: str) -> RunState:
    progress = read_progress(folder) or {}
    done, total = int(progress.get("done", 0)), int(progress.get("total", 0))
    if is_claimed(folder):
        return RunState(name, "running", done, total, float(progress.get("eta_s", 0.0)))
    state, why = "stopped", ""
    with suppress(ResultsError):
        lines = read_text(folder / ERROR).splitlines()
        state, why = "failed", "".join(lines[:1])
    for table in filter(Path.exists, (folder / table for table in RESULT_TABLES)):
        if not _is_whole(table):
            return RunState(name, "failed", done, total, error=f"{table.name} is cut or damaged")
        state, why = "finished", f"not repeated: {why}" * bool(why)
    return RunState(name, state, done, total, error=why)


def read_progress(folder: Path) -> dict[str, float] | None:
    """Return the content of a run's ``progress.json``; None if there is none."""
    try:
        content = dict(read_json(folder / PROGRESS))
        numbers = {
            key: value
            for key, value in content.items()
            if isinstance(value, (int, float)) and math.isfinite(value)
        }
    except (ResultsError, ValueError, TypeError, OverflowError):
        return None
    return numbers if {"done", "total", "eta_s"} <= numbers.keys() else None


def run_folders(root: Path) -> list[Path]:
    """Return the run folders at or below a folder, sorted, without those that contain runs."""
    if not root.is_dir():
        raise ResultsError(f"{root}: no such folder")
    found = []
    # A folder that cannot be listed may be a run; its state contains the error.
    for place, folders, files in os.walk(root, onerror=lambda e: found.append(Path(e.filename))):
        is_run = bool(MARKS.intersection(files)) or HYDRA_FOLDER in folders
        own = SUBFOLDERS if is_run else ()
        folders[:] = sorted(x for x in folders if not x.startswith(".") and x not in own)
        if is_run:
            found.append(Path(place))
    parents = {parent for folder in found for parent in folder.parents}
    return sorted(folder for folder in found if folder not in parents)


def no_run(folder: Path) -> ConfigError:
    """Return the error for a folder that is no run, naming the runs and tables in it."""
    runs = (
        [run for run in run_folders(folder) if (run / CONFIG).is_file()] if folder.is_dir() else []
    )
    tables = sorted(folder.glob("tables/*.parquet"))
    text = f"{folder}: not a run folder: it has no {CONFIG}"
    for what, found in (("run", runs), ("table", tables)):
        if found:
            names = ", ".join(str(path.relative_to(folder)) for path in found[:MOST_NAMED])
            more = f" … ({len(found)})" if len(found) > MOST_NAMED else ""
            text += f"; it holds the {what}{'s' * (len(found) > 1)} {names}{more}"
    if runs:
        text += f"; lcc_rl.results.load({str(folder)!r}) reads all runs"
    return ConfigError(text)


def survey(root: Path, folders: Sequence[Path] | None = None) -> list[RunState]:
    """Return the state of every run at or below a folder; ``folders``: those of its runs."""
    return [
        inspect_run(folder, str(folder.relative_to(root)) if folder != root else root.name)
        for folder in (run_folders(root) if folders is None else folders)
    ]
