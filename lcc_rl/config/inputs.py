"""Files that a run reads, by their content: a part of what the run is."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import lru_cache
from glob import glob, has_magic
from os.path import expanduser
from pathlib import Path
from typing import Any

from lcc_rl.config.nodes import TARGET, find_target, is_node, settings_at
from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.io.settings import parse_yaml, read_text

Inputs = dict[str, dict[str, str]]
NOT_READ = ("inputs", "resume", "sweep", "logger", "trust")
NAMES = ("compare", "policy")  # sections that name policies, controllers and classes
FILTERED = "_filtered"


def inputs_of(content: Mapping[str, Any]) -> Inputs:
    """Return hashes of the files that a configuration names, as they are now.

    These are what ``path`` of any node names, a file, several, a folder or a pattern; policies and
    controllers that are compared; and of classes of the user's own their module and each setting
    that is a file. What comes with the package has its version.

    Args:
        content: a configuration as plain containers.

    Returns:
        By section of the configuration, the first part of a setting's key, the hash of each file
        by its name as given, of a module by that of the module.
    """
    found: Inputs = {}
    for key, holder, value in settings_at(content):
        section, last = key.partition(".")[0], key.rpartition(".")[2]
        if section in NOT_READ:
            continue
        named = section in NAMES and (holder is content or holder is content[section])
        for name, path in _files(last, named, holder, value):
            with suppress(OSError):  # its reader says so
                stat = path.stat()
                digest = _digest(str(path), stat.st_size, stat.st_mtime_ns)
                found.setdefault(section, {})[name] = digest
    return found


def _files(last: str, named: bool, holder: Any, value: Any) -> Iterator[tuple[str, Path]]:
    """Yield the name and the path of each file that a setting names."""
    if last in (TARGET, "law"):
        yield from _module(str(value))
    elif named and isinstance(value, str):
        yield from _compared(value.removesuffix(FILTERED))
    elif last == "path" or (is_node(holder) and not _is_ours(str(holder[TARGET]))):
        for name in value if isinstance(value, list) else [value]:
            if isinstance(name, str) and "\0" not in name:
                yield from _matching(expanduser(name))


def _matching(name: str) -> Iterator[tuple[str, Path]]:
    path = Path(name)
    if has_magic(name) and not path.exists():
        names = glob(name, recursive=True)
    else:
        names = [str(x) for x in path.iterdir()] if path.is_dir() else [name]
    yield from ((x, Path(x)) for x in sorted(names) if Path(x).is_file())


def _compared(name: str) -> Iterator[tuple[str, Path]]:
    """Yield a policy's file, those of a folder of runs, or what a controller is made of."""
    path = Path(name)
    if path.is_dir():
        yield from ((str(file), file) for file in sorted(path.rglob("policy.pt")))
    elif path.is_file():
        yield name, path
        if path.suffix in (".yaml", ".yml"):
            with suppress(ResultsError):
                for key, holder, value in settings_at(parse_yaml(read_text(path), name)):
                    yield from _files(key.rpartition(".")[2], False, holder, value)
    elif "/" not in name:
        yield from _module(name)


def _module(target: str) -> Iterator[tuple[str, Path]]:
    """Yield the module of a class or function of the user's own; a notebook's has no file."""
    module = target.rpartition(".")[0]
    if module and not _is_ours(target):
        with suppress(ConfigError, TypeError, OSError):
            found = inspect.unwrap(find_target(target, TARGET))
            yield module, Path(inspect.getfile(found))


def _is_ours(target: str) -> bool:
    return target.startswith("lcc_rl.")


@lru_cache(maxsize=4096)  # once in a process for each file
def _digest(path: str, size: int, modified: int) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]
