"""What kill_test.py looks for after a kill: files that are damaged, lost or different."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pandas as pd
from matplotlib.image import imread

from lcc_rl.errors import ResultsError
from lcc_rl.io.files import read_parquet
from lcc_rl.io.settings import read_json
from lcc_rl.io.tensors import read_torch
from lcc_rl.results.runs import read_settings
from lcc_rl.runs.states import LOCK, RESULTS, read_progress

UNTIMED = "timing.parquet"  # seconds, which differ


def unreadable(root: Path) -> list[str]:
    """Return the files of a folder that cannot be read, with the reason."""
    wrong = []
    for path in root.rglob("*"):
        if path.name.startswith(".") or ".hydra" in path.parts:
            continue
        try:
            if path.suffix == ".parquet":
                read_parquet(path)
            elif path.suffix == ".pt":
                read_torch(path)
            elif path.suffix == ".png":
                imread(path)
            elif path.name == "config.yaml":
                read_settings(path)
            elif path.name == "progress.json" and read_progress(path.parent) is None:
                raise ResultsError(f"{path}: damaged")
            elif path.suffix == ".json":
                read_json(path)
        except (ResultsError, OSError, SyntaxError) as error:  # the last two: of a figure
            wrong.append(f"{path}: {error}")
    return wrong


def finished(root: Path) -> dict[str, str]:
    """Return the tables of finished runs, with the hash of each."""
    tables = [path for name in RESULTS for path in root.rglob(name)]
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in tables}


def compare(whole: Path, killed: Path) -> None:
    """Check that two folders hold the same files and their tables the same rows."""
    names, others = (
        {str(path.relative_to(root)) for path in content(root)} for root in (whole, killed)
    )
    assert names == others, f"files differ: {names ^ others}"
    for name in sorted(names):
        if name.endswith(".parquet") and not name.endswith(UNTIMED):
            expected, found = (read_parquet(root / name) for root in (whole, killed))
            pd.testing.assert_frame_equal(found, expected, check_exact=True, obj=name)


def content(root: Path) -> list[Path]:
    """Return the files of a folder that a command leaves, without its logs and locks."""
    files = [path for path in root.rglob("*") if path.is_file()]
    return [path for path in files if path.suffix != ".log" and path.name != LOCK]
