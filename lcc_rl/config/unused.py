"""Refuses options without effect that would change a result."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from typing import Any

from lcc_rl.config.nodes import nodes_in, takes_action
from lcc_rl.config.schemas import BaseConfig, StudyConfig, TrainConfig
from lcc_rl.config.words import RECORDED, key_of, typed_keys
from lcc_rl.errors import ConfigError, is_ours
from lcc_rl.functional.pattern import AUTOMATED, RING
from lcc_rl.settings import TARGET

NO_AGENT = ("agent=none", "agent=null")
BASELINES = "evaluation.baselines"
OF_COMPARISONS = (BASELINES, "evaluation.behind_filter", "evaluation.front")
# Settings of evaluation.rows=episodes; the first three are refused in sweeps, too.
OF_EPISODES = (
    *("repeats", "shards", "shard", "drivers", "batch_size", "sample_episodes", "compiled"),
    *("humans_first", "second_energy", "terms"),
)
OBSERVATION = "lcc_rl.pieces.Observation"
# Options that add the pieces of a role; an event also replaces leaders.
OPTIONS_OF = {"filters": ("filter",), "actuators": ("faults",), "sensors": ("faults", "event")}
EXACT = "actuators and sensors are exact; +faults=all adds others"
FIXED = "no vehicle of this platoon depends on drivers or noise"


def check_used(
    cfg: BaseConfig, overrides: Sequence[str], sweep: bool = False, written: Any = None
) -> None:
    """Refuse options that the configuration would ignore.

    Args:
        cfg, overrides: the typed tree, and the overrides of the command line.
        sweep: allow settings of an agent without one, because the runs of a sweep share them.
        written: the configuration as plain containers with its references.

    Raises:
        ConfigError: naming the option and the reason.
    """
    if not isinstance(cfg, StudyConfig):
        return
    reasons = dict(_of_road(cfg)) | dict(_of_rows(cfg, sweep))
    if not sweep:
        reasons |= dict(_of_roles(cfg)) | dict(_of_agent(cfg))
        if written is not None:
            reasons = dict(_of_references(written, overrides)) | reasons
        observation = cfg.observation.settings
        if observation[TARGET] == OBSERVATION and "behind" not in (observation.get("scales") or ()):
            for key in ("visible", "presence"):
                reasons[f"observation.{key}"] = "observation.scales names no vehicle behind"
        if type(cfg) is TrainConfig:
            compares = "a training evaluates its own policy; lcc-rl evaluate compares"
            reasons |= dict(_of_traffic(cfg.scenario))
            reasons |= dict.fromkeys({*OF_COMPARISONS} & {*map(key_of, overrides)}, compares)
            if RECORDED in cfg.evaluation.baselines:
                reasons.pop(BASELINES, None)
            if cfg.is_fixed() and of_package([cfg.observation, cfg.reward, cfg.agent]):
                reasons |= dict.fromkeys(("drivers", "evaluation.seed"), FIXED)
        reasons["sweep"] = "it names the folder of a sweep, -m"
    if written is not None and cfg.agent is not None and "surrogates" in cfg.agent.settings:
        typed = set().union(*map(typed_keys, overrides))
        reasons |= dict(_of_objective(cfg, written["agent"], typed))
    refuse((option for option in overrides if option not in NO_AGENT), reasons)


def refuse(overrides: Iterable[str], reasons: Mapping[str, str]) -> None:
    """Refuse overrides of keys that have a reason, or of keys below them; ``key.``: below only."""
    typed = list(overrides)
    read = " ".join(typed).replace("\\", "")  # sweeps write $\{seed\}
    for option in typed:
        if f"${{{key_of(option)}}}" in read:  # policy=<sweep>/seed${seed}
            continue
        for unused, reason in reasons.items():
            for key in typed_keys(option):
                if key == unused or key.startswith(f"{unused.removesuffix('.')}."):
                    raise ConfigError(f"{option.removeprefix('++')} has no effect: {reason}")


def drawn_in_training(scenario: Any) -> dict[str, str]:
    """Return the settings of a scenario that an evaluation does not use, and why."""
    keys = ["scenario.circumference_range", "training.gap_range"]
    for node in nodes_in(scenario):
        keys += [f"{node.where}.{name}" for name in getattr(node.kind, "of_training", ())]
    return dict.fromkeys(keys, "only episodes of a training draw it")


def of_package(part: Any) -> bool:
    """Return whether all nodes in a part of a configuration are of the package's code."""
    settings = (node.settings for node in nodes_in(part))
    return all(is_ours(x.get("law") or x[TARGET]) for x in settings)


def _of_road(cfg: StudyConfig) -> Iterator[tuple[str, str]]:
    """Yield settings of the road and its leader without effect, and why."""
    if cfg.scenario.road == RING:
        for key in ("data", "split", "leader"):
            yield key, "a ring road has no leader"
        for key in ("scenario.start", "training.gap_range"):
            yield key, "vehicles of a ring start evenly spaced, at scenario.initial_speed"
        return
    for key in ("circumference", "circumference_range", "initial_speed"):
        yield f"scenario.{key}", "it belongs to scenario.road=ring"
    if cfg.leader is not None and all("source" not in x.settings for x in nodes_in(cfg.leader)):
        # A pipeline calibrates drivers on the data.
        for key in ("split",) if hasattr(cfg, "calibration") else ("data", "split"):
            yield key, "the leader drives the records of leader=…; use leader=trajectories"


def _of_rows(cfg: StudyConfig, sweep: bool) -> Iterator[tuple[str, str]]:
    """Yield settings of evaluations with other rows, and why they have no effect."""
    if cfg.evaluation.rows == "vehicles":
        for name in OF_EPISODES[: 3 if sweep else None]:
            yield f"evaluation.{name}", "evaluation.rows=vehicles drives behind every record once"
        if cfg.scenario.road != RING:
            yield "scenario.vehicle_length", "evaluation.rows=vehicles has no flow"
    elif not sweep:
        yield "evaluation.full_length", "whole records belong to evaluation.rows=vehicles"


def _of_roles(cfg: StudyConfig) -> Iterator[tuple[str, str]]:
    """Yield settings of roles without vehicles, and why they have no effect."""
    for group in ("controllers", "start", "filters", "actuators", "sensors"):
        for role in {*getattr(cfg.scenario, group)} & {*cfg.scenario.controllers}:
            if role not in cfg.scenario.vehicles.names:
                yield f"scenario.{group}.{role}", f"no vehicle of the string is {role}"
                for option in OPTIONS_OF.get(group, ()):
                    if option != "event" or not cfg.scenario.replaced:
                        yield option, f"no vehicle of the string is {role}"
    for role in filter(cfg.scenario.is_exact, cfg.scenario.filters):
        yield f"scenario.filters.{role}.robust", EXACT
    if AUTOMATED not in cfg.scenario.vehicles.names:
        for name in ("max_braking", "max_acceleration"):
            yield f"scenario.{name}", "no vehicle of the string is automated"
    actuators = cfg.scenario.actuators.get(AUTOMATED)
    braking = None if actuators is None else actuators.settings.get("braking")
    if braking is not None and braking < cfg.scenario.max_braking:
        yield "scenario.max_braking", f"scenario.actuators.automated.braking={braking:g} is less"
    for name, node in cfg.scenario.fleet.items():
        roles = node.settings.get("roles") if node is not None else None  # none of another class
        if roles and not {*roles} & {*cfg.scenario.vehicles.names}:
            yield f"scenario.fleet.{name}", f"no vehicle of the string is {' or '.join(roles)}"


def _of_references(written: Any, overrides: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield settings that serve by reference only and have none, and why they have no effect."""
    text = str(written)
    for key in map(key_of, overrides):
        if f"${{{key}}}" not in text:
            if key == "training.gap_range":
                yield key, "no start of the scenario refers to it"
            elif key.startswith("gains."):
                yield key, "no controller refers to it"


def _of_traffic(scenario: Any) -> Iterator[tuple[str, str]]:
    """Yield knowledge of vehicles further ahead where there are none, and why it has no effect."""
    string = scenario.vehicles
    first = not (string.ring or string.drawn) and string.places(AUTOMATED) == (0,)
    for name, node in scenario.pieces.items():
        if first and node is not None and getattr(node.kind, "of_traffic", False):
            why = f"no vehicle but the leader, whose speed {name} repeats, is ahead"
            yield from dict.fromkeys(("knowledge", f"scenario.pieces.{name}"), why).items()


def _of_agent(cfg: StudyConfig) -> Iterator[tuple[str, str]]:
    """Yield settings of learning without effect, and why."""
    if cfg.agent is not None:
        if horizon := cfg.agent.settings.get("horizon"):
            yield "agent.gamma", f"agent.horizon={horizon:g} sets it; agent.horizon=null does not"
        return
    driver = cfg.scenario.controllers.get(AUTOMATED)
    reason = f"variant {cfg.variant} has no agent"
    if not cfg.automated:
        reason = "no vehicle of the string is automated"
    elif driver is not None and not takes_action(driver):
        reason += f": {driver.name} drives the automated vehicles and uses no action of a policy"
    yield from {"agent": reason, "training": reason}.items()
    if cfg.policy is not None:
        yield "policy", reason


def _of_objective(
    cfg: StudyConfig, written: Any, typed: AbstractSet[str]
) -> Iterator[tuple[str, str]]:
    """Yield settings of terms and surrogates that a training ignores, and why."""
    kinds = ("surrogates", "limits", "limits_each")
    surrogates, limits, each = (cfg.agent.settings.get(key, {}) for key in kinds)
    without_value = not cfg.agent.settings.get("bootstrap", True)
    if without_value:
        for key in ("value_lr", "value_every", "td_lambda", "tau"):
            yield f"agent.{key}", "agent.bootstrap=false learns no value"
        policy = str(cfg.agent.settings["policy"])
        if policy != "network" and not policy.startswith("residual_"):
            for key in ("hidden", "activation"):
                yield f"agent.{key}", f"agent.policy={policy} without a value has no network"
    shares = (*limits.items(), *each.items())
    limited = {name for name, share in shares if share is not None}
    terms = {name: term for name, term in cfg.reward.terms.items() if term.settings.get("weight")}
    for name in {*surrogates, *limits, *each} - {*terms}:
        for key in kinds:
            yield f"agent.{key}.{name}", f"the reward has no term {name}"
    for name, term in terms.items():
        if without_value and name not in surrogates and not getattr(term.kind, "graded", True):
            for key in term.settings:
                yield f"reward.terms.{name}.{key}", f"{term.kind.__name__} has no gradient"
    if not limited:
        yield "agent.limit_rate", "agent.limits has no limit"
    if not any(hasattr(x.kind, "limit_width") for n, x in surrogates.items() if n in limited and x):
        yield "agent.limit_damping", "agent.limits has no limit of an average, such as the spacing"
    for name, surrogate in surrogates.items():
        if name not in terms or surrogate is None:
            continue
        at, term = f"agent.surrogates.{name}", f"reward.terms.{name}"
        text = str(written["surrogates"][name])
        if name not in limited and "limit" in surrogate.settings and "{.limit}" not in text:
            yield f"{at}.limit", f"it belongs to agent.limits.{name}=<share>"
        if name in limited:
            yield f"{term}.weight", f"agent.limits.{name} sets the price of the term"
        elif not surrogate.settings["weight"]:
            idle = [f"{at}.{key}" for key in surrogate.settings if key != "weight"]
            for key in (*idle, *(f"{term}.{key}" for key in terms[name].settings)):
                yield key, f"{at}.weight is 0"
            continue
        for key in terms[name].settings if not {at, f"{at}.{TARGET}"} & typed else ():
            if key != "weight" and f"{term}.{key}" not in text:
                owner = f"{at} ({surrogate.kind.__name__}) takes the term's place in the objective"
                yield f"{term}.{key}", f"{owner} and has its own settings"
