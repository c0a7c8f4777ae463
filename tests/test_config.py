"""Configuration: every shipped file composes and builds; typos and contradictions are named."""

from __future__ import annotations

import inspect
import subprocess
import sys
from pathlib import Path

import lcc_rl.conf
import pytest
from helpers import PLATOON, POPULATION, VARIANTS, compose, wavy_profiles
from omegaconf import OmegaConf

from lcc_rl.config import build, config_hash, find_target, load
from lcc_rl.envs.factory import build_agent, build_env
from lcc_rl.errors import ConfigError
from lcc_rl.pieces import RewardTerm

CONF = Path(lcc_rl.conf.__file__).parent


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


@pytest.mark.parametrize("variant", options("variant"))
@pytest.mark.parametrize("entry", ["train", "evaluate"])
def test_every_variant_composes_builds_and_runs(entry, variant) -> None:
    cfg = load(entry, [f"variant={variant}", "experiment=smoke"])
    assert cfg.variant == variant
    env = build_env(cfg, wavy_profiles(), POPULATION, 2)
    policy = build_agent(cfg, POPULATION).policy
    assert env.rollout(10, policy).shape[0] == 2


def test_the_tests_know_every_variant() -> None:
    assert sorted(VARIANTS) == options("variant")


@pytest.mark.parametrize("experiment", options("experiment"))
@pytest.mark.parametrize("entry", ["train", "pipeline"])
def test_every_experiment_composes(entry, experiment) -> None:
    cfg = load(entry, [f"experiment={experiment}"])
    build_agent(cfg, POPULATION)
    assert cfg.training.episodes % cfg.training.environments == 0


@pytest.mark.parametrize("group", ["split", "drivers", "agent"])
def test_every_option_of_a_group_builds(group) -> None:
    for option in options(group):
        gains = OmegaConf.load(CONF / "gains" / "tuned.yaml")
        node = OmegaConf.create(
            {"gains": gains, "x": OmegaConf.load(CONF / group / f"{option}.yaml")}
        ).x
        if OmegaConf.missing_keys(node):
            continue
        node.pop("defaults", None)  # Hydra's business, not the constructor's
        built = build(
            node,
            group,
            population=POPULATION,
            max_acceleration=3.0,
            time_step=0.1,
            observation_size=7,
            action_size=1,
            seed=0,
        )
        assert built is not None


@pytest.mark.parametrize("variant", options("variant"))
@pytest.mark.parametrize("experiment", options("experiment"))
def test_every_recipe_serves_every_variant(experiment, variant) -> None:
    cfg = load("train", [f"experiment={experiment}", f"variant={variant}"])
    assert build_agent(cfg, POPULATION).policy is not None


def test_paper_recipe_is_what_the_defaults_are() -> None:
    # The recipes exist to be read; they must not drift from the defaults they repeat.
    assert config_hash(load("train", ["experiment=paper_alcc"])) == config_hash(load("train"))
    plain, recipe = ["variant=ddpg"], ["variant=ddpg", "experiment=paper_hcfs"]
    assert config_hash(load("train", recipe)) == config_hash(load("train", plain))


def test_constructor_arguments_and_yaml_are_in_parity() -> None:
    """Every argument of a piece is in its yaml, offered by the factory, or a name's default."""
    offered = {"profiles", "population", "time_step", "horizon", "name", "reads"}
    naming = {
        "predecessor",
        "vehicle",
        "strings",
        "event_shape",
        "followers",
        "acceleration",
        "power",
        "reads",
        "platoon",
        "leader",
    }
    for variant in VARIANTS:
        one_car = variant in ("alcc", "reference", "own_energy", "idm")
        filtered = ["+filter=barrier"] if one_car else []
        cfg = compose(variant, *filtered)
        nodes = {**cfg.scenario.pieces, **cfg.reward.terms}
        if variant in PLATOON:
            own = ("agent", "observation", "leader")
            nodes |= {f"{group} of {variant}": cfg[group] for group in own}
            offered |= {"max_acceleration", "learned", "path", "observation_size", "action_size"}
            offered |= {"seed", "device"}
        if cfg.controller is not None:
            nodes["controller"] = cfg.controller
        for name, node in nodes.items():
            signature = set(inspect.signature(find_target(node["_target_"], name)).parameters)
            given = {key for key in node if not key.startswith("_")}
            assert given <= signature, name
            assert signature - given <= offered | naming, (name, signature - given)


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
            lambda td: td.set("action", td["observation"][..., :1] * 0.0 + 0.8),
            break_when_any_done=False,
        )["next", "reward_terms"]
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
    expected = -0.5 * data["cav", "jerk"].abs()
    assert (data["reward_terms", "comfort"] == expected).all()


class Comfort(RewardTerm):
    reads = ("cav.jerk",)

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
        (["scenario.followers=0"], "followers"),
        (["scenario.pieces.hdv.noise=1.5"], "noise"),
        (["scenario.pieces.leader.start=last"], "start"),
        (["scenario.pieces.estimator.measurement_error=0"], "measurement_error"),
        (["scenario.pieces.cav.max_acceleration=-1"], "max_acceleration"),
        (["+scenario.pieces.cav.mass=1000"], "mass"),
        (["reward.terms.safety.threshold=0"], "floor"),
        (["reward.terms.safety.weight=heavy"], "weight"),
        (["reward.terms.cav_energy.scale=0"], "scale"),
        (["reward.terms.safety._target_=lcc_rl.pieces.Safety"], "Safety"),
        (["observation.visible=0"], "visible"),
        (["observation.scales.cav.gap=0"], "scale"),
        (["scenario.pieces.collision.followers=[bus]"], "bus"),
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


ROOMS = sorted(path.parent.name for path in CONF.parent.glob("*/__init__.py"))
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


def test_every_room_can_be_entered_first() -> None:
    # A circular import shows only where no room is imported yet and the wrong one begins.
    rooms = [*ROOMS, "synthetic.stream", "studies.alcc", "studies.hcfs"]
    assert {"pieces", "envs", "policies", "agents", "evaluation", "results"} <= set(rooms)
    words = [sys.executable, "-c", FRESH, *rooms]
    done = subprocess.run(words, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
