"""Names in tables that tell policies of different trainings apart."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import replace
from pathlib import Path

from lcc_rl.config.compose import NOT_IDENTITY
from lcc_rl.config.nodes import as_plain
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.results.runs import POLICY, flatten
from lcc_rl.results.sweeps import labels

# Settings that do not distinguish trainings: those of other commands, and those of the seed.
OF_NO_TRAINING = tuple(
    f"{key}." for key in (*NOT_IDENTITY, "seed", "evaluation", "policy", "inputs.policy")
)
DATED = re.compile(r"^\d{4}-\d\d-\d\d_(\d\d-\d\d-\d\d)-\d{6}_.*")


def named_apart(strategies: Sequence[Strategy]) -> list[Strategy]:
    """Return strategies with names that differ if their trainings differ by more than the seed.

    If a variant was learned by several kinds of agents, the agent is added to the name. If settings
    differ otherwise, or a seed occurs twice, the file or folder of the policy is added. Several
    seeds of one training share a name, that of their folder. If one folder holds several trainings,
    the settings that differ are added.
    """
    kinds = [s.cfg.agent.name if s.policy else "" for s in strategies]
    by_agent = _where_several(strategies, kinds, kinds)
    marks = _trainings(by_agent)
    return _where_several(by_agent, marks, _labels(by_agent, marks))


def _where_several(
    strategies: Sequence[Strategy], marks: Sequence[Hashable], labels: Sequence[str]
) -> list[Strategy]:
    different = Counter(
        name for name, _ in {(s.name, m) for s, m in zip(strategies, marks, strict=True)}
    )
    return [
        replace(one, name=f"{one.name} {label}") if different[one.name] > 1 else one
        for one, label in zip(strategies, labels, strict=True)
    ]


def _trainings(strategies: Sequence[Strategy]) -> list[tuple[str, int]]:
    """Return settings, and number among equal seeds, by which policies of a name differ."""
    marks: list[tuple[str, int]] = []
    of_seed: Counter[Hashable] = Counter()
    for s in strategies:
        settings = dict(flatten(as_plain(s.own or s.cfg))) if s.policy else {}
        kept = {key: x for key, x in settings.items() if not f"{key}.".startswith(OF_NO_TRAINING)}
        text = json.dumps(kept, sort_keys=True, default=str)
        of_seed[s.name, text, s.seed] += 1
        marks.append((text, of_seed[s.name, text, s.seed] if s.policy else 0))
    return marks


def _labels(strategies: Sequence[Strategy], marks: Sequence[tuple[str, int]]) -> list[str]:
    """Return the addition to the name of each policy, the same for the seeds of a training."""
    groups = [(s.name, mark) for s, mark in zip(strategies, marks, strict=True)]
    titles: dict[tuple[str, tuple[str, int]], str] = {}
    for s, group in zip(strategies, groups, strict=True):
        titles.setdefault(group, _place(s, groups.count(group) > 1))
    apart = Counter((name, title) for (name, _), title in titles.items())
    differences: dict[tuple[str, str], str] = {}
    for name in {name for name, _ in groups}:
        texts = {
            text: Path(s.source)
            for s, (other, (text, _)) in zip(strategies, groups, strict=True)
            if other == name
        }
        every = labels([json.loads(text) for text in texts], list(texts.values()))
        for text, changes in zip(texts, every, strict=True):
            differences[name, text] = ", ".join(changes.values())
    additions = []
    for s, (name, (text, which)) in zip(strategies, groups, strict=True):
        title = titles[name, (text, which)]
        if apart[name, title] > 1:  # one folder holds several trainings, or one twice
            twice = (name, (text, 2)) in titles or not differences[name, text]
            title = _place(s, False) if twice else differences[name, text]
        additions.append(title)
    return additions


def _place(strategy: Strategy, of_sweep: bool) -> str:
    """Return the name of a policy's file or run, or of the folder of its runs."""
    path = Path(strategy.source).absolute()  # a relative path has a folder, too
    path = path.parent if path.name == POLICY else path
    name = path.parent.name if of_sweep else path.name.removesuffix(".pt")
    return DATED.sub(r"\1", name)  # of a run's folder, the time of day


def check_distinct(strategies: Sequence[Strategy]) -> None:
    """Refuse two policies of one name and seed.

    Raises:
        ConfigError: naming the variant and the seed.
    """
    counts = Counter((strategy.name, strategy.seed) for strategy in strategies)
    for name, seed in (key for key, count in counts.items() if count > 1):
        which = name if seed is None else f"{name} with training seed {seed}"
        raise ConfigError(
            f"policy and compare name two policies called {which}: give them different "
            "names, 'compare={first: …, second: …}'"
        )
