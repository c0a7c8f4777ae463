"""Names by which the rows of an evaluation's strategies are told apart."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.nodes import TARGET, short_name

POLICY = "policy.pt"


def named_apart(strategies: Sequence[Strategy]) -> list[Strategy]:
    """Name apart what was learned in different ways: rows of one name are those of its seeds.

    Of a variant that several kinds of agents have learned each gets its agent's name; where their
    settings differ otherwise, the name of the file or folder that a policy comes from.
    """
    kinds = [short_name(one.cfg.agent[TARGET]) if one.policy else "" for one in strategies]
    found = _where_several(strategies, kinds, kinds)
    return _where_several(found, [_settings(one) for one in found], [_place(one) for one in found])


def _where_several(
    strategies: Sequence[Strategy], marks: Sequence[str], labels: Sequence[str]
) -> list[Strategy]:
    """Add labels to the names of strategies that differ in a mark, and otherwise have one name."""
    different = Counter(
        name for name, _ in {(s.name, m) for s, m in zip(strategies, marks, strict=True)}
    )
    return [
        replace(one, name=f"{one.name} {label}") if different[one.name] > 1 else one
        for one, label in zip(strategies, labels, strict=True)
    ]


def _settings(strategy: Strategy) -> str:
    """Return what a policy was learned with, its seed aside."""
    if strategy.policy is None:
        return ""
    cfg = strategy.cfg
    return json.dumps([cfg.agent, cfg.scenario.filters], sort_keys=True)


def _place(strategy: Strategy) -> str:
    """Return the name of the file or folder that a policy comes from."""
    path = Path(strategy.source)
    return path.parent.name if path.name == POLICY else path.name.removesuffix(".pt")


def check_distinct(strategies: Sequence[Strategy]) -> None:
    """Refuse two policies that no row could tell apart.

    Raises:
        ConfigError: naming the variant and the seed.
    """
    counts = Counter((strategy.name, strategy.seed) for strategy in strategies)
    for name, seed in (key for key, count in counts.items() if count > 1):
        which = name if seed is None else f"{name} with training seed {seed}"
        raise ConfigError(
            f"policy and compare name two policies of variant {which}; their rows could not be "
            "told apart: evaluate them one after the other"
        )
