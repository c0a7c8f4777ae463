"""Files of a run folder: its configuration, and results that must not be overwritten."""

from __future__ import annotations

import logging
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from functools import cache, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lcc_rl.config.inputs import inputs_of
from lcc_rl.config.nodes import as_plain
from lcc_rl.config.schemas import SECTIONS, BaseConfig, as_text
from lcc_rl.errors import ResultsError, line_of, replacing
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.settings import parse_yaml, read_text
from lcc_rl.results.trust import LOGS, own_modules, trusted
from lcc_rl.runs.states import CHECKPOINT, CONFIG, no_run
from lcc_rl.version import PACKAGE, code_version

log = logging.getLogger("lcc_rl")

POLICY = "policy.pt"
EPISODES = "episodes.parquet"  # last file of a run, which shows that it is finished
STEPS, RECORD = "steps.parquet", "training.parquet"
ORIGIN = "origin.txt"  # where a run comes from
PARTS, FINAL = ".parts", "evaluation"  # parts' settings and last part of a job of lcc-rl run
SECTION = re.compile(r"^(?=[a-z])", re.MULTILINE)  # before the name of a section of settings
# Results and states of stopped runs, which commands with other settings must not replace.
RUN_FILES = (EPISODES, "drivers.parquet", CHECKPOINT, "command.txt", "blocks")


def save_config(cfg: BaseConfig, folder: Path, resumed: bool = False) -> None:
    """Write the resolved configuration of a run into its folder, and where the run comes from.

    A resumed run keeps its origin beside that of the new command; other versions are logged.
    """
    with atomic_path(folder / CONFIG) as temporary:
        temporary.write_text(as_text(cfg), encoding="utf-8")
    before, now = "", versions()
    if resumed and (folder / ORIGIN).is_file():
        before = read_text(folder / ORIGIN)
        others = {line for line in before.splitlines() if line.startswith("lcc_rl ")} - {now}
        for line in sorted(others):
            log.warning("%s: begun with %s, resumed with %s", folder, line, now)
    with atomic_path(folder / ORIGIN) as temporary:
        temporary.write_text(before + origin(), encoding="utf-8")


def versions() -> str:
    """Return the versions on which a result depends."""
    return f"lcc_rl {code_version()}, torch {version('torch')}, Python {platform.python_version()}"


def origin() -> str:
    """Return the lines of ``origin.txt``: command, versions, folder, and the commit of a clone.

    It is no part of a run's identity; the settings and the hashes of its files are in config.yaml.
    """
    program = [Path(sys.argv[0]).name, *sys.argv[1:]]
    return "\n".join([shlex.join(program), versions(), str(Path.cwd()), *_commit(), ""])


@cache
def _commit() -> tuple[str, ...]:
    """Return the commit of the package and how many files differ from it, if git tracks it."""
    if not _git("ls-files", "--", "version.py"):
        return ()
    commit, count = _git("rev-parse", "HEAD"), len(_git("status", "--porcelain").splitlines())
    return (f"commit {commit.strip()}, {f'{count} files changed' if count else 'unchanged'}",)


def _git(*words: str) -> str:
    # A monitor of file systems is a program that the repository names.
    command = ["git", "-C", str(PACKAGE), "-c", "core.fsmonitor=false", *words]
    try:
        found = subprocess.run(command, capture_output=True, text=True, timeout=5.0, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return found.stdout if found.returncode == 0 else ""


def check_folder(cfg: BaseConfig, folder: Path, *but: str) -> None:
    """Refuse a folder with results, or a stopped run, of other settings.

    Args:
        cfg, folder: configuration of the run and its folder.
        *but: settings and sections that may differ, besides ``trust``.

    Raises:
        ResultsError: naming a file and the settings that differ.
    """
    stored = read_settings(folder / CONFIG) if (folder / CONFIG).is_file() else {}
    if stored and not {"seed", "data"} <= stored.keys():
        raise ResultsError(f"{folder} holds a {CONFIG} of something else; choose another folder")
    files = [name for name in RUN_FILES if (folder / name).exists()]
    if not files:
        return
    with suppress(ResultsError):  # complete a file of an older version by defaults
        stored = as_plain(trusted(stored, str(folder / CONFIG), own_modules(cfg))[0])
    both = (without(dict(flatten(x)), (*but, "trust", LOGS)) for x in (stored, as_plain(cfg)))
    if keys := differing(*both):
        names = ", ".join(keys[:3]) + (", …" if len(keys) > 3 else "")
        raise ResultsError(
            f"{folder} already holds {files[0]} of other settings ({names}); choose another "
            "hydra.run.dir, or remove the folder"
        )


def resumed_config(folder: str | Path, trust: Sequence[str] = ()) -> Any:
    """Read the configuration of a run to resume; arguments as for :func:`load_config`.

    Raises:
        ResultsError: naming an input file that has changed since the run began, or is missing.
    """
    cfg = load_config(folder, trust)
    now = inputs_of(as_plain(cfg))
    for section, hashes in cfg.inputs.items():
        present = now.get(section, {})
        for file in differing(hashes, present):
            how = "has changed since the run began" if file in present else "is missing"
            raise ResultsError(
                f"{folder}: {file} ({section}) {how}; restore it, or begin a new run"
            )
    return cfg


def load_config(folder: str | Path, trust: Sequence[str] = ()) -> Any:
    """Read the configuration of a run.

    Args:
        folder: the run's folder.
        trust: modules outside this package that the configuration may name.

    Raises:
        ConfigError: if the folder holds no run.
        ResultsError: if its configuration is damaged.
    """
    path = Path(folder) / CONFIG
    if not path.is_file():
        raise no_run(Path(folder))
    cfg, places = trusted(read_settings(path), str(path), trust)
    for key in places:
        log.warning("%s: %s names a path to write to and is left out", path, key)
    return cfg


def read_settings(path: Path) -> dict[str, Any]:
    """Read a stored configuration as plain containers; nothing is built from it.

    Raises:
        ResultsError: if it is missing or damaged.
    """
    return _settings(read_text(path), str(path))


def flat_settings(path: Path) -> dict[str, Any]:
    """Read a stored configuration as a flat mapping; shared sections are parsed once.

    Raises:
        ResultsError: if it is missing or damaged.
    """
    text = read_text(path)
    with suppress(ResultsError):  # without sections, or damaged
        return {key: x for part in SECTION.split(text) if part for key, x in _section(part)}
    return dict(flatten(_settings(text, str(path))))


@lru_cache(maxsize=256)
def _section(text: str) -> list[tuple[str, Any]]:
    return list(flatten(_settings(text, "")))


def _settings(text: str, where: str) -> dict[str, Any]:
    content = parse_yaml(text, where)
    for name in SECTIONS:
        if not isinstance(content.get(name, {}), Mapping):
            got = f"must be a mapping of settings, got {content[name]!r}"
            raise ResultsError(f"{where}: damaged: {name} {got}")
    return content


def naming_run(path: Path) -> AbstractContextManager[None]:
    """Convert errors of unexpected rows or settings to a ResultsError that names the run.

    Raises:
        ResultsError: in place of the error.
    """

    def unlike(error: Exception) -> ResultsError:
        return ResultsError(f"{path}: not written by a run: {line_of(error, True)}")

    return replacing(unlike, (LookupError, ValueError, TypeError))


def differing(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Return the sorted keys with different values, or in one of two flat mappings only."""
    return [key for key in sorted(one.keys() | other.keys()) if one.get(key) != other.get(key)]


def without(settings: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Return settings by dotted key, but not those named and those of sections named."""
    prefixes = tuple(f"{name}." for name in names)
    return {key: x for key, x in settings.items() if not f"{key}.".startswith(prefixes)}


def flatten(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every setting of a configuration with its dotted key; lists become text."""
    for key, value in node.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from flatten(value, f"{name}.")
        else:
            yield name, str(value) if isinstance(value, list) else value


def differences(
    settings: Sequence[Mapping[str, Any]], *kept: str, last: Sequence[str] = ()
) -> list[dict[str, str]]:
    """Return for each flat mapping the values by which it differs, ``key=value``, by key.

    As few keys as possible are used besides the kept ones, each with its last words:
    ``safety.weight=0.5``. Hashes of files are used only if no setting differs, and keys other than
    the ``last`` ones only if these do not tell the mappings apart.
    """
    every = list(dict.fromkeys(key for one in settings for key in one))

    def kinds(keys: Sequence[str]) -> int:
        return len({tuple(str(one.get(key)) for key in keys) for one in settings})

    chosen = [key for key in every if kinds([key]) > 1]
    ranks = {key: (not key.startswith("inputs."), key in last, kinds([key])) for key in chosen}
    for key in sorted(chosen, key=ranks.__getitem__):
        rest = [x for x in chosen if x != key]
        chosen = rest if key not in kept and kinds(rest) == kinds(chosen) else chosen
    names = {key: _last_words(key, chosen) for key in chosen}
    return [{k: f"{names[k]}={one[k]}" for k in chosen if k in one} for one in settings]


def _last_words(key: str, keys: Sequence[str]) -> str:
    """Return as many of the last words of a dotted key as are unique, at least two."""
    words = key.split(".")
    ends = (".".join(words[-count:]) for count in range(2, len(words)))
    return next((end for end in ends if sum(f".{x}".endswith(f".{end}") for x in keys) == 1), key)
