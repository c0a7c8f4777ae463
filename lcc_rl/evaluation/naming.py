"""Names by which the rows of an evaluation's strategies are told apart."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from lcc_rl.config import short_name
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.targets import TARGET


def named_apart(strategies: Sequence[Strategy]) -> list[Strategy]:
    """Add its agent to the name of a variant that more than one kind of agent has learned."""
    kinds = [short_name(one.cfg.agent[TARGET]) if one.policy else "" for one in strategies]
    named = [(strategy.name, kind) for strategy, kind in zip(strategies, kinds, strict=True)]
    learned_by = Counter(name for name, _ in set(named))
    return [
        replace(strategy, name=f"{name} {kind}") if learned_by[name] > 1 else strategy
        for strategy, (name, kind) in zip(strategies, named, strict=True)
    ]


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
