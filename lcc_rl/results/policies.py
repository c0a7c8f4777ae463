"""Policy files: weights and the configuration of their training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import AfterValidator, Field

from lcc_rl.assets import ASSETS
from lcc_rl.config.schemas import StudyConfig, as_text
from lcc_rl.errors import ConfigError, ResultsError, raised_as
from lcc_rl.io.settings import parse_yaml
from lcc_rl.io.tensors import check_like, read_torch, write_torch
from lcc_rl.results.runs import POLICY
from lcc_rl.results.trust import trusted
from lcc_rl.runs.states import CHECKPOINT, CONFIG, no_run, run_folders
from lcc_rl.settings import S, Settings, parse

PRETRAINED = "pretrained"
SHIPPED_POLICIES = ASSETS / PRETRAINED
# Variants that use the policy of another one.
BUILDS_ON = {"hcfs": "ddpg"}


def read_checked(path: str | Path, kind: type[S], what: str) -> S:
    """Read a possibly foreign file of tensors as a typed model.

    Args:
        path, kind: the file and the model.
        what: name of the expected kind of file, for the message.

    Raises:
        ResultsError: as :func:`read_torch`, or naming the first wrong entry.
    """
    content = read_torch(path)
    if not isinstance(content, dict):
        raise ResultsError(f"{path}: not a {what}: it holds {type(content).__name__}")
    with raised_as(ResultsError, f"{path}: not a {what}", ConfigError):
        return parse(kind, {str(key): value for key, value in content.items()}, "")


def check_weights(weights: dict[str, Any]) -> dict[str, Any]:
    """Check that weights are finite tensors in single precision by name."""
    for name, value in weights.items():
        if not isinstance(value, torch.Tensor) or value.dtype != torch.float32:
            kind = getattr(value, "dtype", type(value).__name__)
            raise ValueError(f"{name!r} is {kind}, expected a tensor of torch.float32")
    check_like(weights, weights, "weights")
    return weights


class PolicyFile(Settings):
    """Contents of a policy file."""

    weights: Annotated[dict[str, Any], Field(min_length=1), AfterValidator(check_weights)]
    config: str  # configuration of its training, YAML
    provenance: Any = None  # provenance of a shipped policy


def save_policy(weights: Mapping[str, Any], cfg: StudyConfig, path: Path) -> None:
    """Write a policy's weights and the configuration of its training as text."""
    # Copies: parts of one vector would be stored with the whole vector.
    copies = {name: weight.clone() for name, weight in weights.items()}
    write_torch({"weights": copies, "config": as_text(cfg)}, path)


def of_task(path: str, task: str | None) -> str:
    """Return the shipped policy of a task for ``"pretrained"`` if there is one, else the path."""
    if path == PRETRAINED and task is not None and (SHIPPED_POLICIES / f"{task}.pt").is_file():
        return f"{PRETRAINED}/{task}"
    return path


def pretrained_path(variant: str) -> Path:
    """Return the shipped policy of a variant.

    Raises:
        ConfigError: if there is none.
    """
    path = SHIPPED_POLICIES / f"{BUILDS_ON.get(variant, variant)}.pt"
    if not path.is_file():
        names = sorted(file.stem for file in SHIPPED_POLICIES.glob("*.pt"))
        raise ConfigError(
            f"no pretrained policy ships for {variant}, only for {', '.join(names)}; train one "
            "(lcc-rl train) and give its folder"
        )
    return path


def policy_file(path: str | Path, variant: str = "") -> Path:
    """Return the file that :func:`load_policy` reads.

    Raises:
        ConfigError: if no policy ships for the variant, or a training has not ended.
    """
    path = Path(path)
    first = path.parts[0] if path.parts else ""
    if first != PRETRAINED and not path.exists() and get_close_matches(first, [PRETRAINED]):
        raise ConfigError(f"policy={path}: no such file; did you mean {PRETRAINED!r}?")
    if first == PRETRAINED and not path.exists():
        path = pretrained_path(path.name if len(path.parts) > 1 else variant)
    file = path / POLICY if path.is_dir() else path
    if not file.exists() and (path / CHECKPOINT).is_file():
        raise ConfigError(f"{path}: its training has not ended: lcc-rl train resume={path}")
    if path.is_dir() and not (file.exists() or (path / CONFIG).is_file()) and run_folders(path):
        raise no_run(path)
    if path.suffix == ".onnx":
        raise ConfigError(f"{path} is an ONNX program, a controller: name it in compare=[{path}]")
    return file


def load_policy(
    path: str | Path, variant: str = "", trust: Sequence[str] = ()
) -> tuple[dict[str, Any], StudyConfig]:
    """Read a policy file without running code from it.

    Args:
        path: the file or a run folder; ``"pretrained"`` for the shipped policy of ``variant``,
            ``"pretrained/reference"`` for that of another one.
        variant: name of a variant.
        trust: modules outside this package that the policy may name.

    Returns:
        The weights and the configuration.

    Raises:
        ConfigError: if no policy ships for the variant.
        ResultsError: if the file is missing, damaged or no policy.
    """
    path = policy_file(path, variant)
    content = read_checked(path, PolicyFile, "policy")
    cfg, _ = trusted(parse_yaml(content.config, f"{path} (config)"), str(path), trust)
    if not isinstance(cfg, StudyConfig) or cfg.agent is None:
        raise ResultsError(f"{path}: not the configuration of a training: it has no agent")
    return content.weights, cfg
