"""Hashes of input files, which are part of a run's identity."""

from __future__ import annotations

import ast
import hashlib
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from importlib.util import resolve_name
from os.path import expanduser
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig

from lcc_rl.config.nodes import settings_at
from lcc_rl.config.words import FILTERED, YAML, module_named
from lcc_rl.errors import ConfigError, ResultsError, is_ours, is_users
from lcc_rl.io.paths import matching
from lcc_rl.io.settings import parse_yaml, read_text
from lcc_rl.settings import TARGET, load_module

FileHashes = dict[str, dict[str, str]]
NOT_READ = ("inputs", "resume", "sweep", "logger", "trust")
NAMING_SECTIONS = ("compare", "policy")  # sections that name policies, controllers and classes
FRESH = 2.0  # a file may change again within the resolution of its times [s]


def inputs_of(content: Mapping[str, Any]) -> FileHashes:
    """Return the present hashes of the files that a configuration names.

    These are the files of ``path`` of any node (a file, several, a folder or a pattern), compared
    policies and controllers, and the modules of user's classes with settings that are files. Files
    of the package are identified by its version.

    Args:
        content: a configuration as plain containers.

    Returns:
        By section of the configuration: hashes of files by their given path, of modules by name.
    """
    hashes: FileHashes = {}
    for key, holder, value in settings_at(content):
        section = key.partition(".")[0]
        named = section in NAMING_SECTIONS and (holder is content or holder is content[section])
        for name in value if isinstance(value, list) else [value]:
            if section in NOT_READ or not isinstance(name, str):
                continue
            with suppress(OSError, ValueError, ResultsError):  # the reader raises the error later
                for path in filter(Path.is_file, _files(key, named, holder, name)):
                    digest = _digest(path)
                    digests = hashes.setdefault(section, {})
                    last = path.parts[-2 if path.name == "__init__.py" else -1 :]
                    label = "/".join(last) if path.suffix == ".py" else str(path)
                    equal = digests.get(label, digest) == digest
                    digests[label if equal else str(path)] = digest
    return hashes


def _files(key: str, named: bool, holder: Any, name: str) -> Iterator[Path]:
    """Yield the files that a setting names."""
    path, last = Path(expanduser(name)), key.rpartition(".")[2]
    target = holder.get(TARGET) if isinstance(holder, Mapping) else None
    own = target is not None and not is_ours(target)  # the node of a user's class or function
    if module := module_named(key, name):
        yield from _own_files(module)
    elif named:
        yield from compared_files(name)
    elif last == "path" or own:
        yield from map(Path, matching(str(path), deep=last == "path"))


def compared_files(name: str) -> Iterator[Path]:
    """Yield the file of a policy, of a folder of runs, or those of a controller."""
    path = Path(name.removesuffix(FILTERED))
    if path.is_dir():
        yield from sorted(path.rglob("policy.pt"))
    elif not path.exists():
        yield from _own_files(str(path).rpartition(".")[0])
        if HydraConfig.initialized():  # it may be a file of --config-dir
            for source in HydraConfig.get().runtime.config_sources:
                file = Path(source.path) / "controller" / f"{path}.yaml"
                if source.provider == "command-line" and file.is_file():
                    yield from compared_files(str(file))
    else:
        yield path
        if path.suffix in YAML:
            for key, holder, value in settings_at(parse_yaml(read_text(path), str(path))):
                yield from _files(key, False, holder, str(value))


def _own_files(module: str) -> Iterator[Path]:
    """Yield the file of a user's module and the files beside it that it imports, or they do."""
    path = Path()  # a notebook has no file
    if not is_ours(module) and "/" not in module:
        with suppress(ConfigError):
            path = Path(getattr(load_module(module, TARGET), "__file__", None) or "")
    if path.suffix != ".py" or not is_users(module, path):
        return
    depth = module.count(".") + (path.name == "__init__.py")
    files, root = [path], path.parents[depth]
    for file in files:  # the list grows
        yield file
        for name in sorted(_imports(file, ".".join(file.parent.relative_to(root).parts))):
            stem = root.joinpath(*name.split("."))
            beside = (stem.with_suffix(".py"), stem / "__init__.py")
            files += [x for x in beside if x.is_file() and x not in files]


def _imports(path: Path, package: str) -> set[str]:
    """Return the names of all modules that a file of a package may import; not this package's."""
    names: set[str] = set()
    tree: Any = ()
    with suppress(SyntaxError):  # an optional module that cannot be imported
        tree = ast.walk(ast.parse(path.read_bytes()))
    for node in tree:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            with suppress(ImportError):
                base = resolve_name("." * node.level + (node.module or ""), package)
                names |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    return {name for name in names if not is_ours(name)}


_digests: dict[tuple[object, ...], str] = {}  # once per content of a file and process


def _digest(path: Path) -> str:
    stat = path.stat()
    key = path.absolute(), stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns
    if key not in _digests or time.time() - stat.st_ctime < FRESH:
        with path.open("rb") as file:
            _digests[key] = hashlib.file_digest(file, "sha256").hexdigest()[:16]
    return _digests[key]
