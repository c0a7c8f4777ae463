"""Strategies: policies and rules that drive the automated vehicles of an evaluation.

All strategies of an evaluation share the scenario under study: its drivers, energy model, noise
and pieces. They differ in the controller of the automated vehicles and in its observation.
"""

from __future__ import annotations

import json
import logging
import re
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.factory import build_agent
from lcc_rl.config import NOT_IDENTITY, load
from lcc_rl.config.nodes import Node, as_plain
from lcc_rl.config.schemas import StudyConfig
from lcc_rl.config.words import FILTERED, RECORDED
from lcc_rl.errors import ConfigError, ResultsError, raised_as, require
from lcc_rl.evaluation.fit import check_action, check_scenario, check_width
from lcc_rl.evaluation.named import (
    DIRECT,
    PEOPLE,
    controller_of,
    label_of,
)
from lcc_rl.evaluation.rollout import Policy
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, RING
from lcc_rl.pieces import Observation, Piece, TimeGapStart
from lcc_rl.pieces.controllers import Population
from lcc_rl.results.names import ON_FRONT, RULE_ROWS
from lcc_rl.results.runs import POLICY, flatten
from lcc_rl.results.sweeps import labels
from lcc_rl.settings import TARGET, path_of

log = logging.getLogger("lcc_rl")

# Settings that do not distinguish trainings: those of other commands, and those of the seed.
OF_NO_TRAINING = tuple(
    f"{key}." for key in (*NOT_IDENTITY, "seed", "evaluation", "policy", "inputs.policy")
)
DATED = re.compile(r"^\d{4}-\d\d-\d\d_(\d\d-\d\d-\d\d)-\d{6}_.*")
KNOWLEDGE = ("memory", "preview")  # pieces that belong to a policy's observation
TrainedPolicy = tuple[dict[str, Any], StudyConfig]  # weights and configuration


@dataclass(frozen=True)
class Strategy:
    """A controller of the automated vehicles, and its environment.

    Args:
        name: name in tables.
        cfg: configuration of its environment.
        policy: deterministic, writes ``("automated", "action")``; None for a rule.
        seed: training seed; None for a rule.
        source: file or folder that the policy was read from.
        own: configuration of the policy's training, if it is not ``cfg``.
    """

    name: str
    cfg: StudyConfig
    policy: Policy | None = None
    seed: int | None = None
    source: str = ""
    own: StudyConfig | None = None

    @property
    def title(self) -> str:
        """Name in messages."""
        return f"strategy {self.name}" + (f" (policy={self.source})" if self.source else "")


def deployed(cfg: StudyConfig) -> StudyConfig:
    """Return a configuration with the controller that is used after training."""
    return cfg if cfg.deployed is None else driven_by(cfg, cfg.deployed)


def driven_by(cfg: StudyConfig, controller: Node) -> StudyConfig:
    """Return a configuration with another controller of the automated vehicles."""
    return cfg.with_(deployed=None, scenario={"controllers": {AUTOMATED: controller}})


def baselines(cfg: StudyConfig, further: Mapping[str, Any] | None = None) -> list[Strategy]:
    """Build the baselines of an evaluation, and further controllers by name."""
    named = dict.fromkeys(cfg.evaluation.baselines) | dict(further or {})
    return [baseline(cfg, name, spec) for name, spec in named.items() if applies(cfg, name)]


def applies(cfg: StudyConfig, name: str) -> bool:
    """Return whether a string has the vehicles that a baseline drives."""
    roles = set(cfg.scenario.vehicles.names)
    if name == DIRECT:
        return bool(roles - {AUTOMATED})
    if name == RECORDED:
        return cfg.scenario.vehicles.places(AUTOMATED) == (0,) and cfg.scenario.road != RING
    return AUTOMATED in roles and (not name.endswith("oracle") or roles == {AUTOMATED})


def baseline(cfg: StudyConfig, name: str, spec: Any = None) -> Strategy:
    """Build a controller in the scenario and with the settings of the variant under study.

    Args:
        cfg: the configuration under study.
        name: its name in tables.
        spec: see :func:`lcc_rl.evaluation.named.controller_of`; by default the name. The
            controller drives behind the safety filter if this or the name ends in ``_filtered``.

    Raises:
        ConfigError: if the controller is unknown, or needs a safety filter that does not exist.
    """
    if name == DIRECT:
        return Strategy(name, without_automated(cfg))
    if name == PEOPLE:
        return Strategy(name, by_people(driven_by(cfg, cfg.scenario.controllers[HUMAN])))
    if name == RECORDED:
        cfg = by_people(driven_by(cfg, controller_of(name)))
        start = Node.of({TARGET: path_of(TimeGapStart)}, f"scenario.start.{AUTOMATED}")
        return Strategy(name, cfg.with_(scenario={"start": {AUTOMATED: start}}))
    kept = cfg.scenario.filters.get(AUTOMATED)
    named = any(str(word).endswith(FILTERED) for word in (name, spec))
    words = f"{name} needs the safety filter, but there is none (+filter=cbf adds one)"
    require(kept is not None or not named, words)
    held = kept is not None and kept.settings.get("time_gap", True) is not None
    controller = controller_of(spec or name, held)
    if named:
        return Strategy(name, driven_by(cfg, controller))
    if cfg.variant == name and _kind(cfg) is controller.kind:
        return Strategy(name, cfg)
    alone = driven_by(cfg, controller).with_(scenario={"filters": {AUTOMATED: None}})
    return Strategy(name, alone)


def beside_filtered(cfg: StudyConfig, strategies: Sequence[Strategy]) -> list[Strategy]:
    """Build the baselines with which a filtered policy is compared, behind its filter."""
    filters = (one.cfg.scenario.filters.get(AUTOMATED) for one in strategies if one.policy)
    own = next((node for node in filters if node is not None), None)
    if own is None:
        return []
    names = {one.name for one in strategies}
    cfg = cfg.with_(scenario={"filters": {AUTOMATED: own}})
    return [baseline(cfg, name) for name in cfg.evaluation.behind_filter if name not in names]


def front_of(strategies: Sequence[Strategy], time_gaps: Sequence[float]) -> list[Strategy]:
    """Build policies and the tuned rule behind filters with other longest time gaps [s].

    These are the points at which :func:`lcc_rl.results.fronts.at_equal_flow` compares.

    Raises:
        ConfigError: if there is no safety filter.
    """
    behind = [one for one in strategies if one.cfg.scenario.filters.get(AUTOMATED) is not None]
    require(
        behind or not time_gaps, "evaluation.front needs the safety filter (+filter=cbf adds one)"
    )
    rule = next((name for name in RULE_ROWS if name in {one.name for one in behind}), None)
    found = []
    for one in behind:
        for time_gap in time_gaps if one.policy is not None or one.name == rule else ():
            other = one.cfg.scenario.filters[AUTOMATED].changed(time_gap=time_gap)
            cfg = one.cfg.with_(scenario={"filters": {AUTOMATED: other}})
            found.append(replace(one, name=f"{one.name}{ON_FRONT}{time_gap:g}", cfg=cfg))
    return found


def by_people(cfg: StudyConfig) -> StudyConfig:
    """Return a configuration without filter, actuators and sensors of the automated vehicles."""
    groups = ("filters", "actuators", "sensors")
    return cfg.with_(scenario={group: {AUTOMATED: None} for group in groups})


def without_automated(cfg: StudyConfig) -> StudyConfig:
    """Return a configuration without automated vehicles."""
    roles = [role for role in cfg.scenario.vehicles.roles if role != AUTOMATED]
    return cfg.with_(scenario={"string": " ".join(roles)})


def rule(cfg: StudyConfig) -> Strategy:
    """Return the strategy of a configuration without an agent.

    Its name is that of the variant, or of the controller's class if it is not the variant's.
    """
    if not cfg.scenario.vehicles.count(AUTOMATED):
        return Strategy(DIRECT, cfg)
    try:
        own = _kind(load("evaluate", [f"variant={cfg.variant}"]))
    except ConfigError:  # a user's variant that only this command line defines
        own = _kind(cfg)
    name = cfg.variant if _kind(cfg) is own else label_of(cfg.scenario.controllers[AUTOMATED])
    return Strategy(name, deployed(cfg))


def _kind(cfg: StudyConfig) -> Any:
    return cfg.scenario.controllers[AUTOMATED].kind


def _baseline_controllers(cfg: StudyConfig) -> list[Any]:
    automated = (one for one in baselines(cfg) if one.name != DIRECT)
    return [one.cfg.scenario.controllers[AUTOMATED] for one in automated]


def no_policy(cfg: StudyConfig) -> ConfigError:
    """Return the error for a learned variant without a policy."""
    return ConfigError(
        f"variant {cfg.variant} is learned: give policy=<run folder or policy.pt> "
        f"(of lcc-rl train variant={cfg.variant}) or policy=pretrained, or compare others only: "
        "compare=[human]"
    )


def studied(
    cfg: StudyConfig, policy: TrainedPolicy | None, population: Population
) -> list[Strategy]:
    """Build the strategy under study; for a hybrid, its parents and its oracle, too.

    Args:
        cfg: configuration of the entry point ``evaluate``.
        policy: the policy read from ``cfg.policy``, if there is one.
        population: the human drivers.

    Raises:
        ConfigError: if the variant needs a policy that is not given.
    """
    if not cfg.learns:
        strategy = rule(cfg)
        known = cfg.scenario.controllers[AUTOMATED] in _baseline_controllers(cfg)
        same = known and cfg.scenario.filters.get(AUTOMATED) is None and strategy.name != DIRECT
        named = strategy.name in cfg.evaluation.baselines
        return [] if same or named else [strategy]
    if policy is None:
        raise no_policy(cfg)
    weights, own_cfg = policy
    cfg = _of_training(cfg, own_cfg)
    strategy = with_weights(cfg, weights, own_cfg.seed, str(cfg.policy), population)
    strategy = replace(strategy, own=own_cfg)
    return [strategy] if cfg.deployed is None else hybrids(strategy)


def _of_training(cfg: StudyConfig, own: StudyConfig) -> StudyConfig:
    """Return the scenario under study with the agent of ``own``, and its filter if it has none."""
    changes: dict[str, Any] = {"agent": own.agent}
    seen = own.observation.made(Piece)
    if isinstance(seen, Observation) and seen.shows_presence(own.scenario.vehicles):
        changes["observation"] = cfg.observation.changed(presence=True)
    if cfg.scenario.filters.get(AUTOMATED) is None and own.scenario.filters.get(AUTOMATED):
        log.info("the policy of variant %s keeps the filter of its training", own.variant)
        changes["scenario"] = {"filters": {AUTOMATED: own.scenario.filters[AUTOMATED]}}
    return cfg.with_(**changes)


def hybrids(strategy: Strategy) -> list[Strategy]:
    """Build a hybrid strategy, its parents and its oracle."""
    cfg = strategy.cfg
    parent = driven_by(cfg, cfg.scenario.controllers[AUTOMATED])
    found = [replace(strategy, name=cfg.agent.name, cfg=parent)]
    parent_rule = cfg.deployed.settings.get("rule")
    if parent_rule is not None and parent_rule not in _baseline_controllers(cfg):
        found.insert(0, Strategy("cacc", driven_by(cfg, parent_rule)))
    found.append(replace(strategy, cfg=deployed(cfg)))
    if set(cfg.scenario.vehicles.names) == {AUTOMATED}:
        knowing = driven_by(cfg, cfg.deployed.changed(lookahead="oracle"))
        found.append(replace(strategy, name=f"{strategy.name} oracle", cfg=knowing))
    return found


def trained(cfg: StudyConfig, path: str, policy: TrainedPolicy, population: Population) -> Strategy:
    """Build a trained strategy in the scenario under study.

    Args:
        cfg: the configuration under study.
        path: origin of the policy, for messages.
        policy: its weights and configuration.
        population: the human drivers.

    Raises:
        LccError: if the policy does not fit the scenario or its own network.
    """
    weights, own = policy
    check_scenario(path, own, cfg)
    other = _of_training(cfg.with_(observation=own.observation), own)
    pieces = {
        name: node
        for name, node in own.scenario.pieces.items()
        if name in KNOWLEDGE or name not in other.scenario.pieces
    }
    driver = {AUTOMATED: own.scenario.controllers[AUTOMATED]}
    other = other.with_(
        variant=own.variant,
        deployed=own.deployed,
        scenario={"controllers": driver, "pieces": pieces},
    )
    check_action(path, own, other)
    strategy = with_weights(other, weights, own.seed, path, population)
    return replace(strategy, cfg=deployed(other), own=own)


def with_weights(
    cfg: StudyConfig, weights: Mapping[str, Any], seed: int, path: str, population: Population
) -> Strategy:
    """Build a strategy and load its policy's weights.

    Raises:
        ResultsError: if the agent cannot be built, or the weights do not fit its network.
    """
    with raised_as(ResultsError, f"{path}: its agent cannot be built", ConfigError):
        agent = build_agent(cfg, population, cfg.device)
    check_width(agent.policy, weights, path)
    words = f"{path}: the weights do not fit the policy network"
    with raised_as(ResultsError, words, RuntimeError):
        agent.policy.load_state_dict(dict(weights))
    return Strategy(cfg.variant, cfg, shared_policy(agent.policy), seed, path)


def named_apart(strategies: Sequence[Strategy]) -> list[Strategy]:
    """Return strategies with names that differ if their trainings differ by more than the seed.

    If a variant was learned by several kinds of agents, the agent is added to the name. If settings
    differ otherwise, or a seed occurs twice, the file or folder of the policy is added. Several
    seeds of one training share a name, that of their folder. If one folder holds several trainings,
    the settings that differ are added.
    """
    kinds = [one.cfg.agent.name if one.policy else "" for one in strategies]
    found = _where_several(strategies, kinds, kinds)
    marks = _trainings(found)
    return _where_several(found, marks, _labels(found, marks))


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
    found: list[tuple[str, int]] = []
    of_seed: Counter[Hashable] = Counter()
    for one in strategies:
        settings = dict(flatten(as_plain(one.own or one.cfg))) if one.policy else {}
        kept = {key: x for key, x in settings.items() if not f"{key}.".startswith(OF_NO_TRAINING)}
        text = json.dumps(kept, sort_keys=True, default=str)
        of_seed[one.name, text, one.seed] += 1
        found.append((text, of_seed[one.name, text, one.seed] if one.policy else 0))
    return found


def _labels(strategies: Sequence[Strategy], marks: Sequence[tuple[str, int]]) -> list[str]:
    """Return the addition to the name of each policy, the same for the seeds of a training."""
    groups = [(one.name, mark) for one, mark in zip(strategies, marks, strict=True)]
    places: dict[tuple[str, tuple[str, int]], str] = {}
    for one, group in zip(strategies, groups, strict=True):
        places.setdefault(group, _place(one, groups.count(group) > 1))
    apart = Counter((name, place) for (name, _), place in places.items())
    differences: dict[tuple[str, str], str] = {}
    for name in {name for name, _ in groups}:
        texts = {
            text: Path(one.source)
            for one, (own, (text, _)) in zip(strategies, groups, strict=True)
            if own == name
        }
        every = labels([json.loads(text) for text in texts], list(texts.values()))
        for text, words in zip(texts, every, strict=True):
            differences[name, text] = ", ".join(words.values())
    found = []
    for one, (name, (text, which)) in zip(strategies, groups, strict=True):
        place = places[name, (text, which)]
        if apart[name, place] > 1:  # one folder holds several trainings, or one twice
            twice = (name, (text, 2)) in places or not differences[name, text]
            place = _place(one, False) if twice else differences[name, text]
        found.append(place)
    return found


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
