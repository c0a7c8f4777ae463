"""Run folders: what a run leaves behind, and how many runs become one table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import DictConfig, OmegaConf

from lcc_rl.config import config_hash, plain
from lcc_rl.errors import ConfigError, ResultsError, unknown_name
from lcc_rl.results.files import atomic_path, read_parquet, read_torch, write_torch

CONFIG = "config.yaml"
PRETRAINED = "pretrained"
TABLES = ("episodes", "training", "timing", "steps", "drivers")
# Settings that say where and how to run, not what: they do not change any row.
NOT_IDENTITY = ("resume", "compare", "policy", "jobs")


def identity(cfg: DictConfig) -> str:
    """Return the hash of everything in a configuration that determines the results."""
    return config_hash({k: v for k, v in plain(cfg).items() if k not in NOT_IDENTITY})


def save_config(cfg: DictConfig, folder: Path) -> None:
    """Write the resolved configuration of a run into its folder."""
    with atomic_path(folder / CONFIG) as temporary:
        temporary.write_text(OmegaConf.to_yaml(OmegaConf.create(plain(cfg))))


def load_config(folder: str | Path) -> DictConfig:
    """Read the configuration of a run.

    Raises:
        ConfigError: if the folder holds no run.
        ResultsError: if its configuration is damaged.
    """
    path = Path(folder) / CONFIG
    if not path.is_file():
        raise ConfigError(f"{folder}: not a run folder: it has no {CONFIG}")
    try:
        cfg = OmegaConf.load(path)
    except Exception as error:  # yaml and OmegaConf raise many kinds
        raise ResultsError(f"{path}: damaged: {error}") from error
    if not isinstance(cfg, DictConfig) or "variant" not in cfg:
        raise ResultsError(f"{path}: not the configuration of a run")
    return cfg


def save_policy(weights: Mapping[str, Any], cfg: DictConfig, path: Path) -> None:
    """Write a policy: its weights and, as text, the configuration it was trained with."""
    write_torch({"weights": dict(weights), "config": OmegaConf.to_yaml(plain(cfg))}, path)


def pretrained_path(variant: str) -> Path:
    """Return the policy that ships with the package for a variant.

    Raises:
        ConfigError: if none does.
    """
    shipped = Path(str(files("lcc_rl.assets"))) / "pretrained"
    path = shipped / f"{variant}.pt"
    if not path.is_file():
        names = sorted(file.stem for file in shipped.glob("*.pt"))
        raise ConfigError(
            f"no pretrained policy ships for variant {variant}, only for {', '.join(names)}; "
            f"python -m lcc_rl.train variant={variant} makes one"
        )
    return path


def load_policy(path: str | Path, variant: str = "") -> tuple[dict[str, Any], DictConfig]:
    """Read a policy file, or that of a run folder; code in it is never run.

    Args:
        path: the file or the folder; ``"pretrained"`` for the policy that ships for ``variant``,
            ``"pretrained/reference"`` for that of another one.
        variant: variant of the study at hand.

    Returns:
        The weights and the configuration.

    Raises:
        ConfigError: if no policy ships for the variant.
        ResultsError: if it is missing, damaged or no policy.
    """
    path = Path(path)
    if path.parts[:1] == (PRETRAINED,) and not path.exists():
        path = pretrained_path(path.name if len(path.parts) > 1 else variant)
    if path.is_dir():
        path = path / "policy.pt"
    content = read_torch(path)
    if not isinstance(content, dict) or not {"weights", "config"} <= set(content):
        raise ResultsError(f"{path}: not a policy: expected the entries weights and config")
    cfg = OmegaConf.create(str(content["config"]))
    if not isinstance(cfg, DictConfig):
        raise ResultsError(f"{path}: its configuration is damaged")
    return content["weights"], cfg


def load(root: str | Path = "outputs", table: str = "episodes") -> pd.DataFrame:
    """Read one table of every run below a folder.

    Args:
        root: a run folder, or any folder above runs.
        table: ``"episodes"``, ``"training"``, ``"timing"``, ``"steps"`` or ``"drivers"``.

    Returns:
        The rows of all runs, in the order of their folders, with the column ``run`` and one
        column for every setting of their configurations, named by its dotted key
        (``"seed"``, ``"agent.gamma"``, ``"reward.terms.safety.weight"`` …).

    Raises:
        ConfigError: if the table's name is unknown.
        ResultsError: if there is no such table below ``root``, or one cannot be read.
    """
    if table not in TABLES:
        raise unknown_name("table", table, TABLES)
    root = Path(root)
    frames = []
    for path in sorted(root.rglob(f"{table}.parquet")):
        frame = read_parquet(path)
        folder = path.parent
        settings = dict(flatten(plain(load_config(folder)))) if _is_run(folder) else {}
        extra = {"run": str(folder.relative_to(root)), **settings}
        new = {k: [v] * len(frame) for k, v in extra.items() if k not in frame.columns}
        frames.append(pd.concat([frame, pd.DataFrame(new, index=frame.index)], axis=1))
    if not frames:
        raise ResultsError(f"{root}: no {table}.parquet in it or below it")
    return pd.concat(frames, ignore_index=True)


def _is_run(folder: Path) -> bool:
    return (folder / CONFIG).is_file()


def flatten(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every setting of a configuration with its dotted key; lists become text."""
    for key, value in node.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from flatten(value, f"{name}.")
        else:
            yield name, str(value) if isinstance(value, list) else value
