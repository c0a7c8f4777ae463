"""Files of policies: weights, and the configuration of their training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch

from lcc_rl.config.schemas import StudyConfig, as_text
from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.io.settings import parse_yaml
from lcc_rl.io.tensors import read_torch, write_torch
from lcc_rl.results.trust import trusted

PRETRAINED = "pretrained"
# Variants that build on the policy of another one.
BUILDS_ON = {"hcfs": "ddpg"}


def save_policy(weights: Mapping[str, Any], cfg: StudyConfig, path: Path) -> None:
    """Write a policy's weights and, as text, the configuration of its training."""
    # Copies: weights that are parts of one vector would be stored with all of it.
    own = {name: weight.clone() for name, weight in weights.items()}
    write_torch({"weights": own, "config": as_text(cfg)}, path)


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
            f"no pretrained policy ships for {variant}, only for {', '.join(names)}; train one "
            "(lcc-rl train) and give its folder"
        )
    return path


def load_policy(
    path: str | Path, variant: str = "", trust: Sequence[str] = ()
) -> tuple[dict[str, Any], StudyConfig]:
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
    first = path.parts[0] if path.parts else ""
    if first != PRETRAINED and not path.exists() and get_close_matches(first, [PRETRAINED]):
        raise ConfigError(f"policy={path}: no such file; did you mean {PRETRAINED!r}?")
    if first == PRETRAINED and not path.exists():
        path = pretrained_path(path.name if len(path.parts) > 1 else variant)
    if path.is_dir():
        path = path / "policy.pt"
    content = read_torch(path)
    if not isinstance(content, dict) or not {"weights", "config"} <= set(content):
        raise ResultsError(f"{path}: not a policy: expected the entries weights and config")
    weights = content["weights"]
    check_weights(weights, path)
    cfg, _ = trusted(parse_yaml(str(content["config"]), f"{path} (config)"), str(path), trust)
    if not isinstance(cfg, StudyConfig) or cfg.agent is None:
        raise ResultsError(f"{path}: not the configuration of a training: it has no agent")
    return weights, cfg


def check_weights(weights: Any, path: Path) -> None:
    """Check that weights are finite numbers by name; an error names the file and the entry."""
    if not isinstance(weights, dict) or not weights:
        raise ResultsError(f"{path}: weights are {type(weights).__name__}, expected named tensors")
    for name, value in weights.items():
        if not isinstance(name, str) or not isinstance(value, torch.Tensor):
            kind = type(value).__name__
            raise ResultsError(f"{path}: weight {name!r} is {kind}, expected a named tensor")
        if not bool(torch.isfinite(value).all()):
            raise ResultsError(f"{path}: weight {name!r} holds values that are no numbers")
