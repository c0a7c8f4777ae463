"""Configuration: every shipped file composes and builds; typos and contradictions are named."""

from __future__ import annotations

import dataclasses
import inspect
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import fuzz
import pytest
from composing import composed_anew
from helpers import POPULATION, VARIANTS, compose, slow_but, wavy_profiles
from hydra import compose as hydra_compose
from hydra import initialize_config_module
from omegaconf import DictConfig, OmegaConf

import lcc_rl
import lcc_rl.conf
from lcc_rl.agents.factory import build_agent, learns
from lcc_rl.config import build, config_hash, load
from lcc_rl.envs import build_env
from lcc_rl.errors import ConfigError
from lcc_rl.pieces import RewardTerm
from lcc_rl.pieces.world import World
from lcc_rl.policies import shared_policy
from lcc_rl.policies.actor import ACTION
from lcc_rl.settings import Settings
from lcc_rl.targets import TARGET, find_target

CONF = Path(lcc_rl.conf.__file__).parent
LEARNED = ("alcc", "reference", "own_energy", "ddpg", "hcfs")


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


@pytest.mark.parametrize("variant", options("variant"))
@pytest.mark.parametrize("entry", ["train", "evaluate"])
def test_every_variant_composes_builds_and_runs(entry, variant) -> None:
    cfg = load(entry, [f"variant={variant}", "experiment=smoke"])
    assert cfg.variant == variant
    assert learns(cfg) or cfg.agent is None
    assert rolled_out(cfg, 10).shape[0] == 2


def test_a_variant_may_be_written_as_its_paper_does() -> None:
    assert load("train", ["variant=ALCC"]) == load("train", ["variant=alcc"])
    assert load("pipeline", ["variants=[ALCC]"]) == load("pipeline", ["variants=[alcc]"])


def rolled_out(cfg: DictConfig, steps: int):
    """Play a few steps with the agent's policy where there is one."""
    policy = shared_policy(build_agent(cfg, POPULATION).policy) if learns(cfg) else None
    return build_env(cfg, wavy_profiles(), POPULATION, 2).rollout(steps, policy)


def test_the_tests_know_every_variant() -> None:
    assert sorted(VARIANTS) == options("variant")


@pytest.mark.parametrize("experiment", options("experiment"))
@pytest.mark.parametrize("entry", ["train", "evaluate", "pipeline"])
def test_every_experiment_composes(entry, experiment) -> None:
    variant = ["variant=ddpg"] if "hcfs" in experiment else []
    cfg = load(entry, [f"experiment={experiment}", *variant])
    build_agent(cfg, POPULATION)
    assert cfg.training.episodes % cfg.training.environments == 0


@pytest.mark.parametrize("group", ["split", "drivers", "agent", "leader", "data", "logger"])
def test_every_option_of_a_group_builds(group) -> None:
    for option in options(group):
        root = OmegaConf.create({"data": {}, "split": {}, "x": files()[f"{group}/{option}.yaml"]})
        node = root.x
        if OmegaConf.missing_keys(node) or TARGET not in node:
            continue
        node.pop("defaults", None)  # Hydra's business, not the constructor's
        if option == "trajectories":
            node.source, node.split = (
                files()[x] for x in ("data/stream.yaml", "split/single.yaml")
            )
        if option == "mixture":
            node.cycles = {**files()["leader/udds.yaml"]}
            node.cycles.pop("defaults")
        given = {"time_step": 0.1, "observation_size": 7, "action_size": 1, "seed": 0}
        given["observation"] = build(load("train").observation, "observation", World())
        assert build(node, group, population=POPULATION, **given) is not None


# Recipes that choose what learns serve those variants only in which it can.
CHOOSING = {"limits": LEARNED, "main": LEARNED, "limits_tuned": ("alcc", "reference", "own_energy")}
RECIPES = [(e, v) for e in options("experiment") for v in options("variant")]


def serves(experiment: str, variant: str) -> bool:
    return variant in CHOOSING.get(experiment, [variant])


@pytest.mark.parametrize(
    ("experiment", "variant"),
    slow_but([(e, "cacc") for e in CHOOSING], [(e, v) for e, v in RECIPES if not serves(e, v)]),
)
def test_a_recipe_that_chooses_what_learns_is_refused_elsewhere(experiment, variant) -> None:
    with pytest.raises(ConfigError) as caught:
        fuzz.build_study((f"experiment={experiment}", f"variant={variant}", "scenario.horizon=20"))
    assert "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("experiment", "variant"),
    slow_but(
        [(e, v) for e, v in RECIPES if v in ("alcc", "ddpg", "idm")],
        [(e, v) for e, v in RECIPES if serves(e, v)],
    ),
)
def test_every_recipe_serves_every_variant(experiment, variant) -> None:
    cfg = load("train", [f"experiment={experiment}", f"variant={variant}"])
    assert not learns(cfg) or build_agent(cfg, POPULATION).policy is not None
    assert learns(cfg) == (variant in LEARNED)


def test_paper_recipe_is_what_the_defaults_are() -> None:
    # The recipes exist to be read; they must not drift from the defaults they repeat.
    assert config_hash(load("train", ["experiment=paper_alcc"])) == config_hash(load("train"))
    plain, recipe = ["variant=ddpg"], ["variant=ddpg", "experiment=paper_hcfs"]
    assert config_hash(load("train", recipe)) == config_hash(load("train", plain))


# -- controllers -----------------------------------------------------------------------------------

# The scenario that a controller of conf/controller fits: what it reads must be there.
SCENARIO_OF = {"cacc": "cacc", "deadbeat": "cacc", "hcfs": "hcfs"}


@pytest.mark.parametrize("controller", options("controller"))
def test_every_controller_drives_the_automated_vehicles(controller) -> None:
    variant = SCENARIO_OF.get(controller, "alcc")
    choice = f"controller@scenario.controllers.automated={controller}"
    cfg = load("train", [f"variant={variant}", choice, "scenario.horizon=20"])
    learned = controller in ("action", "hcfs")
    policy = shared_policy(build_agent(cfg, POPULATION).policy) if learned else None
    env = build_env(cfg, wavy_profiles(), POPULATION, 2)
    data = env.rollout(3, policy, break_when_any_done=False)
    assert data.shape == (2, 3)
    assert data["next", "vehicles", "acceleration"].isfinite().all()
    assert (env.action_keys == [("automated", "action")]) == learned


# -- parity of files and constructors --------------------------------------------------------------


@cache
def files() -> dict[str, DictConfig]:
    """Every file below conf, by its name there."""
    paths = sorted(CONF.rglob("*.yaml"))
    return {path.relative_to(CONF).as_posix(): OmegaConf.load(path) for path in paths}


def nodes(value: Any, where: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield every node that describes an object of this package, and its place."""
    if isinstance(value, dict):
        if str(value.get(TARGET, "")).startswith("lcc_rl."):
            yield where, value
        for key, inner in value.items():
            yield from nodes(inner, f"{where}.{key}")


def defaults(target: Any) -> dict[str, Any]:
    """Return the defaults of a constructor, or of its dataclass of settings."""
    own = getattr(target, "Settings", target)
    parameters = inspect.signature(own).parameters.items()
    found = {name: p.default for name, p in parameters if p.default is not p.empty}
    for field in dataclasses.fields(own) if dataclasses.is_dataclass(own) else ():
        if field.default_factory is not dataclasses.MISSING:
            found[field.name] = field.default_factory()
    return found


def as_lists(value: Any) -> Any:
    return [as_lists(item) for item in value] if isinstance(value, list | tuple) else value


# A class that the files describe more than once has the defaults of its first use.
EXCEPTIONS = {
    "agent/analytic.yaml.agent": "nodes of pieces, of which a constructor has none",
    "calibration/local.yaml": "which mode, and nodes, are the choice of a file",
    "calibration/local.yaml.global_genetic": "second use of GeneticSettings",
    "data/highway.yaml": "second use of StreamSource",
    "data/highway.yaml.drivers": "second use of bootstrap",
    "data/highway.yaml.leader": "second use of StopAndGo",
    "data/stream.yaml": "nodes of leader and criteria; their own defaults are compared",
    "drivers/calibrated.yaml": "the path is asked for",
    "drivers/highway.yaml": "second use of bootstrap",
    "drivers/i80.yaml": "the shipped table has both modes; null takes the same one",
    "drivers/kde.yaml": "as for i80",
    "energy/bolt.yaml": "another vehicle",
    "energy/mixture.yaml": "shares of its classes",
}


def test_values_of_files_are_the_defaults_of_constructors() -> None:
    root, different, compared = load("train", ["variant=hcfs"]), {}, 0
    for name, content in files().items():
        for where, node in nodes(OmegaConf.to_container(content, resolve=False), name):
            target = find_target(node[TARGET], where)
            if inspect.isclass(target) and issubclass(target, Settings):
                continue  # the class holds them
            known = defaults(target)
            for key in set(known) & set(node):
                value = node[key]
                if isinstance(value, str) and value.startswith("${"):
                    value = select(root, value[2:-1])
                compared += 1
                if as_lists(value) != as_lists(known[key]):
                    different.setdefault(where, []).append((key, value, known[key]))
    assert compared > 106
    assert {where: x for where, x in different.items() if where not in EXCEPTIONS} == {}
    assert set(EXCEPTIONS) <= set(different), "an exception that is none"


def select(root: DictConfig, key: str) -> Any:
    key, _, otherwise = key.removeprefix("oc.select:").partition(",")
    value = OmegaConf.select(root, key, default=float(otherwise) if otherwise else None)
    return OmegaConf.to_container(value) if OmegaConf.is_config(value) else value


OFFERED = {"population", "time_step", "string", "energy", "observation_size", "action_size", "seed"}
OFFERED |= {"settings", "device", "observation", "max_acceleration"}


def test_every_setting_of_a_constructor_is_in_its_file() -> None:
    groups = ("controller", "filter", "scenario", "observation", "reward", "agent", "knowledge")
    for name, content in files().items():
        if name.split("/")[0] not in groups:
            continue
        for where, node in nodes(OmegaConf.to_container(content, resolve=False), name):
            target = find_target(node[TARGET], where)
            known = set(inspect.signature(getattr(target, "Settings", target)).parameters)
            given = {key for key in node if key not in (TARGET, "defaults")}
            assert given <= known, where
            if inspect.isclass(target) and issubclass(target, Settings):
                continue
            left = known - given - OFFERED
            assert not left or where in PARTIAL, (where, left)


PARTIAL = {
    "agent/analytic.yaml.agent": "terms and limits are of its defaults list",
    "agent/tuned.yaml.agent": "terms and limits are of its defaults list",
}


# What a choice needs beside it; its group's prefix and key on the command line.
WITH = {
    "controller": ["variant=hcfs"],
    "gains": ["variant=cacc"],
    "plausible": ["data=ngsim", "data.path=x"],
    "leader": ["variant=ddpg"],
    "surrogates": ["agent=analytic"],
    "data/ngsim": ["data.path=x"],
    "data/episodes": ["data.path=x"],
    "data/openacc": ["data.path=x"],
    "data/table": ["data.path=x", "data.columns={leader: a, gap: b}"],
    "leader/paper": ["leader.path=x"],
    "leader/openacc": ["leader.path=x"],
    "experiment/paper_hcfs": ["variant=ddpg"],
    "experiment/hcfs_spacing": ["variant=ddpg"],
}
TYPED = {
    "filter": "+filter",
    "knowledge": "+knowledge",
    "plausible": "plausible@data.plausible",
    "surrogates": "surrogates@agent",
    "controller": "controller@scenario.controllers.automated",
}
CHOICES = [name.removesuffix(".yaml") for name in files() if "/" in name]


NAMES = [name for name in CHOICES if name.count("/") == 1]
ELSEWHERE = ("variant/", "experiment/", "task/")  # composed by tests of their own


@pytest.mark.parametrize("name", slow_but((n for n in NAMES if not n.startswith(ELSEWHERE)), NAMES))
def test_every_file_is_composed(name) -> None:
    group, option = name.split("/")
    entry = "calibrate" if group == "calibration" else "train"
    if group == "learning":
        scenario, agent = option.split("_")
        words = [f"scenario={scenario}", "variant=ddpg", f"agent={agent}"]
    else:
        words = [f"{TYPED.get(group, group)}={option}"]
        words += [*WITH.get(group, ()), *WITH.get(name, ())]
    cfg = load(entry, words)
    own = OmegaConf.to_container(files()[f"{name}.yaml"], resolve=False)
    target = own.get(TARGET)
    if target is not None:
        assert target in str(OmegaConf.to_container(cfg)), name


@pytest.mark.parametrize(
    ("override", "term"),
    [
        ("reward.terms.hdv_energy.weight=0", "hdv_energy"),
        ("reward.terms.safety.weight=2", "safety"),
    ],
)
def test_an_ablation_changes_only_its_term(override, term) -> None:
    base, changed = compose("alcc"), compose("alcc", override)
    data = [
        build_env(cfg, wavy_profiles(), POPULATION, 8, seed=1).rollout(
            20,
            lambda td: td.set(ACTION, td["automated", "observation"][..., :1] * 0.0 + 0.8),
            break_when_any_done=False,
        )["next", "automated", "reward_terms"]
        for cfg in (base, changed)
    ]
    for name in data[0].keys():  # noqa: SIM118
        same = (data[0][name] == data[1][name]).all()
        assert same == (name != term), name


def test_a_term_can_be_removed_and_added() -> None:
    cfg = compose("alcc", "~reward.terms.efficiency")
    assert "efficiency" not in cfg.reward.terms
    cfg = compose("alcc", "+reward.terms.comfort={_target_: test_config.Comfort, weight: 0.5}")
    env = build_env(cfg, wavy_profiles(), POPULATION, 2)
    data = env.rollout(3)["next"]
    expected = -0.5 * data["vehicles", "jerk"][..., :1, :].abs()
    assert (data["automated", "reward_terms", "comfort"] == expected).all()


class Comfort(RewardTerm):
    reads = ("self.jerk",)

    def reward(self, jerk):
        return -jerk.abs()


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["variant=alccc"], "alccc"),
        (["agent=dddpg"], "dddpg"),
        (["sede=3"], "sede"),
        (["seed=abc"], "seed"),
        (["reward.terms.jrk.weight=1"], "jrk"),
        (["reward.w_typo=2"], "w_typo"),
        (["scenario.horizon=many"], "horizon"),
        (["training.episodes=1.5"], "episodes"),
        (["experiment=fast"], "fast"),
    ],
)
def test_typing_errors_are_refused_at_composition(overrides, words) -> None:
    with pytest.raises(ConfigError, match=words):
        load("train", overrides)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["agent.gamma=1.5"], "gamma"),
        (["agent.gamma=high"], r"agent\.gamma must be"),
        (["agent.batch_size=50000"], "buffer_size"),
        (["agent.tau=0"], "tau"),
        (["+agent.momentum=0.9"], "momentum"),
        (["agent._target_=lcc_rl.agents.PPO"], "PPO"),
        (["agent.exploration.decay_share=0"], "decay_share"),
    ],
)
def test_impossible_agent_settings(overrides, words) -> None:
    with pytest.raises(ConfigError, match=words):
        build_agent(compose("alcc", *overrides), POPULATION)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["scenario.horizon=0"], "horizon"),
        (["scenario.string='automated human*0'"], "1…10000 vehicles at character 16"),
        (["scenario.controllers.human.noise=1.5"], "noise"),
        (["scenario.pieces.leader.start=last"], "start"),
        (["scenario.pieces.estimator.measurement_error=0"], "measurement_error"),
        (["scenario.controllers.automated.max_acceleration=-1"], "max_acceleration"),
        (["+scenario.controllers.automated.mass=1000"], "mass"),
        (["reward.terms.safety.threshold=0"], "threshold"),
        (["reward.terms.safety.weight=heavy"], "weight"),
        (["reward.terms.cav_energy.scale=0"], "scale"),
        (["reward.terms.safety._target_=lcc_rl.pieces.Safety"], "Safety"),
        (["observation.visible=0"], "visible"),
        (["observation.scales.self.gap=0"], "scale"),
        (["+scenario.filters.bus={_target_: lcc_rl.pieces.CBFFilter}"], "bus"),
    ],
)
def test_impossible_environment_settings(overrides, words) -> None:
    with pytest.raises(ConfigError, match=words):
        build_env(compose("alcc", *overrides), wavy_profiles(), POPULATION, 2)


def test_all_terms_removed() -> None:
    terms = ["safety", "efficiency", "cav_energy", "hdv_energy", "collision"]
    cfg = compose("alcc", *(f"~reward.terms.{term}" for term in terms))
    with pytest.raises(ConfigError, match=r"reward\.terms is empty"):
        build_env(cfg, wavy_profiles(), POPULATION, 2)


def test_hash_ignores_order_and_sees_values() -> None:
    assert config_hash({"a": 1, "b": 2}) == config_hash({"b": 2, "a": 1})
    assert config_hash({"a": 1}) != config_hash({"a": 2})


ROOMS = sorted(path.parent.name for path in Path(lcc_rl.__file__).parent.glob("*/__init__.py"))
FRESH = """
import sys, traceback
from importlib import import_module
import torchrl.envs, torchrl.data, torchrl.objectives, hydra, pandas  # once, they are slow
for room in sys.argv[1:]:
    for name in [name for name in sys.modules if name.split(".")[0] == "lcc_rl"]:
        del sys.modules[name]
    try:
        import_module(f"lcc_rl.{room}")
    except Exception:
        print(room, traceback.format_exc(limit=-3), file=sys.stderr)
"""


@pytest.mark.slow
def test_every_room_can_be_entered_first() -> None:
    # A circular import shows only where no room is imported yet and the wrong one begins.
    rooms = [*ROOMS, "synthetic.stream", "studies.alcc", "studies.hcfs"]
    assert {"pieces", "envs", "policies", "agents", "evaluation", "results"} <= set(rooms)
    words = [sys.executable, "-c", FRESH, *rooms]
    done = subprocess.run(words, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("entry", ["train", "evaluate", "pipeline", "calibrate"])
def test_what_tests_compose_is_what_hydra_composes(entry: str) -> None:
    agent = () if entry == "calibrate" else ("agent=td3", "variant=ddpg", "+filter=cbf")
    words = ["experiment=smoke", *agent, "seed=3", "hydra.job.chdir=true"]
    with initialize_config_module("lcc_rl.conf", version_base="1.3"):
        kept = [hydra_compose(entry, words, return_hydra_config=True) for _ in range(2)]
        with composed_anew():
            fresh = hydra_compose(entry, words, return_hydra_config=True)
    for cfg in kept:
        assert OmegaConf.to_yaml(cfg) == OmegaConf.to_yaml(fresh)
        assert OmegaConf.is_struct(cfg)
    kept[0].seed = 4
    assert kept[1].seed == 3
