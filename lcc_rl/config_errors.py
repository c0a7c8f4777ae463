"""What Hydra says about a wrong option, said again with the nearest option that exists."""

from __future__ import annotations

import re
from dataclasses import fields, is_dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from lcc_rl.errors import ConfigError, how_to_install, unknown_name

REFUSED = re.compile(r"Could not (?:override|delete from config\.|append to config\.?) '([^']+)'")
MERGED = re.compile(r"^Error merging override \+*([^=]+)=(.*)", re.DOTALL)
INNER = re.compile(r"Key '([^']+)' is not in struct")
# Launchers and sweepers that come with other packages: which extra brings them.
EXTRAS = {
    "joblib": "sweeps",
    "submitit_local": "sweeps",
    "submitit_slurm": "sweeps",
    "ray": "ray",
}


def refused_key(error: Exception) -> str | None:
    """Return the dotted key that Hydra could not override, where that is what went wrong."""
    found = REFUSED.search(str(error))
    return found.group(1).partition("@")[0] if found else None


def refused_by_hydra(error: BaseException) -> bool:
    """Whether an error comes from Hydra or OmegaConf, which say some by ValueError or TypeError."""
    trail = error.__traceback__
    while trail is not None and trail.tb_next is not None:
        trail = trail.tb_next
    module = "" if trail is None else str(trail.tb_frame.f_globals.get("__name__"))
    if isinstance(error, (HydraException, OmegaConfBaseException)):
        return True
    # An OSError is of a file that Hydra writes, and no fault of the options.
    named = isinstance(error, Exception) and not isinstance(error, OSError)
    return named and module.partition(".")[0] in ("hydra", "omegaconf")


def explain(error: Exception, valid: Any) -> Exception:
    """Return a clearer error for what Hydra says about an option, or the error itself.

    Args:
        error: what Hydra or OmegaConf raised.
        valid: the configuration without the option at fault, for the names that exist.
    """
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        return _missing_choice(error)
    if isinstance(error, OverrideParseException):
        return _unread(error.override)
    key = refused_key(error)
    if key is None:
        return _not_merged(error)
    parent, _, name = key.rpartition(".")
    try:
        node = OmegaConf.select(valid, parent) if parent else valid
    except Exception:  # an interpolation of Hydra's own that exists only inside a run
        return error
    referring = _reference(valid, key)
    if referring is not None:
        return referring
    if parent == "agent" and node is None:
        variant = OmegaConf.select(valid, "variant")
        return ConfigError(f"{key}: variant {variant} learns nothing, it has no agent")
    inner = INNER.search(str(error.__cause__))
    if OmegaConf.is_dict(node) and OmegaConf.is_dict(node.get(name)) and inner is not None:
        return unknown_name(_what(key), inner.group(1), map(str, node[name]))
    if parent in valid and node is None:
        return ConfigError(f"{key}: there is no {parent}; choose one with {parent}=…")
    if not OmegaConf.is_dict(node):
        return unknown_at(parent, valid) or error
    if not parent and name in node:  # other variants have it
        variant = OmegaConf.select(valid, "variant")
        return ConfigError(f"variant {variant} has no {name} to choose; leave {name}=… out")
    if name in node:  # composed without the values of a sweep
        return ConfigError(f"{key}: not every run of this sweep has it; sweep those that do alone")
    names = {*map(str, node), *(() if parent else ("experiment",))}
    return unknown_name(_what(parent), name, names)


def _unread(word: str) -> ConfigError:
    """Return the error for a word that the grammar of settings cannot read."""
    key, _, value = word.partition("=")
    bare = value.strip("'\"")
    return ConfigError(
        f"{word}: cannot be read as a setting. Brackets must be closed, and text with spaces, "
        f"commas or signs stands in quotes within quotes: \"{key}='{bare}'\""
    )


def _not_merged(error: Exception) -> Exception:
    """Return the error for a value of the wrong kind."""
    found, cause = MERGED.search(str(error)), error.__cause__
    if cause is None or found is None:
        return error
    if "ListConfig" in str(cause):
        key, value = found.groups()
        return ConfigError(f"{key}={value}: expected a list; say '{key}=[{value}]'")
    return ConfigError(f"{error}: {str(cause).splitlines()[0]}")


def _reference(valid: Any, key: str) -> ConfigError | None:
    """Return the error for a setting inside a node that only stands for another one."""
    parts, node = key.split("."), valid
    for place, name in enumerate(parts[:-1], 1):
        if not OmegaConf.is_dict(node) or name not in node:
            return None
        if OmegaConf.is_interpolation(node, name):
            text = str(OmegaConf.to_container(node, resolve=False)[name])  # type: ignore[call-overload,index]
            inside, rest = ".".join(parts[:place]), ".".join(parts[place:])
            there = f"{text.removeprefix('${').removesuffix('}')}.{rest}"
            return ConfigError(
                f"{key}: {inside} stands for {text}; set {there} for both, or give {inside} a node "
                f"of its own: '{inside}={{_target_: …, {rest}: …}}'"
            )
        node = node[name]
    return None


def unknown_at(path: str, valid: Any) -> ConfigError | None:
    """Return the error for the first part of a dotted path that does not exist."""
    node = valid
    for place, name in enumerate(parts := path.split(".")):
        if not OmegaConf.is_dict(node) or name not in node:
            names = map(str, node) if OmegaConf.is_dict(node) else ()
            return unknown_name(_what(".".join(parts[:place])), name, names)
        node = node[name]
    return None


def check_keys(cfg: DictConfig, where: str = "") -> None:
    """Refuse keys that were added with ``+`` where the schema knows none.

    Raises:
        ConfigError: naming the key and the nearest one that exists.
    """
    schema = OmegaConf.get_type(cfg)
    known = [item.name for item in fields(schema)] if is_dataclass(schema) else []
    for key in map(str, cfg):
        if known and key not in known:
            raise unknown_name(_what(where), key, known)
        # Values that are missing or refer to others have no keys of their own to check.
        if OmegaConf.is_missing(cfg, key) or OmegaConf.is_interpolation(cfg, key):
            continue
        if isinstance(cfg[key], DictConfig):
            check_keys(cfg[key], f"{where}.{key}" if where else key)


def _missing_choice(error: MissingConfigException) -> ConfigError:
    group, _, name = str(error.missing_cfg_file).rpartition("/")
    if group in ("hydra/launcher", "hydra/sweeper") and name in EXTRAS:
        extra = EXTRAS[name]
        return ConfigError(f"{group}/{name} is not installed: {how_to_install(extra)}")
    shipped = Path(str(files("lcc_rl.conf"))) / group
    options = error.options or [path.stem for path in shipped.glob("*.yaml")]
    return unknown_name(f"choice of {group}" if group else "option", name, options)


def _what(parent: str) -> str:
    return f"setting of {parent}" if parent else "option"
