"""Files of a run folder: configuration, and tables of many runs as one."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import DictConfig, OmegaConf

from lcc_rl.config import plain
from lcc_rl.errors import ConfigError, ResultsError, unknown_name
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import read_parquet
from lcc_rl.io.settings import parse_yaml, read_text
from lcc_rl.results.trust import trusted

log = logging.getLogger("lcc_rl")

CONFIG = "config.yaml"
TABLES = ("episodes", "training", "timing", "steps", "drivers")
# What no command of other settings may replace: results, and what a stopped run resumes from.
KEPT = ("episodes.parquet", "drivers.parquet", "checkpoint.pt", "overrides.json")


def save_config(cfg: DictConfig, folder: Path) -> None:
    """Write the resolved configuration of a run into its folder."""
    with atomic_path(folder / CONFIG) as temporary:
        temporary.write_text(_as_text(cfg))


def check_folder(cfg: DictConfig, folder: Path) -> None:
    """Refuse to write into a folder that holds results, or a stopped run, of other settings.

    Raises:
        ResultsError: naming what is there and the settings that differ.
    """
    kept = [name for name in KEPT if (folder / name).exists()]
    if not kept:
        return
    stored = read_settings(folder / CONFIG) if (folder / CONFIG).is_file() else {}
    keys = differing(dict(flatten(stored)), dict(flatten(parse_yaml(_as_text(cfg), CONFIG))))
    if keys:
        names = ", ".join(keys[:3]) + (", …" if len(keys) > 3 else "")
        raise ResultsError(
            f"{folder} already holds {kept[0]} of other settings ({names}); choose another "
            "hydra.run.dir, or remove the folder"
        )


def check_links(folder: Path) -> None:
    """Refuse to resume in a folder that holds links: one of somebody else could lead anywhere.

    Raises:
        ResultsError: naming the link.
    """
    link = next((path for path in sorted(folder.rglob("*")) if path.is_symlink()), None)
    if link is not None:
        raise ResultsError(f"{link}: a link, which may lead out of the folder; put the file there")


def _as_text(cfg: DictConfig) -> str:
    return OmegaConf.to_yaml(OmegaConf.create(plain(cfg)))


def load_config(folder: str | Path, trust: Sequence[str] = ()) -> DictConfig:
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


def read_settings(path: Path) -> dict[str, Any]:
    """Read a stored configuration as plain containers.

    Raises:
        ResultsError: if it is damaged.
    """
    return parse_yaml(read_text(path), str(path))


def load(
    root: str | Path = "outputs", table: str = "episodes", strict: bool = False
) -> pd.DataFrame:
    """Read one table of every run below a folder.

    A damaged run is left out with a warning; ``frame.attrs["damaged"]`` holds the reasons by run.

    Args:
        root: a run folder, or any folder above runs.
        table: ``"episodes"``, ``"training"``, ``"timing"``, ``"steps"`` or ``"drivers"``.
        strict: raise for a damaged run instead.

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
    frames, damaged = [], {}
    for path in sorted(root.rglob(f"{table}.parquet")):
        run = str(path.parent.relative_to(root))
        try:
            frames.append(_with_settings(read_parquet(path), path.parent, run))
        except ResultsError as error:
            if strict:
                raise
            log.warning("left out: %s", error)
            damaged[run] = str(error)
    if not frames:
        why = f"; none is readable: {next(iter(damaged.values()))}" if damaged else ""
        raise ResultsError(f"{root}: no {table}.parquet in it or below it{why}")
    rows = pd.concat(frames, ignore_index=True)
    rows.attrs |= {"damaged": damaged} if damaged else {}
    return rows


def _with_settings(frame: pd.DataFrame, folder: Path, run: str) -> pd.DataFrame:
    """Add the run's name and its settings as columns."""
    config = folder / CONFIG
    settings = dict(flatten(read_settings(config))) if config.is_file() else {}
    extra = {"run": run, **settings}
    new = {k: [v] * len(frame) for k, v in extra.items() if k not in frame.columns}
    return pd.concat([frame, pd.DataFrame(new, index=frame.index)], axis=1)


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
