"""Reader of small, possibly foreign text files: YAML and JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from lcc_rl.errors import ResultsError, raised_as
from lcc_rl.io.paths import check_file

LARGEST_FILE = 2**20  # bytes; a configuration has thousands
DAMAGED = (ValueError, TypeError, RecursionError)  # errors of parsers of damaged texts
NESTED = 2000  # most characters that open a nested level, for the C loader
# The C loader is five times faster than Python's.
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def read_text(path: Path) -> str:
    """Read a small text file.

    Raises:
        ResultsError: if it is missing, no regular file (reading a pipe would block), too large or
            not text.
    """
    with raised_as(ResultsError, f"{path}: cannot be read", OSError, ValueError):
        check_file(path)
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE + 1)
        text = content.decode()
    if len(content) > LARGEST_FILE:
        raise ResultsError(f"{path}: larger than {LARGEST_FILE} bytes, the limit of such files")
    return text


def parse_yaml(text: str, where: str) -> dict[str, Any]:
    """Parse stored settings as plain containers.

    Raises:
        ResultsError: naming the error and the origin.
    """
    # The C loader would crash at deep nesting, which settings never have.
    loader = LOADER if sum(map(text.count, "[{-")) < NESTED else yaml.SafeLoader
    with raised_as(ResultsError, f"{where}: damaged", yaml.YAMLError, *DAMAGED):
        content = yaml.load(text, Loader=loader)  # safe: plain values only
    if not isinstance(content, dict):
        raise ResultsError(f"{where}: damaged: expected settings, got {type(content).__name__}")
    return content


def read_json(path: Path) -> Any:
    """Read a small JSON file.

    Raises:
        ResultsError: if it is missing or damaged.
    """
    with raised_as(ResultsError, f"{path}: damaged", *DAMAGED):
        return json.loads(read_text(path))
