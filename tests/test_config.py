"""Configuration: every shipped choice composes and builds; the tree is typed, whole and stored."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
import yaml
from helpers import POPULATION, VARIANTS, check_refused, followed_profiles
from hydra import compose, initialize_config_module

import lcc_rl.conf
from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.factory import build_agent
from lcc_rl.config.compose import CONF as MODULE
from lcc_rl.config.compose import as_meant, composed, identity, load, parsed
from lcc_rl.config.nodes import as_plain, settings_at, with_defaults, without_defaults
from lcc_rl.config.schemas import TrainConfig, as_text, parse_config
from lcc_rl.envs import build_env
from lcc_rl.errors import ConfigError
from lcc_rl.pieces import Observation, SafetyReward
from lcc_rl.settings import TARGET, defaults

CONF = Path(lcc_rl.conf.__file__).parent
AUTO = "scenario.controllers.automated"
# Choices that need the path of a file.
OF_FILES = (
    "ngsim",
    "openacc",
    "table",
    "episodes",
    "drives",
    "record",
    "i24",
    "roads",
    "calibrated",
)
# The variant whose scenario a controller of conf/controller fits: what it reads must be there.
SCENARIO_OF = {"cacc": "cacc", "deadbeat": "cacc", "hcfs": "hcfs"}


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def check_drives(cfg: TrainConfig) -> None:
    policy = shared_policy(build_agent(cfg, POPULATION).policy) if cfg.learns else None
    env = build_env(cfg, followed_profiles(), POPULATION, 2)
    rows = env.rollout(3, policy, break_when_any_done=False)["next"]
    assert rows["vehicles", "acceleration"].isfinite().all()


def test_every_variant_and_task_drives(subtests) -> None:
    for words in [
        *([f"variant={name}"] for name in options("variant")),
        *([f"task={name}", "+faults=all"] for name in options("task")),
    ]:
        with subtests.test(words=words):
            check_drives(load("train", [*words, "scenario.horizon=20"]))


def test_every_controller_drives(subtests) -> None:
    for variant in ("alcc", "cacc", "hcfs"):
        own = [x for x in options("controller") if SCENARIO_OF.get(x, "alcc") == variant]
        places = [f"+controller@scenario.controllers.the_{name}={name}" for name in own]
        words = [f"variant={variant}", "scenario.horizon=20"]
        string = f"scenario.string='automated {' '.join(f'the_{name}' for name in own)}'"
        controllers = load("train", [*words, string, *places]).scenario.controllers
        for name in own:
            with subtests.test(name=name):
                cfg = load("train", words)
                driver = {"automated": controllers[f"the_{name}"]}
                check_drives(cfg.with_(scenario={"controllers": driver}))


def test_the_tests_know_every_variant() -> None:
    assert sorted(VARIANTS) == options("variant")


def test_every_experiment_composes(caplog) -> None:
    for experiment in options("experiment"):
        words = ["variant=ddpg"] if "hcfs" in experiment else []
        words += ["task=ring-22", "agent=ppo"] if "ring" in experiment else []
        load("pipeline", [f"experiment={experiment}", *words])
    assert not caplog.text  # whole batches


def test_a_training_has_whole_batches(caplog) -> None:
    cfg = load("train", ["training.environments=128", "training.episodes=4000"])
    assert cfg.training.episodes == 4096
    assert "training.episodes=4000 is rounded up to 4096, whole batches of 128" in caplog.text
    caplog.clear()
    load("evaluate", ["training.environments=128", "training.episodes=4000"])
    assert not caplog.text


def test_a_sweep_can_leave_out_a_term() -> None:
    whole = load("train", ["variant=alcc", "reward.without=null"])
    assert identity(whole) == identity(load("train", ["variant=alcc"]))
    for given in ("safety", "[safety]", "[safety,cav_energy]"):
        removed = given.strip("[]").split(",")
        one = load("train", ["variant=alcc", f"reward.without={given}"])
        other = load("train", ["variant=alcc", *(f"~reward.terms.{name}" for name in removed)])
        assert identity(one) == identity(other) != identity(whole)
        assert {*whole.reward.terms} - {*one.reward.terms} == {*removed}
    words = ["variant=alcc", "reward.without=safety", "reward.terms.safety.threshold=3"]
    run = parsed(composed("train", words), "train", words, sweep=True)  # others have the term
    assert "safety" not in run.reward.terms


def test_every_choice_of_a_group_builds(subtests) -> None:
    for group in ["data", "drivers", "energy", "leader", "logger", "split"]:
        with subtests.test(group=group):
            for option in options(group):
                if option not in OF_FILES:
                    node = getattr(load("train", [f"{group}={option}"]), group)
                    assert node is None or node.made() is not None


def test_a_choice_that_is_there_cannot_be_added() -> None:
    cases = [
        (["experiment=limits", "+experiment=smoke"], "filter is chosen twice: leave one out"),
        (["experiment=limits", "+filter=cbf"], "=cbf: filter is chosen twice"),
        (["agent=td3", "+agent=sac"], "agent is chosen twice: .* without .$"),
        (["+agent=td3", "+agent=sac"], "agent is chosen twice: leave one out"),
        (["experiment=[quickstart,smoke,paper_windows]"], "quickstart is built on paper_wind"),
        (["+event=cut_in", "+event=cut_out"], r"list takes several, '\+event=\[cut_in,cut_out\]'"),
    ]
    check_refused(lambda words: load("train", words), cases, ConfigError)
    both = load("train", ["+event=[cut_in,lost_target]"]).scenario
    assert (*both.sensors, *both.pieces["leader"].settings["at"]) == ("automated", 30.0, 40.0)
    small = load("train", ["experiment=[limits,smoke]"])
    assert small.training.episodes == 24
    assert small.training.segment == small.scenario.horizon == 60  # no warning of nobody's setting
    assert load("train", ["experiment=smoke"]).training.segment == 20
    assert identity(load("train", ["~learning"])) == identity(load("train"))


def test_the_papers_recipes_are_the_defaults() -> None:
    paper, usual = load("train", ["experiment=paper_alcc"]), load("train")
    lengths = [x.training.episodes * x.scenario.horizon for x in (paper, usual)]
    assert lengths == [900_000, 900_000]
    names = ("scenario", "evaluation", "training")
    usual = usual.with_(**{name: getattr(paper, name) for name in names})
    assert identity(paper) == identity(usual)  # it differs in its windows only
    assert (paper.scenario.horizon, paper.evaluation.warm_up) == (300, 0.0)
    plain, recipe = ["variant=ddpg"], ["variant=ddpg", "experiment=paper_hcfs"]
    assert identity(load("train", recipe)) == identity(load("train", plain))


def test_a_tree_survives_its_file() -> None:
    cfg = load("train", ["variant=hcfs", "+knowledge=[memory,preview]"])
    assert as_plain(parse_config(yaml.safe_load(as_text(cfg)))) == as_plain(cfg)


def test_a_node_holds_the_defaults_of_its_class_and_what_was_typed() -> None:
    term = load("train", ["variant=alcc", "reward.terms.safety.margin=0.5"]).reward.terms["safety"]
    held = {TARGET: "lcc_rl.pieces.SafetyReward", **defaults(SafetyReward), "margin": 0.5}
    assert as_plain(term) == held


def test_no_file_repeats_the_default_of_a_class() -> None:
    repeated = []
    for path in set(CONF.rglob("*.yaml")) - set(CONF.glob("hydra/**/*.yaml")):
        content = yaml.safe_load(path.read_text()) or {}
        for key, node, target in settings_at(content):
            if key.endswith(TARGET) and "[" not in key:
                bare = with_defaults({TARGET: target})
                repeated += [
                    f"{path.stem}: {k}"
                    for k in node
                    if k != TARGET and node[k] == bare.get(k, bare)
                ]
    assert repeated == []


def test_another_class_keeps_only_the_settings_that_it_has() -> None:
    words = ["variant=idm", f"{AUTO}._target_=lcc_rl.pieces.LinearACC", f"{AUTO}.time_gap=1.1"]
    node = load("train", words).scenario.controllers["automated"]
    assert node.settings["time_gap"] == 1.1
    assert "noise" not in node.settings


def test_identity_sees_values_and_no_order_or_place() -> None:
    base = identity(load("train"))
    assert identity(load("train", ["seed=1"])) != base
    same = ["trust=[mine]", "logger=rows", "logger.where=/x", "training.keep_every=5"]
    assert identity(load("train", same)) == base


def test_a_setting_at_its_default_does_not_count_where_only_changes_do() -> None:
    place = "scenario.controllers.automated"
    cfg, default, other = (
        load("train", ["variant=idm", *(f"{place}.{word}" for word in words)])
        for words in ((), ("wiener=0",), ("wiener=0.1",))
    )
    own = {TARGET: "lcc_rl.pieces.IDM", "noise": 0.0, "desired_speed": 25.0, "time_gap": 1.2}
    drivers = without_defaults(cfg)["scenario"]["controllers"]
    assert drivers == {"automated": own, "human": {TARGET: "lcc_rl.pieces.IDM"}}
    assert identity(default) == identity(cfg) != identity(other)


def test_a_class_of_ones_own_replaces_the_choice_of_a_group() -> None:
    cfg = load("train", ["energy={_target_: lcc_rl.energy.CirclesFuel, vehicle: Compact}"])
    assert cfg.energy.made().vehicle == "Compact"
    drives = "leader={_target_: lcc_rl.data.leaders.DriveLeaders, path: x.csv}"
    assert load("train", [drives]).leader.made().columns["speed"] == "speed_mps"


def test_a_recipe_for_learners_leaves_no_agent_where_nothing_learns() -> None:
    assert load("train", ["experiment=quickstart", "variant=idm"]).agent is None
    assert load("train", ["variant=idm", "agent=none"]).agent is None


def test_a_configuration_does_not_change_and_returns_others() -> None:
    cfg = load("train", ["variant=alcc", "+filter=cbf"])
    assignments = (
        lambda: setattr(cfg, "seed", 3),
        lambda: setattr(cfg.scenario, "horizon", 20),
        lambda: cfg.scenario.filters.pop("automated"),
        lambda: cfg.reward.terms.update(safety=None),
    )
    for assign in assignments:
        with pytest.raises(AttributeError):
            assign()
    other = cfg.with_(seed=3, scenario={"horizon": 20, "filters": {"automated": None}})
    assert (other.seed, other.scenario.horizon, dict(other.scenario.filters)) == (3, 20, {})
    assert (cfg.seed, cfg.scenario.horizon, [*cfg.scenario.filters]) == (0, 600, ["automated"])
    assert other.scenario.controllers == cfg.scenario.controllers
    cases = [
        ({"sed": 3}, "unknown setting of TrainConfig .*Did you mean 'seed'"),
        ({"scenario": {"horizon": -1}}, r"ScenarioConfig\.horizon must be greater"),
        ({"scenario": {"filters": {"automated": 3}}}, "automated: expected a node"),
        ({"training": {"environments": True}}, r"TrainingConfig\.environments must be .*integer"),
    ]
    check_refused(lambda changes: cfg.with_(**changes), cases, ConfigError)


def test_a_node_is_made_once_copied_as_it_is_and_stored_by_its_settings() -> None:
    cfg = load("train", ["variant=idm", "drivers=fixed"])
    driver, drivers = cfg.scenario.controllers["automated"], cfg.drivers
    assert driver.made() is driver.made()
    assert drivers.made() is not drivers.made()  # a function is called each time
    assert cfg.with_(seed=3).scenario.controllers["automated"] is driver
    there = pickle.loads(pickle.dumps(cfg))
    assert as_plain(there) == as_plain(cfg)
    assert there.scenario.controllers["automated"] == driver
    with pytest.raises(AttributeError, match=r"does not change; use changed\(time_gap=…\)"):
        driver.time_gap = 1.5
    with pytest.raises(TypeError):
        driver.settings["time_gap"] = 1.5
    other = driver.changed(time_gap=1.5)
    assert (other.made().time_gap, driver.made().time_gap) == (1.5, 1.2)
    with pytest.raises(ConfigError, match=rf"^{AUTO}.time_gap must be greater than 0, got -1"):
        driver.changed(time_gap=-1.0)
    with pytest.raises(ConfigError, match=r"^drivers: expected .*\.Observation, got .*\.DriverP"):
        drivers.made(Observation)


def test_settings_are_applied_as_hydra_applies_them() -> None:
    words = ("variant=alcc", "seed=3", "agent=td3", "+filter=cbf", "agent.hidden=[8,4]")
    more = ("+reward.terms.mine={_target_: lcc_rl.pieces.JerkReward}", "~reward.terms.safety")
    for given in (words, (*words, *more), ("experiment=smoke", "agent.gamma=0.5")):
        with initialize_config_module(MODULE, version_base="1.3"):
            expected = compose("train", overrides=as_meant(given))
        assert composed("train", given) == expected, given
