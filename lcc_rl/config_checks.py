"""Options that were given but have no effect, and options of former releases under new names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf

from lcc_rl.errors import ConfigError
from lcc_rl.functional.pattern import AUTOMATED, RING, VehicleString, parse_string

AUTO = "scenario.controllers.automated"
NO_AGENT = ("agent=none", "agent=null")
# Settings of an evaluation whose rows are episodes.
OF_EPISODES = ("batch_size", "sample_episodes", "repeats", "shards", "shard", "compiled")
# Former spellings as regular expressions, and what to say instead; \1 is what the bracket holds.
RENAMED = (
    (
        r"scenario\.followers=(.*)",
        r"scenario.string='automated human*\1' (a platoon: 'automated*\1')",
    ),
    (r"variant=barrier", "variant=cbf"),
    (r"\+filter=barrier", "+filter=cbf"),
    (r"scenario=direct", "scenario.string=human"),
    (r"scenario\.pieces\.cav\.initial_gap_range", "training.gap_range"),
    (r"scenario\.pieces\.cav\.initial_time_gap", "scenario.start.automated.time_gap"),
    (r"scenario\.pieces\.cav\.standstill_gap", "scenario.start.automated.standstill_gap"),
    (r"scenario\.pieces\.(?:cav|platoon)\.max_acceleration", f"{AUTO}.max_acceleration"),
    (r"scenario\.pieces\.hdv\.cap_time_gap", "scenario.start.human.cap_time_gap"),
    (r"scenario\.pieces\.hdv\.", "scenario.controllers.human."),
    (r"scenario\.pieces\.platoon\.safe_headway", "scenario.start.automated.headway"),
    (r"scenario\.pieces\.platoon\.", "scenario.start.automated."),
    (r"scenario\.pieces\.errors\.", "scenario.pieces.communication."),
    (r"scenario\.pieces\.barrier\.", "scenario.filters.automated."),
    (r"scenario\.pieces\.(?:cav|hdv)_(power|ttc|time_gap)\b", r"scenario.pieces.\1"),
    (r"scenario\.pieces\.hdv_predicted_power", "scenario.pieces.predicted_power"),
    (r"observation\.scales\.cav", "observation.scales.self"),
    (r"observation\.scales\.hdv", "observation.scales.behind"),
    (r"agent=coast", f"controller@{AUTO}=constant agent=none"),
    (r"agent=(idm|cacc|deadbeat)", rf"controller@{AUTO}=\1 agent=none"),
    (r"agent\.final_share", "agent.final_lr_fraction"),
    (r"agent\.sampled=true", f"{AUTO}.desired_speed=null {AUTO}.time_gap=null"),
    (r"agent\.(desired_speed|time_gap|lookahead|k[1-4])\b", rf"{AUTO}.\1"),
    (r"controller\.", "deployed."),
)
# Settings whose defaults the classes hold (lcc_rl.settings).
IN_CLASSES = re.compile(
    r"((reward\.terms|agent\.(surrogates|regularizers)|scenario\.(controllers|filters|pieces|start))"
    r"\.\w+|observation|deployed)(\.(after|rule))?\.\w+="
)
# Options that are gone, and why.
REMOVED = (
    (r"calibration\.compiled\b", "a calibration on a CPU is compiled wherever numba is installed"),
)


def as_meant(overrides: Sequence[str]) -> list[str]:
    """Return what was typed as Hydra has to read it.

    Names of variants, which papers write in capitals, are in lower case; settings whose defaults
    stand in a class and not in a file may be set like all others.

    Examples:
        >>> as_meant(["variant=ALCC,HCFS", "data.path=A", "reward.terms.safety.margin=0"])
        ['variant=alcc,hcfs', 'data.path=A', '++reward.terms.safety.margin=0']
    """
    lower = (x.lower() if re.match(r"\+*variants?=", x) else x for x in overrides)
    return [f"++{x}" if IN_CLASSES.match(x) and not renamed_option([x]) else x for x in lower]


def renamed_option(overrides: Sequence[str]) -> ConfigError | None:
    """Return the error for an option of a former release, naming today's; None for none."""
    for item in overrides:
        for old, reason in REMOVED:
            if re.match(rf"[~+]*{old}", item):
                return ConfigError(f"{item}: this option no longer exists: {reason}")
        for old, new in RENAMED:
            if re.match(rf"[~+]*{old}" if not old.startswith(r"\+") else old, item):
                said = re.sub(rf"^[~+]*{old.lstrip(chr(92) + '+')}", new, item.lstrip("+~"))
                return ConfigError(f"{item}: this option has a new name; say {said}")
    return None


def check_ignored(cfg: DictConfig, overrides: Sequence[str], sweep: bool = False) -> None:
    """Refuse options that the configuration at hand would ignore.

    Args:
        cfg: configuration of a study.
        overrides: what was typed.
        sweep: the runs of a sweep share what was typed, so what one of them learns by may be
            given to another that learns nothing.

    Raises:
        ConfigError: naming the option and why it has no effect.
    """
    reasons: dict[str, str] = {}
    if not sweep and any(item.lstrip("+~").startswith("calibration.") for item in overrides):
        reasons |= _unused_by_calibration(cfg.calibration)
    if "variant" in cfg and "scenario" in cfg:
        reasons |= _without_effect(cfg, sweep)
    for item in overrides:
        key = item.lstrip("+~").partition("=")[0].partition("@")[0]
        if item in NO_AGENT:
            continue
        for prefix, reason in reasons.items():
            if (key == prefix or key.startswith(f"{prefix}.")) and item != "agent=none":
                raise ConfigError(f"{item} has no effect: {reason}")


def _without_effect(cfg: DictConfig, sweep: bool) -> Iterator[tuple[str, str]]:
    """Yield options that have no effect on a configuration, and why."""
    scenario = cfg.scenario
    string = string_of_scenario(scenario)
    ring = scenario.road == RING
    if ring:
        for key in ("data", "split", "leader"):
            yield key, "a ring road has no leader"
    elif cfg.get("leader") is not None and not _plays_data(cfg.leader):
        # A pipeline calibrates drivers on the data.
        for key in ("split",) if "calibration" in cfg else ("data", "split"):
            yield key, "the leader drives the records of leader=…; say leader=trajectories"
    if not ring:
        for key in ("circumference", "initial_speed"):
            yield f"scenario.{key}", "it belongs to scenario.road=ring"
    if set(string.names) == {AUTOMATED} and not _is_human(scenario.controllers.get(AUTOMATED)):
        for key in ("drivers", "evaluation.drivers"):
            yield key, f"there is no human driver in scenario.string={scenario.string}"
    for group in ("controllers", "start"):
        for role in scenario[group]:
            if role not in string.names:
                yield f"scenario.{group}.{role}", f"no vehicle of the string is {role}"
    if not OmegaConf.is_dict(cfg.get("agent")) or "_target_" not in cfg.agent:
        for key in () if sweep else ("agent", "training"):
            yield key, f"variant {cfg.variant} learns nothing"
    elif not sweep:
        yield from _unused_by_agent(cfg.agent)
    deployed = cfg.get("deployed")
    if OmegaConf.is_dict(deployed) and deployed.get("spacing_weight") == 0:
        for name in ("spacing_time", "gap_scale"):
            yield f"deployed.{name}", "deployed.spacing_weight is 0"
    unused = {
        "episodes": ("evaluation.full_length", "leader.cases", "leader.full_length"),
        "vehicles": tuple(f"evaluation.{name}" for name in OF_EPISODES),
    }
    for name in unused.get(cfg.evaluation.rows, ()):
        yield name, f"it is unused with evaluation.rows={cfg.evaluation.rows}"


def _unused_by_calibration(node: Any) -> Iterator[tuple[str, str]]:
    """Yield bounds of parameters that a calibration does not fit, and constants where it fits all.

    A model or mode that does not exist is said where the calibrator is built.
    """
    # Here: the other commands need no driver model to read their options.
    from lcc_rl.drivers.parameters import MODES, fitted
    from lcc_rl.functional.laws import LAWS

    if not OmegaConf.is_dict(node) or "modes" not in node or node.get("model") not in LAWS:
        return
    model, modes = node.model, list(node.modes)
    if not set(modes) <= set(MODES):
        return
    if "local" not in modes:
        for name in ("constants", "choose_constants"):
            yield f"calibration.{name}", "calibration=global fits all parameters to each driver"
    whole = modes if not node.choose_constants else ["global"]
    used = {name for mode in whole for name in fitted(mode, model)}
    for name in map(str, node.bounds or ()):
        if name not in used:
            reason = f"calibration.model={model} with modes {', '.join(modes)} does not fit it"
            yield f"calibration.bounds.{name}", reason


def _plays_data(leader: Any) -> bool:
    """Whether leaders, or one source of a mixture of them, are those of ``data``."""
    if not OmegaConf.is_dict(leader) or "_target_" not in leader:
        return False
    known = (key for key in leader if not OmegaConf.is_missing(leader, key))
    return "source" in leader or any(_plays_data(leader[key]) for key in known)


def _unused_by_agent(agent: DictConfig) -> Iterator[tuple[str, str]]:
    """Yield settings of an agent that learns through the simulator which others switch off."""
    policy = agent.get("policy")
    if policy in ("idm", "acc"):
        yield "agent.hidden", f"agent.policy={policy} has no layers"
    if agent.get("bootstrap") is False:
        for name in ("value_lr", "td_lambda", "value_every", "tau"):
            yield f"agent.{name}", "agent.bootstrap=false learns no value"
    limits = agent.get("limits")
    if OmegaConf.is_dict(limits) and not any(share is not None for share in limits.values()):
        yield "agent.limit_rate", "there is no limit: agent.limits is empty"


def string_of_scenario(scenario: Any) -> VehicleString:
    """Return the string of vehicles that a scenario's node describes.

    Raises:
        ConfigError: pointing at the place in the pattern where it cannot be read.
    """
    pattern = scenario.string
    if isinstance(pattern, DictConfig):
        pattern = OmegaConf.to_container(pattern)
    return parse_string(pattern, scenario.road)


def _is_human(node: Any) -> bool:
    known = OmegaConf.is_dict(node)  # anything else is refused where it is built
    return known and str(node.get("_target_", "")).endswith((".IDM", ".Handover"))
