"""Options that a configuration would ignore although their being ignored changes a result."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from lcc_rl.config.nodes import TARGET, is_node, short_name, takes_action, takes_population
from lcc_rl.errors import ConfigError
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, RING, parse_string

NO_AGENT = ("agent=none", "agent=null")
# Settings of an evaluation whose rows are episodes.
OF_EPISODES = ("batch_size", "sample_episodes", "repeats", "shards", "shard", "compiled")


def check_used(content: Mapping[str, Any], overrides: Sequence[str], sweep: bool = False) -> None:
    """Refuse options that the configuration at hand would ignore.

    Args:
        content: a configuration as plain containers.
        overrides: what was typed.
        sweep: the runs of a sweep share what was typed, so what one of them learns by may be
            given to another that learns nothing.
    """
    if "string" not in content.get("scenario", {}):
        return
    reasons = dict(_of_traffic(content))
    if not sweep:
        reasons |= dict(_of_roles(content)) | dict(_of_agent(content))
        reasons["sweep"] = "it names the folder of a sweep, -m"
    typed = {item: item.lstrip("+~").partition("=")[0].partition("@")[0] for item in overrides}
    for item, key in typed.items():
        for unused, reason in reasons.items():
            if (key == unused or key.startswith(f"{unused}.")) and item not in NO_AGENT:
                raise ConfigError(f"{item.removeprefix('++')} has no effect: {reason}")


def _of_traffic(content: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield settings of data, drivers and evaluation without effect, and why."""
    scenario, leader = content["scenario"], content.get("leader")
    string = parse_string(scenario["string"], scenario["road"])
    if scenario["road"] == RING:
        for key in ("data", "split", "leader"):
            yield key, "a ring road has no leader"
    else:
        for key in ("circumference", "circumference_range", "initial_speed"):
            yield f"scenario.{key}", "it belongs to scenario.road=ring"
        if leader is not None and not _plays_data(leader):
            # A pipeline calibrates drivers on the data.
            for key in ("split",) if "calibration" in content else ("data", "split"):
                reason = "the leader drives the records of leader=…; use leader=trajectories"
                yield key, reason
    drivers = [scenario["controllers"].get(AUTOMATED)]
    if HUMAN in content.get("compare", ()):  # drives the automated vehicles, too
        drivers.append(scenario["controllers"].get(HUMAN))
    if set(string.names) == {AUTOMATED} and not any(map(takes_population, drivers)):
        for key in ("drivers", "evaluation.drivers"):
            yield key, f"there is no human driver in scenario.string={scenario['string']}"
    unused = {
        "episodes": ("evaluation.full_length", "leader.cases", "leader.full_length"),
        "vehicles": tuple(f"evaluation.{name}" for name in OF_EPISODES),
    }
    rows = content["evaluation"]["rows"]
    for name in unused.get(rows, ()):
        yield name, f"it is unused with evaluation.rows={rows}"


def _of_roles(content: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield settings of roles that no vehicle has, and why they have no effect."""
    scenario = content["scenario"]
    for group in ("controllers", "start", "filters", "actuators", "sensors"):
        for role in scenario.get(group, ()):
            if role not in parse_string(scenario["string"]).names:
                yield f"scenario.{group}.{role}", f"no vehicle of the string is {role}"


def _of_agent(content: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield settings of learning without effect, and why."""
    agent: Any = content.get("agent")
    if not is_node(agent):
        driver = content["scenario"]["controllers"].get(AUTOMATED)
        reason = f"variant {content['variant']} learns nothing"
        if not parse_string(content["scenario"]["string"]).count(AUTOMATED):
            reason = "no vehicle of the string is automated"
        elif is_node(driver) and not takes_action(driver):
            kind = short_name(driver[TARGET])
            reason += f": {kind} drives the automated vehicles and takes no action of a policy"
        for key in ("agent", "training"):
            yield key, reason
        return
    if agent.get("policy") in ("idm", "acc"):
        yield "agent.hidden", f"agent.policy={agent['policy']} has no layers"
    if agent.get("bootstrap") is False:
        for name in ("value_lr", "td_lambda", "value_every", "tau"):
            yield f"agent.{name}", "agent.bootstrap=false learns no value"


def _plays_data(leader: Any) -> bool:
    """Whether leaders, or one source of a mixture of them, are those of ``data``."""
    return is_node(leader) and ("source" in leader or any(map(_plays_data, leader.values())))
