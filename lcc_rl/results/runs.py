"""Files of a run folder: configuration, policy, and tables of many runs as one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, cast

import pandas as pd
import yaml
from omegaconf import DictConfig, OmegaConf

from lcc_rl.config import TARGET, find_target, plain
from lcc_rl.errors import ConfigError, ResultsError, unknown_name
from lcc_rl.io.files import atomic_path, read_parquet, read_torch, write_torch

CONFIG = "config.yaml"
PRETRAINED = "pretrained"
# Variants that build on the policy of another one.
BUILDS_ON = {"hcfs": "ddpg"}
# Packages whose classes a stored configuration may name.
ROOMS = "agents data drivers evaluation functional pieces policies runs.loggers synthetic"
REGISTRY = tuple(f"lcc_rl.{room}" for room in ROOMS.split())
TABLES = ("episodes", "training", "timing", "steps", "drivers")


def save_config(cfg: DictConfig, folder: Path) -> None:
    """Write the resolved configuration of a run into its folder."""
    with atomic_path(folder / CONFIG) as temporary:
        temporary.write_text(OmegaConf.to_yaml(OmegaConf.create(plain(cfg))))


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
    cfg = OmegaConf.create(read_settings(path))
    if "variant" not in cfg:
        raise ResultsError(f"{path}: not the configuration of a run")
    check_targets(cfg, str(path), trust)
    return cfg


def read_settings(path: Path) -> dict[str, Any]:
    """Read a stored configuration as plain containers.

    Raises:
        ResultsError: if it is damaged.
    """
    # The C loader is five times as fast as OmegaConf's.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        content = yaml.load(path.read_text(), Loader=loader)  # safe: plain values only
    except (yaml.YAMLError, OSError, ValueError) as error:
        raise ResultsError(f"{path}: damaged: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise ResultsError(f"{path}: damaged: expected settings, got {type(content).__name__}")
    return content


def save_policy(weights: Mapping[str, Any], cfg: DictConfig, path: Path) -> None:
    """Write a policy's weights and, as text, the configuration of its training."""
    write_torch({"weights": dict(weights), "config": OmegaConf.to_yaml(plain(cfg))}, path)


def pretrained_path(variant: str) -> Path:
    """Return the policy that ships with the package for a variant.

    Raises:
        ConfigError: if none does.
    """
    shipped = Path(str(files("lcc_rl.assets"))) / "pretrained"
    path = shipped / f"{BUILDS_ON.get(variant, variant)}.pt"
    if not path.is_file():
        names = sorted(file.stem for file in shipped.glob("*.pt"))
        raise ConfigError(
            f"no pretrained policy ships for variant {variant}, only for {', '.join(names)}; "
            f"python -m lcc_rl.train variant={variant} makes one"
        )
    return path


def load_policy(
    path: str | Path, variant: str = "", trust: Sequence[str] = ()
) -> tuple[dict[str, Any], DictConfig]:
    """Read a policy file without running code from it.

    Args:
        path: the file or a run folder; ``"pretrained"`` for the policy that ships for
            ``variant``, ``"pretrained/reference"`` for that of another one.
        variant: name of a variant.
        trust: modules outside this package that it may name.

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
    try:
        cfg = OmegaConf.create(str(content["config"]))
    except Exception as error:  # yaml and OmegaConf raise many kinds
        raise ResultsError(f"{path}: its configuration is damaged: {error}") from error
    if not isinstance(cfg, DictConfig) or "variant" not in cfg:
        raise ResultsError(f"{path}: its configuration is damaged")
    check_targets(cfg, str(path), trust)
    return content["weights"], cfg


def check_targets(cfg: DictConfig, where: str, trust: Sequence[str] = ()) -> None:
    """Check that a stored configuration names no code outside :data:`REGISTRY`.

    Building a node of it imports and calls what it names.

    Args:
        cfg: the configuration.
        where: the file it comes from, for the message.
        trust: further modules that may be named, e.g. ``["mine"]``.

    Raises:
        ResultsError: naming the target, or a reference instead of a value.
    """
    content = cast(Mapping[str, Any], OmegaConf.to_container(cfg, resolve=False))
    for key, value in flatten(content):
        if "${" in str(value):
            raise ResultsError(f"{where}: {key} refers to {value!r}; expected plain values")
        if key.rpartition(".")[2] == TARGET and not is_registered(str(value), where, trust):
            module = str(value).rpartition(".")[0]
            raise ResultsError(
                f"{where}: {key} names {value!r}, which is not part of lcc_rl; if you trust it, "
                f"say trust=[{module}]"
            )


def is_registered(target: str, where: str, trust: Sequence[str] = ()) -> bool:
    """Whether a target is defined in :data:`REGISTRY` or in a trusted module.

    Raises:
        ResultsError: if a module of the registry has no such target.
    """
    module = target.rpartition(".")[0]
    if module in trust:
        return True
    if not module.startswith(REGISTRY):
        return False
    # A module also holds what it imports, such as import_module.
    try:
        found = find_target(target, where)
    except ConfigError as error:
        raise ResultsError(f"{error}; of another release, or damaged") from error
    return str(getattr(found, "__module__", "")).startswith(REGISTRY)


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
        config = folder / CONFIG
        settings = dict(flatten(read_settings(config))) if config.is_file() else {}
        extra = {"run": str(folder.relative_to(root)), **settings}
        new = {k: [v] * len(frame) for k, v in extra.items() if k not in frame.columns}
        frames.append(pd.concat([frame, pd.DataFrame(new, index=frame.index)], axis=1))
    if not frames:
        raise ResultsError(f"{root}: no {table}.parquet in it or below it")
    return pd.concat(frames, ignore_index=True)


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
