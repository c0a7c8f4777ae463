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
