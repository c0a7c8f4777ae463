"""Strategies: policies and rules that drive the automated vehicles of an evaluation.

All strategies of an evaluation share the scenario under study: its drivers, energy model, noise
and pieces. They differ in the controller of the automated vehicles and in its observation.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import pandas as pd

from lcc_rl.config import load
from lcc_rl.config.compose import choices
from lcc_rl.config.nodes import Node
from lcc_rl.config.schemas import StudyConfig
from lcc_rl.config.unused import EXACT
from lcc_rl.config.words import FILTERED, RECORDED
from lcc_rl.errors import ConfigError, ResultsError, raised_as, require
from lcc_rl.evaluation.fit import (
    check_action,
    check_scenario,
    check_width,
    conditions_of,
    of_observation,
)
from lcc_rl.evaluation.named import DIRECT, PEOPLE, controller_of, label_of
from lcc_rl.evaluation.rollout import Policy
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, RING
from lcc_rl.pieces import CACC, HCFS, Hybrid, Observation, Piece, TimeGapStart
from lcc_rl.pieces.controllers import Population
from lcc_rl.results.names import ON_FRONT, RULE_ROWS
from lcc_rl.settings import TARGET, path_of

log = logging.getLogger("lcc_rl")

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

    def labels(self, rows: int) -> dict[str, Any]:
        """Return the columns that name it in so many rows of a table."""
        return {"strategy": self.name, "training_seed": pd.array([self.seed] * rows, dtype="Int64")}


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
        first = cfg.scenario.vehicles.places(AUTOMATED) == (0,)
        return first and cfg.scenario.road != RING and not cfg.scenario.replaced
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
        return Strategy(name, cfg.without_automated())
    if name == PEOPLE:
        return Strategy(name, cfg.driven_by(cfg.scenario.controllers[HUMAN]).without_equipment())
    if name == RECORDED:
        cfg = cfg.driven_by(controller_of(name)).without_equipment()
        start = Node.of({TARGET: path_of(TimeGapStart)}, f"scenario.start.{AUTOMATED}")
        return Strategy(name, cfg.with_(scenario={"start": {AUTOMATED: start}}))
    safety = cfg.scenario.filters.get(AUTOMATED)
    named = any(str(word).endswith(FILTERED) for word in (name, spec))
    message = f"{name} needs the safety filter, but there is none (+filter=cbf adds one)"
    require(safety is not None or not named, message)
    behind = safety is not None and safety.settings.get("time_gap", True) is not None
    controller = controller_of(spec or name, behind)
    if named:
        return Strategy(name, cfg.driven_by(controller))
    if cfg.variant == name and _kind(cfg) is controller.kind:
        return Strategy(name, cfg)
    alone = cfg.driven_by(controller).with_(scenario={"filters": {AUTOMATED: None}})
    return Strategy(name, alone)


def beside_filtered(cfg: StudyConfig, strategies: Sequence[Strategy]) -> list[Strategy]:
    """Build the baselines with which a filtered policy is compared, behind its filter."""
    filters = (s.cfg.scenario.filters.get(AUTOMATED) for s in strategies if s.policy)
    safety = next((node for node in filters if node is not None), None)
    if safety is None:
        return []
    names = {s.name for s in strategies}
    cfg = cfg.with_(scenario={"filters": {AUTOMATED: safety}})
    return [baseline(cfg, name) for name in cfg.evaluation.behind_filter if name not in names]


def with_safety(strategies: Sequence[Strategy], safety: Mapping[str, Any]) -> list[Strategy]:
    """Return strategies with changed settings of their safety filters.

    Raises:
        ConfigError: if there is no safety filter, or a setting is unknown or wrong.
    """
    if not safety:
        return [*strategies]
    nodes = [s.cfg.scenario.filters.get(AUTOMATED) for s in strategies]
    require(any(nodes), f"safety.{next(iter(safety))} has no effect: no row has a safety filter")
    exact = all(s.cfg.scenario.is_exact(AUTOMATED) for s in strategies)
    require(not exact or "robust" not in safety, f"safety.robust has no effect: {EXACT}")
    others = [{"filters": {AUTOMATED: node and node.changed(**safety)}} for node in nodes]
    pairs = zip(strategies, others, strict=True)
    return [replace(s, cfg=s.cfg.with_(scenario=other)) for s, other in pairs]


def front_of(strategies: Sequence[Strategy], time_gaps: Sequence[float]) -> list[Strategy]:
    """Build policies and the tuned rule behind filters with other longest time gaps [s].

    These are the points at which :func:`lcc_rl.results.fronts.at_equal_flow` compares.

    Raises:
        ConfigError: if there is no safety filter.
    """
    behind = [s for s in strategies if s.cfg.scenario.filters.get(AUTOMATED) is not None]
    require(
        behind or not time_gaps, "evaluation.front needs the safety filter (+filter=cbf adds one)"
    )
    rule = next((name for name in RULE_ROWS if name in {s.name for s in behind}), None)
    front = []
    for s in behind:
        for time_gap in time_gaps if s.policy is not None or s.name == rule else ():
            other = s.cfg.scenario.filters[AUTOMATED].changed(time_gap=time_gap)
            cfg = s.cfg.with_(scenario={"filters": {AUTOMATED: other}})
            front.append(replace(s, name=f"{s.name}{ON_FRONT}{time_gap:g}", cfg=cfg))
    return front


def rule(cfg: StudyConfig) -> Strategy:
    """Return the strategy of a configuration without an agent."""
    if not cfg.automated:
        return Strategy(DIRECT, cfg)
    return Strategy(name_of(cfg), cfg.after_training())


def name_of(cfg: StudyConfig) -> str:
    """Return the name of what drives after training: the variant, or another class or agent."""
    if cfg.deployed is not None:
        cfg.deployed.made(Hybrid)
    elif cfg.learns:
        return str(cfg.agent.name if cfg.variant in choices("agent") else cfg.variant)
    cfg = cfg.after_training()
    try:
        kind = _kind(load("evaluate", [f"variant={cfg.variant}"]).after_training())
    except ConfigError:  # a user's variant that only this command line defines
        kind = _kind(cfg)
    return cfg.variant if _kind(cfg) is kind else label_of(cfg.scenario.controllers[AUTOMATED])


def _kind(cfg: StudyConfig) -> Any:
    return cfg.scenario.controllers[AUTOMATED].kind


def _baseline_controllers(cfg: StudyConfig) -> list[Any]:
    automated = (s for s in baselines(cfg) if s.name != DIRECT)
    return [s.cfg.scenario.controllers[AUTOMATED] for s in automated]


def studied(
    cfg: StudyConfig, policy: TrainedPolicy | None, population: Population
) -> list[Strategy]:
    """Build the strategy under study; for a hybrid, its parents and oracle, too.

    Args:
        cfg: configuration of the entry point ``evaluate``.
        policy: the policy read from ``cfg.policy``, if there is one.
        population: the human drivers.
    """
    if policy is None:
        strategy = rule(cfg)
        listed = cfg.scenario.controllers[AUTOMATED] in _baseline_controllers(cfg)
        repeats = listed and cfg.scenario.filters.get(AUTOMATED) is None and strategy.name != DIRECT
        named = strategy.name in cfg.evaluation.baselines
        return [] if repeats or named else [strategy]
    weights, own_cfg = policy
    cfg = _of_training(cfg, own_cfg, f"policy={cfg.policy}")
    kept = {x: own_cfg.scenario.pieces[x] for x in sorted(of_observation(own_cfg))}
    _under_conditions(
        f"policy={cfg.policy}", kept, cfg.scenario.pieces
    )  # differ in conditions at most
    strategy = with_weights(cfg, weights, own_cfg.seed, str(cfg.policy), population)
    strategy = replace(strategy, own=own_cfg)
    return [strategy] if cfg.deployed is None else hybrids(strategy)


def _of_training(cfg: StudyConfig, own: StudyConfig, path: str) -> StudyConfig:
    """Return the scenario under study with the agent of ``own``, and its filter if it has none."""
    changes: dict[str, Any] = {"agent": own.agent}
    piece = own.observation.made(Piece)
    if isinstance(piece, Observation):
        if piece.shows_presence(own.scenario.vehicles):
            changes["observation"] = cfg.observation.changed(presence=True)
        elif piece.shows_presence(cfg.scenario.vehicles):
            hint = "a vehicle behind each automated one: scenario.string needs one, too, as in"
            raise ConfigError(f"{path} was trained with {hint} 'automated human'")
    given, trained = (one.scenario.filters.get(AUTOMATED) for one in (cfg, own))
    if given is None and trained is not None:
        log.info("the policy of variant %s keeps the filter of its training", own.variant)
        changes["scenario"] = {"filters": {AUTOMATED: trained}}
    elif given is not None and trained is not None:
        _replaced(path, "filter", trained, given, trained.settings)
    return cfg.with_(**changes)


def _replaced(
    path: str, what: str, trained: Node, given: Node, names: Iterable[str]
) -> dict[str, Any]:
    """Return the settings of a command that replace a policy's own, and warn of them."""
    new = {key: given.settings.get(key) for key in names}
    changed = {key: x for key, x in new.items() if x != trained.settings.get(key)}
    other = [f"{key}={x} in place of {trained.settings.get(key)}" for key, x in changed.items()]
    text = "%s: the %s of this command replaces that of the policy's training: %s"
    if other:
        log.warning(text, path, what, ", ".join(other))
    return changed


def _under_conditions(
    path: str, own: Mapping[str, Node], given: Mapping[str, Node | None]
) -> dict[str, Node]:
    """Return the pieces that a policy observes, under the conditions of a command."""
    pieces = dict(own)
    for name, piece in own.items():
        if (asked := given.get(name)) and asked.kind is piece.kind:
            changed = _replaced(path, name, piece, asked, conditions_of(piece))
            pieces[name] = piece.changed(**changed)
    return pieces


def hybrids(strategy: Strategy) -> list[Strategy]:
    """Build a hybrid strategy and its parents; for HCFS, its oracle, too."""
    cfg = strategy.cfg
    parent = cfg.driven_by(cfg.scenario.controllers[AUTOMATED])
    strategies = [replace(strategy, name=cfg.agent.name, cfg=parent)]
    parent_rule = cfg.deployed.settings.get("rule")
    if parent_rule is not None and parent_rule not in _baseline_controllers(cfg):
        name = "cacc" if parent_rule.kind is CACC else label_of(parent_rule)
        strategies.insert(0, Strategy(name, cfg.driven_by(parent_rule)))
    strategies.append(replace(strategy, cfg=cfg.after_training()))
    if issubclass(cfg.deployed.kind, HCFS) and set(cfg.scenario.vehicles.names) == {AUTOMATED}:
        knowing = cfg.driven_by(cfg.deployed.changed(lookahead="oracle"))
        strategies.append(replace(strategy, name=f"{strategy.name} oracle", cfg=knowing))
    return strategies


def trained(cfg: StudyConfig, path: str, policy: TrainedPolicy, population: Population) -> Strategy:
    """Build a trained strategy in the scenario under study.

    Raises:
        LccError: if the policy does not fit the scenario or its own network.
    """
    weights, training = policy
    check_scenario(path, training, cfg)
    other = _of_training(cfg.with_(observation=training.observation), training, path)
    own, given = training.scenario.pieces, other.scenario.pieces
    kept = {x: own[x] for x in sorted(of_observation(training))}
    pieces = {x: own[x] for x in own if x in kept or x not in given}
    pieces |= _under_conditions(path, kept, given)
    driver = {AUTOMATED: training.scenario.controllers[AUTOMATED]}
    other = other.with_(
        variant=training.variant,
        deployed=training.deployed,
        scenario={"controllers": driver, "pieces": pieces},
    )
    check_action(path, training, other)
    strategy = with_weights(other, weights, training.seed, path, population)
    return replace(strategy, cfg=other.after_training(), own=training)


def with_weights(
    cfg: StudyConfig, weights: Mapping[str, Any], seed: int, path: str, population: Population
) -> Strategy:
    """Build a strategy and load its policy's weights.

    Raises:
        ResultsError: if the agent cannot be built, or the weights do not fit its network.
    """
    # Here, since a simulation of rules needs no agents.
    from lcc_rl.agents.actor import shared_policy
    from lcc_rl.agents.factory import build_agent

    with raised_as(ResultsError, f"{path}: its agent cannot be built", ConfigError):
        agent = build_agent(cfg, population, cfg.device)
    check_width(agent.policy, weights, path)
    message = f"{path}: the weights do not fit the policy network"
    with raised_as(ResultsError, message, RuntimeError):
        agent.policy.load_state_dict(dict(weights))
    return Strategy(name_of(cfg), cfg, shared_policy(agent.policy), seed, path)
