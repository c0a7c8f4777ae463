"""Atomic writing and checked reading of tensors."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import torch

from lcc_rl.errors import ResultsError
from lcc_rl.io.atomic import atomic_path


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
        with zipfile.ZipFile(path) as archive:  # torch does not compare the checksums
            damaged = archive.testzip()
        if damaged is not None:
            raise zipfile.BadZipFile(damaged)
        return torch.load(path, weights_only=True, map_location="cpu")
    except Exception as error:  # torch raises many kinds for damaged or malicious files
        raise ResultsError(
            f"{path}: not a readable weights file: damaged, or made by something else"
        ) from error
