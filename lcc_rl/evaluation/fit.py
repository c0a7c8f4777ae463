"""Whether a trained policy fits the variant and the observation under study."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict.nn import TensorDictModule

from lcc_rl.errors import ConfigError
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.results.runs import differing, flatten
from lcc_rl.schemas import AUTO, StudyConfig


def check_policy(cfg: StudyConfig, own: StudyConfig) -> None:
    """Check that a policy was trained for the variant and the observation under study.

    Raises:
        ConfigError: naming what differs.
    """
    hybrid = cfg.deployed is not None or own.deployed is not None
    if own.variant != cfg.variant and not hybrid:
        raise ConfigError(
            f"policy={cfg.policy} was trained as variant {own.variant}, not {cfg.variant}; "
            f"say variant={own.variant}"
        )
    trained_with, observed = (dict(flatten(node)) for node in (own.observation, cfg.observation))
    changes = [
        f"observation.{key}: {trained_with.get(key)}, got {observed.get(key)}"
        for key in differing(trained_with, observed)
    ]
    if changes:
        raise ConfigError(
            f"policy={cfg.policy} was trained with another observation than this: expected "
            f"{'; '.join(changes)}; say +knowledge=… and observation.… as in its training"
        )
    # Entries are observed in the order of their scales.
    orders = [
        [key for key in node if key.startswith("scales.")] for node in (trained_with, observed)
    ]
    if orders[0] != orders[1]:
        raise ConfigError(
            f"policy={cfg.policy} was trained with another order of observation.scales: expected "
            f"{', '.join(orders[0])}, got {', '.join(orders[1])}"
        )
    check_action(str(cfg.policy), own, cfg)
    remembered, asked = (node.scenario.pieces.get("memory") for node in (own, cfg))
    if remembered != asked:
        raise ConfigError(
            f"policy={cfg.policy} was trained with another memory than this: "
            f"expected scenario.pieces.memory={remembered}, got {asked}"
        )


def check_scenario(path: str, own: StudyConfig, cfg: StudyConfig) -> None:
    """Check that a policy to compare with was trained in the scenario under study.

    Raises:
        ConfigError: naming both.
    """
    if own.scenario.name != cfg.scenario.name:
        raise ConfigError(
            f"compare: {path} was trained as variant {own.variant}, in the scenario "
            f"{own.scenario.name}, not in {cfg.scenario.name}"
        )


def check_action(path: str, own: StudyConfig, cfg: StudyConfig) -> None:
    """Check that an action means what it did in training: how much, and for how long.

    Args:
        path: where the policy comes from, for the message.
        own: configuration of its training.
        cfg: configuration under study.

    Raises:
        ConfigError: naming what differs.
    """
    trained_with, asked = (
        {"scenario.time_step": node.scenario.time_step}
        | dict(flatten({AUTO: node.scenario.controllers[AUTOMATED]}))
        for node in (own, cfg)
    )
    changes = [
        f"{key}={trained_with.get(key)}, got {asked.get(key)}"
        for key in differing(trained_with, asked)
    ]
    if changes:
        raise ConfigError(
            f"policy={path}: its action means something else here: it was trained with "
            f"{'; '.join(changes)}"
        )


def check_width(policy: TensorDictModule, weights: Mapping[str, Any], path: str) -> None:
    """Check that a trained network observes as many entries as one of this string.

    Raises:
        ConfigError: naming both numbers.
    """
    first = "module.0.0.weight"
    trained_with, observed = (state.get(first) for state in (weights, policy.state_dict()))
    if trained_with is None or observed is None or trained_with.shape[1] == observed.shape[1]:
        return
    raise ConfigError(
        f"policy={path} was trained with {trained_with.shape[1]} observed entries, in this "
        f"scenario.string an automated vehicle has {observed.shape[1]}: where one may have nobody "
        "behind it, one entry more per vehicle seen says so"
    )
