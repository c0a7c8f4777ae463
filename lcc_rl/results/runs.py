"""Files of a run folder: configuration, and tables of many runs as one."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, overload

import pandas as pd
from pyarrow.dataset import Dataset

from lcc_rl.config.schemas import BaseConfig, as_plain, as_text
from lcc_rl.errors import ConfigError, ResultsError, unknown_name
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import Rows, as_dataset, parquet_metadata, read_parquet
from lcc_rl.io.settings import parse_yaml, read_text
from lcc_rl.results.trust import trusted

log = logging.getLogger("lcc_rl")

CONFIG = "config.yaml"
TABLES = ("episodes", "training", "timing", "steps", "drivers")
EPISODES = "episodes.parquet"  # a run's last file: with it the run is finished
STEPS = "steps.parquet"
# What no command of other settings may replace: results, and what a stopped run resumes from.
KEPT = (EPISODES, "drivers.parquet", "checkpoint.pt", "command.txt", "blocks")
SHARD, SHARDS = "evaluation.shard", "evaluation.shards"


def save_config(cfg: BaseConfig, folder: Path) -> None:
    """Write the resolved configuration of a run into its folder."""
    with atomic_path(folder / CONFIG) as temporary:
        temporary.write_text(as_text(cfg))


def check_folder(cfg: BaseConfig, folder: Path) -> None:
    """Refuse to write into a folder that holds results, or a stopped run, of other settings.

    Raises:
        ResultsError: naming what is there and the settings that differ.
    """
    stored = read_settings(folder / CONFIG) if (folder / CONFIG).is_file() else {}
    if stored and not {"seed", "data"} <= stored.keys():
        raise ResultsError(f"{folder} holds a {CONFIG} of something else; choose another folder")
    kept = [name for name in KEPT if (folder / name).exists()]
    if not kept:
        return
    keys = differing(dict(flatten(stored)), dict(flatten(as_plain(cfg))))
    if keys:
        names = ", ".join(keys[:3]) + (", …" if len(keys) > 3 else "")
        raise ResultsError(
            f"{folder} already holds {kept[0]} of other settings ({names}); choose another "
            "hydra.run.dir, or remove the folder"
        )


def load_config(folder: str | Path, trust: Sequence[str] = ()) -> Any:
    """Read the configuration of a run.

    Args:
        folder: the run's folder.
        trust: modules outside this package that it may name.

    Raises:
        ConfigError: if the folder holds no run.
        ResultsError: if its configuration is damaged.
    """
    path = Path(folder) / CONFIG
    if not path.is_file():
        raise ConfigError(f"{folder}: not a run folder: it has no {CONFIG}")
    cfg, places = trusted(read_settings(path), str(path), trust)
    for place in places:
        log.warning("%s: %s names a place to write and is left out", path, place)
    return cfg


def stored_config(folder: Path) -> dict[str, Any]:
    """Read the configuration of a run to draw by, not to build from: it may name any module."""
    return read_settings(folder / CONFIG)


def read_settings(path: Path) -> dict[str, Any]:
    """Read a stored configuration as plain containers."""
    return parse_yaml(read_text(path), str(path))


@overload
def load(
    root: str | Path = ..., table: str = ..., strict: bool = ..., lazy: Literal[False] = ...
) -> pd.DataFrame: ...


@overload
def load(
    root: str | Path = ..., table: str = ..., strict: bool = ..., *, lazy: Literal[True]
) -> Dataset: ...


def load(
    root: str | Path = "outputs", table: str = "episodes", strict: bool = False, lazy: bool = False
) -> Rows:
    """Read one table of every run below a folder.

    A damaged run is left out with a warning; ``frame.attrs["damaged"]`` holds the reasons by run,
    and ``frame.attrs["missing"]`` the missing shards of an evaluation.

    Args:
        root: a run folder, or any folder above runs.
        table: ``"episodes"``, ``"training"``, ``"timing"``, ``"steps"`` or ``"drivers"``.
        strict: raise for a damaged run, or a missing shard, instead.
        lazy: return a pyarrow dataset, which reads rows when they are needed, for tables that do
            not fit into memory. Its columns of settings are those in which the runs differ.

    Returns:
        The rows of all runs, in the order of their folders, with the column ``run`` and one
        column for every setting of their configurations, named by its dotted key
        (``"seed"``, ``"agent.gamma"``, ``"reward.terms.safety.weight"`` …).

    Raises:
        ConfigError: if the table's name is unknown.
        ResultsError: if no such table below ``root`` can be read.
    """
    if table not in TABLES:
        raise unknown_name("table", table, TABLES)
    root = Path(root)
    found: dict[Path, dict[str, Any]] = {}
    frames, damaged = [], {}
    for path in sorted(root.rglob(f"{table}.parquet")):
        run = str(path.parent.relative_to(root))
        try:
            settings = {"run": run, **_settings(path.parent)}
            if lazy:
                parquet_metadata(path)
            else:
                frame = read_parquet(path)
                new = {k: [v] * len(frame) for k, v in settings.items() if k not in frame.columns}
                frames.append(pd.concat([frame, pd.DataFrame(new, index=frame.index)], axis=1))
            found[path] = settings
        except ResultsError as error:
            if strict:
                raise
            log.warning("left out: %s", error)
            damaged[run] = str(error)
    if not found:
        why = f"; none is readable: {next(iter(damaged.values()))}" if damaged else ""
        raise ResultsError(f"{root}: no {table}.parquet in it or below it{why}")
    missing = missing_shards(list(found.values())) if table == "episodes" else []
    for line in missing:
        if strict:
            raise ResultsError(f"{root}: {line}")
        log.warning("%s: %s", root, line)
    if lazy:
        return as_dataset(list(found), _different(list(found.values())))
    rows = pd.concat(frames, ignore_index=True)
    rows.attrs |= {"damaged": damaged} if damaged else {}
    rows.attrs |= {"missing": missing} if missing else {}
    return rows


def _settings(folder: Path) -> dict[str, Any]:
    """Return the settings of a run by their dotted keys; none without a configuration."""
    config = folder / CONFIG
    return dict(flatten(read_settings(config))) if config.is_file() else {}


def _different(runs: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the name of every run and the settings in which not all runs agree."""
    keys = dict.fromkeys(key for settings in runs for key in settings)
    kept = [k for k in keys if k == "run" or any(x.get(k) != runs[0].get(k) for x in runs)]
    found = [{key: settings.get(key) for key in kept} for settings in runs]
    for key in kept:  # a column of a dataset has one type
        kinds = {type(settings[key]) for settings in found} - {type(None)}
        if not kinds or len(kinds - {int, float}) > (0 if len(kinds) > 1 else 1):
            for settings in found:
                settings[key] = None if settings[key] is None else str(settings[key])
    return found


def missing_shards(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a line for every evaluation, among runs' settings, that lacks some of its shards."""
    parts: dict[str, set[int]] = {}
    for settings in (x for x in runs if (x.get(SHARDS) or 1) > 1):
        others = {key: value for key, value in settings.items() if key not in (SHARD, "run")}
        key = json.dumps(others, sort_keys=True, default=str)
        parts.setdefault(key, set()).add(settings[SHARD])
    lines = []
    for key, present in parts.items():
        settings = json.loads(key)
        gaps = sorted(set(range(settings[SHARDS])) - present)
        if gaps:
            which = ", ".join(map(str, gaps[:10])) + (", …" if len(gaps) > 10 else "")
            of = f"{len(gaps)} of {settings[SHARDS]} shards of variant {settings['variant']}"
            lines.append(f"{of} are missing: {SHARD}={which}")
    return lines


def differing(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Return the keys whose values differ or that only one of two flat mappings has, sorted."""
    return [key for key in sorted(one.keys() | other.keys()) if one.get(key) != other.get(key)]


def flatten(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every setting of a configuration with its dotted key; lists become text."""
    for key, value in node.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from flatten(value, f"{name}.")
        else:
            yield name, str(value) if isinstance(value, list) else value
