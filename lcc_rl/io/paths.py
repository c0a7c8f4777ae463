"""Files that a path names: a file, a folder or a pattern."""

from __future__ import annotations

from glob import escape, glob
from pathlib import Path

from lcc_rl.errors import ResultsError


def check_file(path: Path) -> None:
    """Check that a path is a file; to read a pipe would block.

    Raises:
        ResultsError: if it is not.
    """
    if not path.is_file():
        raise ResultsError(f"{path}: {'not a file' if path.exists() else 'no such file'}")


def matching(name: str, deep: bool = True) -> list[str]:
    """Return the files of a path, sorted; none if there is no such file.

    A folder stands for its files; with ``deep``, one without files for those of its folders. Files
    without ending that begin with ``_``, such as Spark's ``_SUCCESS``, are passed over.
    """
    path, patterns = Path(name), [name]
    if path.is_dir():
        inside = Path(escape(name))
        patterns = [str(inside / "*"), *[str(inside / "**" / "*")] * deep]
    elif path.exists():
        return [name]
    for pattern in patterns:
        found = map(Path, sorted(glob(pattern, recursive=True)))
        if files := [str(x) for x in found if x.is_file() and (x.suffix or x.name[0] != "_")]:
            return files
    return []
