"""Bounded reading of small text files that may come from somebody else: YAML and JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from lcc_rl.errors import ResultsError

LARGEST_FILE = 2**20  # bytes; a configuration has some thousands
DEEPEST, LONGEST_VALUE = 50, 10_000  # of nesting; characters
# The C loader is five times as fast as Python's.
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def read_text(path: Path) -> str:
    """Read a small text file.

    Raises:
        ResultsError: if it is missing, no regular file (a pipe would be waited for), too large or
            not text.
    """
    if not path.is_file():
        raise ResultsError(f"{path}: {'not a file' if path.exists() else 'no such file'}")
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE + 1)
        text = content.decode()
    except (OSError, ValueError) as error:
        raise ResultsError(f"{path}: cannot be read: {error}") from error
    if len(content) > LARGEST_FILE:
        raise ResultsError(f"{path}: larger than {LARGEST_FILE} bytes, which no such file is")
    return text


def parse_yaml(text: str, where: str) -> dict[str, Any]:
    """Parse stored settings as plain containers.

    References within YAML, which can make a file of some bytes mean gigabytes, and tags of
    Python objects are refused.

    Raises:
        ResultsError: naming what was wrong and where it comes from.
    """
    try:
        _check_bounds(text)
        content = yaml.load(text, Loader=LOADER)  # safe: plain values only
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        raise ResultsError(f"{where}: damaged: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise ResultsError(f"{where}: damaged: expected settings, got {type(content).__name__}")
    return content


def _check_bounds(text: str) -> None:
    """Refuse what is cheap to write and dear to build, before anything is built."""
    if len(text) > LARGEST_FILE:
        raise ValueError(f"longer than {LARGEST_FILE} characters")
    depth = 0
    for event in yaml.parse(text, Loader=LOADER):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError("uses YAML references (&, *); expected plain values")
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise ValueError(f"nested more than {DEEPEST} deep")
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > LONGEST_VALUE:
            raise ValueError(f"a value of more than {LONGEST_VALUE} characters")


def read_json(path: Path) -> Any:
    """Read a small JSON file.

    Raises:
        ResultsError: if it is missing or damaged.
    """
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise ResultsError(f"{path}: damaged: {error}") from error
