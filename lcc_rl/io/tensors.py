"""Atomic writing and checked reading of tensors."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lcc_rl.errors import ResultsError
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.paths import check_file

# Types of stored tensors: weights, sums in double precision, counters, flags.
TENSOR_TYPES = (torch.float32, torch.float64, torch.int64, torch.bool)


def write_torch(content: Any, path: str | Path) -> None:
    """Write tensors atomically in a format that loads with ``weights_only=True``.

    Raises:
        ResultsError: if the file cannot be written.
    """
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:
            # Torch hides the file's error behind its own.
            if isinstance(error.__context__, OSError):
                raise error.__context__ from None
            raise


def read_torch(path: str | Path) -> Any:
    """Read tensors without running code in the file.

    Raises:
        ResultsError: if the file is missing, damaged, or holds other objects than tensors and
            plain containers.
    """
    path = Path(path)
    check_file(path)
    try:
        with zipfile.ZipFile(path) as archive:  # torch does not check the checksums
            damaged = archive.testzip()
            packed = any(entry.compress_type for entry in archive.infolist())
        if packed or damaged is not None:  # torch does not compress
            raise zipfile.BadZipFile(damaged)
        return torch.load(path, weights_only=True, map_location="cpu")
    except PermissionError as error:
        raise ResultsError(f"{path}: cannot be read: {error.strerror}") from error
    except Exception as error:  # torch raises many kinds for damaged or malicious files
        raise ResultsError(
            f"{path}: not a readable weights file (.pt): damaged or of another kind"
        ) from error


def checksums(path: Path) -> tuple[int, ...]:
    """Return the checksums of the tensors of a file; none if it is damaged."""
    with suppress(OSError, zipfile.BadZipFile), zipfile.ZipFile(path) as archive:
        return tuple(entry.CRC for entry in archive.infolist() if "/data/" in entry.filename)
    return ()


def check_like(found: Any, wanted: Any, name: str) -> None:
    """Check that a state may replace another one: equal entries, types and sizes, finite numbers.

    Entries that the other one does not have yet, such as those of an optimizer before its first
    step or of an empty list, may be any numbers.

    Args:
        found: nested containers of tensors.
        wanted: the other state.
        name: name of the state, for messages.

    Raises:
        ValueError: naming the first wrong entry.
    """
    if isinstance(wanted, Mapping):
        if not isinstance(found, Mapping) or set(wanted) - set(found):
            missing = sorted(
                map(str, set(wanted) - set(found if isinstance(found, Mapping) else ()))
            )
            raise ValueError(f"{name} lacks {', '.join(missing)}")
    elif isinstance(wanted, Tensor):
        kind, shape = getattr(found, "dtype", type(found)), getattr(found, "shape", None)
        if kind != wanted.dtype or (wanted.numel() and shape != wanted.shape):
            raise ValueError(f"{name} is {kind} {shape}, expected {wanted.dtype} {wanted.shape}")
    elif wanted is not None and type(found) is not type(wanted):
        raise ValueError(f"{name} is {found!r}, expected {wanted!r}")
    if isinstance(found, Mapping):
        reference = wanted if isinstance(wanted, Mapping) else {}
        for key, value in found.items():
            check_like(value, reference.get(key), f"{name}.{key}".removeprefix("."))
    elif isinstance(found, list):
        for index, value in enumerate(found):
            check_like(value, None, f"{name}[{index}]")
    elif isinstance(found, Tensor):
        if found.dtype not in TENSOR_TYPES:
            raise ValueError(f"{name} is of type {found.dtype}")
        if not bool(torch.isfinite(found).all()):
            raise ValueError(f"{name} holds values that are not finite")
    elif isinstance(found, float) and not math.isfinite(found):
        raise ValueError(f"{name} is {found}")
