"""Whether a trained policy fits the variant and the observation under study."""

from __future__ import annotations

from omegaconf import DictConfig

from lcc_rl.config import plain
from lcc_rl.errors import ConfigError
from lcc_rl.results.runs import differing, flatten


def check_policy(cfg: DictConfig, own: DictConfig) -> None:
    """Check that a policy was trained for the variant and the observation under study.

    Raises:
        ConfigError: naming what differs.
    """
    hybrid = cfg.deployed is not None or own.get("deployed") is not None
    if own.variant != cfg.variant and not hybrid:
        raise ConfigError(
            f"policy={cfg.policy} was trained as variant {own.variant}, not {cfg.variant}; "
            f"say variant={own.variant}"
        )
    trained_with, observed = (
        dict(flatten(plain(node))) for node in (own.observation, cfg.observation)
    )
    changes = [
        f"observation.{key}: {trained_with.get(key)}, got {observed.get(key)}"
        for key in differing(trained_with, observed)
    ]
    if changes:
        raise ConfigError(
            f"policy={cfg.policy} was trained with another observation than this: expected "
            f"{'; '.join(changes)}; say +knowledge=… and observation.… as in its training"
        )
    remembered, asked = (node.scenario.pieces.get("memory") for node in (own, cfg))
    if remembered != asked:
        raise ConfigError(
            f"policy={cfg.policy} was trained with another memory than this: "
            f"expected scenario.pieces.memory={remembered}, got {asked}"
        )
