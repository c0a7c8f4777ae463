"""Bad input that would otherwise pass unnoticed, fail late, or run someone else's code."""

from __future__ import annotations

import os
import re

import pandas as pd
import pytest
import torch
from commands import QUICK, UNTRAINED, tiny
from omegaconf import OmegaConf

from lcc_rl import results
from lcc_rl.commands import calibration, evaluation, training
from lcc_rl.config import load, plain
from lcc_rl.config_checks import AUTO, RENAMED
from lcc_rl.config_errors import check_keys
from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.io import files
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.io.tensors import read_torch, write_torch
from lcc_rl.results.policies import load_policy, save_policy
from lcc_rl.results.runs import load_config
from lcc_rl.results.trust import check_targets


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("sead=3", r"unknown option 'sead'.*Did you mean 'seed'"),
        ("+sead=3", r"unknown option 'sead'.*Did you mean 'seed'"),
        ("++sead=3", r"unknown option 'sead'.*Did you mean 'seed'"),
        ("agent=dddpg", r"unknown choice of agent 'dddpg'.*Did you mean 'ddpg'"),
        ("agnet=ddpg", r"unknown option 'agnet'.*Did you mean 'agent'"),
        ("experimnt=smoke", r"Did you mean 'experiment'"),
        ("reward.terms.safety.wieght=1", r"setting of reward.terms.safety.*'weight'"),
        ("reward.termz.safety.weight=1", r"setting of reward 'termz'.*'terms'"),
        ("~reward.terms.safty", r"Did you mean 'safety'"),
        ("+training.epsodes=3", r"setting of training 'epsodes'.*'episodes'"),
        ("+evaluation.driver=3", r"Did you mean 'drivers'"),
        ("seed=abc", r"seed=abc: Value 'abc' .* Integer"),
        ("hydra.swep.dir=x", r"Did you mean 'sweep'"),
        ("gains=tuned", r"variant alcc has no gains to choose; leave gains=… out"),
        ("hydra/launcher=cluster", r"unknown choice of hydra/launcher 'cluster'"),
    ],
)
def test_a_wrong_option_names_the_nearest_one(override, words) -> None:
    with pytest.raises(ConfigError, match=words):
        load("train", [override])


def test_names_that_exist_only_with_the_other_overrides_are_known() -> None:
    words = r"setting of scenario.controllers.automated \(IDM\) 'desired_sped'.*'desired_speed'"
    with pytest.raises(ConfigError, match=words):
        load("train", ["variant=idm", "scenario.controllers.automated.desired_sped=3"])


def test_what_the_schema_knows_passes() -> None:
    check_keys(load("train", ["+reward.terms.x={_target_: mine.X}", "experiment=smoke"]))


@pytest.mark.slow
def test_a_filter_is_put_on_the_policy_of_a_platoon_and_not_on_baselines(tmp_path) -> None:
    words = ["variant=ddpg", "policy=pretrained", "experiment=smoke", "scenario.horizon=40"]
    gaps = [
        evaluation.run(load("evaluate", [*words, *more]), tmp_path / str(i), quiet=True)
        .groupby("strategy")["min_gap_m"]
        .min()
        for i, more in enumerate(([], ["+filter=cbf"]))
    ]
    changed = gaps[0] != gaps[1]
    assert list(changed[changed].index) == ["ddpg"]


def test_a_recipe_of_another_agent_names_the_agent_and_its_own_settings(tmp_path) -> None:
    cfg = load("train", ["experiment=quickstart", "agent=analytic"])
    words = r"agent \(AnalyticSettings\) 'batch_size'; valid: bootstrap, "
    with pytest.raises(ConfigError, match=words):
        training.run(cfg, tmp_path)


def test_a_learned_variant_without_an_agent_is_refused(tmp_path) -> None:
    cfg = tiny("train", "variant=alcc", "agent=none", agent=False)
    with pytest.raises(ConfigError, match="variant=alcc is a learned controller"):
        training.run(cfg, tmp_path)
    assert "learned controller" in (tmp_path / "error.txt").read_text()


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["variant=idm", "agent=ddpg"], "variant=idm learns nothing: remove agent="),
        (["variant=direct", "agent=analytic"], "variant=direct learns nothing: remove agent="),
        (["variant=cacc", "agent=analytic"], "variant=cacc learns nothing: remove agent="),
    ],
)
def test_a_learner_is_no_variant_that_learns_nothing(tmp_path, overrides, words) -> None:
    with pytest.raises(ConfigError, match=words):
        training.run(load("train", [*overrides, "experiment=smoke"]), tmp_path)


@pytest.mark.parametrize("given", ["experiment=smok", "experiment=[smok]"])
def test_a_wrong_recipe_names_those_that_exist(given) -> None:
    with pytest.raises(ConfigError, match=r"paper_alcc, .*Did you mean 'smoke'"):
        load("train", [given])


@pytest.mark.parametrize(
    "override",
    ["agent.gamma=1.5", "training.episodes=25"],
)
def test_settings_are_checked_before_the_data_are_read(tmp_path, override) -> None:
    # The data do not exist: whoever reads them first says so instead.
    cfg = tiny("train", override)
    OmegaConf.set_struct(cfg, False)
    cfg.data = {"_target_": "lcc_rl.data.sources.EpisodesSource", "path": "nowhere.parquet"}
    with pytest.raises(ConfigError, match=override.split("=")[0].split(".")[-1]):
        training.run(cfg, tmp_path)


def test_asking_for_more_than_there_is_is_said(caplog, tmp_path) -> None:
    cfg = tiny("train", "variant=idm", "evaluation.profiles=5000", agent=False)
    with caplog.at_level("INFO", logger="lcc_rl"):
        training.run(cfg, tmp_path, quiet=True)
    assert "evaluation.profiles=5000: only " in caplog.text


def test_calibration_says_what_it_was_made_with(tmp_path) -> None:
    words = ["data.platoons=3", "data.recordings=1", QUICK]
    calibration.run(load("calibrate", words), tmp_path)
    assert results.load(tmp_path, "drivers")["data.platoons"].eq(3).all()


# -- options of former releases, and options without effect ----------------------------------------

# An example of every entry of RENAMED, in its order, and what the error must name.
FORMER = (
    ("scenario.followers=5", "scenario.string='automated human*5'"),
    ("variant=barrier", "variant=cbf"),
    ("+filter=barrier", "+filter=cbf"),
    ("scenario=direct", "scenario.string=human"),
    ("scenario.pieces.cav.initial_gap_range=[1,1]", "training.gap_range=[1,1]"),
    ("scenario.pieces.cav.initial_time_gap=1", "scenario.start.automated.time_gap=1"),
    ("scenario.pieces.cav.standstill_gap=3", "scenario.start.automated.standstill_gap=3"),
    ("scenario.pieces.cav.max_acceleration=2", f"{AUTO}.max_acceleration=2"),
    ("scenario.pieces.hdv.cap_time_gap=2", "scenario.start.human.cap_time_gap=2"),
    ("scenario.pieces.hdv.noise=0", "scenario.controllers.human.noise=0"),
    ("scenario.pieces.platoon.safe_headway=4", "scenario.start.automated.headway=4"),
    ("scenario.pieces.platoon.gap_spread=1", "scenario.start.automated.gap_spread=1"),
    ("scenario.pieces.errors.delay=0", "scenario.pieces.communication.delay=0"),
    ("scenario.pieces.barrier.rate=2", "scenario.filters.automated.rate=2"),
    ("scenario.pieces.hdv_power.recuperation=false", "scenario.pieces.power.recuperation=false"),
    ("scenario.pieces.hdv_predicted_power.x=1", "scenario.pieces.predicted_power.x=1"),
    ("observation.scales.cav.gap=0.2", "observation.scales.self.gap=0.2"),
    ("observation.scales.hdv.gap=0.2", "observation.scales.behind.gap=0.2"),
    ("agent=coast", f"controller@{AUTO}=constant agent=none"),
    ("agent=deadbeat", f"controller@{AUTO}=deadbeat agent=none"),
    ("agent.final_share=0.1", "agent.final_lr_fraction=0.1"),
    ("agent.sampled=true", f"{AUTO}.desired_speed=null {AUTO}.time_gap=null"),
    ("agent.k1=0.1", f"{AUTO}.k1=0.1"),
    ("controller.jerk_bound=10", "deployed.jerk_bound=10"),
)


def test_every_renamed_option_has_an_example() -> None:
    matched = [next(old for old, _ in RENAMED if re.match(old, item)) for item, _ in FORMER]
    assert matched == [old for old, _ in RENAMED]


@pytest.mark.parametrize("entry", ["calibrate", "pipeline"])
def test_an_option_that_is_gone_says_why(entry) -> None:
    with pytest.raises(
        ConfigError, match=r"^calibration.compiled=true: .* no longer exists: .*numba"
    ):
        load(entry, ["calibration.compiled=true"])


@pytest.mark.parametrize(("item", "new"), FORMER)
def test_an_option_of_a_former_release_names_todays_in_one_line(item, new) -> None:
    with pytest.raises(ConfigError) as caught:
        load("train", [item])
    said = str(caught.value)
    assert said.startswith(f"{item}: this option has a new name; say {new}")
    assert "\n" not in said


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["variant=cacc", "data=ngsim", "data.path=x", "split.by=vehicle"], "drives the records"),
        (["variant=cacc", "split.by=vehicle"], "leader=trajectories"),
        (["variant=cacc", "drivers=kde"], "there is no human driver"),
        (["scenario=ring", "agent=none", "split.by=vehicle"], "a ring road has no leader"),
        (["scenario.circumference=200"], "belongs to scenario.road=ring"),
        (["variant=idm", "training.episodes=20"], "variant idm learns nothing"),
        (["variant=direct", f"{AUTO}.max_acceleration=2"], "no vehicle of the string is automated"),
        (["variant=cacc", "scenario.controllers.human.noise=0"], "no vehicle of the string is"),
        (["evaluation.full_length=true"], "unused with evaluation.rows=episodes"),
        (["variant=cacc", "evaluation.batch_size=9"], "unused with evaluation.rows=vehicles"),
        (
            ["experiment=limits", "agent.policy=idm", "agent.hidden=[32]"],
            "policy=idm has no layers",
        ),
        (["experiment=limits", "agent.tau=0.3"], "bootstrap=false learns no value"),
        (["agent=analytic", "agent.limit_rate=0.3"], "agent.limits is empty"),
        (["variant=hcfs", "deployed.spacing_time=5"], "deployed.spacing_weight is 0"),
    ],
)
def test_options_without_effect_are_refused(overrides, words) -> None:
    with pytest.raises(ConfigError, match=rf"has no effect: .*({words})"):
        load("train", overrides)


def test_saying_twice_that_nothing_is_learned_is_no_error() -> None:
    assert load("train", ["variant=idm", "agent=none"]).agent is None


@pytest.mark.parametrize(
    ("string", "words"),
    [
        ("automated bus", r"role 'bus', but .* only automated, human"),
        ("automated (human*2", r"never closed at character 11: automated »\(human\*2"),
        ("automated human*x", r"at character 16"),
        ("automated human)", r"at character 16"),
    ],
)
def test_a_mistake_in_the_string_is_pointed_at(tmp_path, string, words) -> None:
    with pytest.raises(ConfigError, match=words):
        training.run(tiny("train", f"scenario.string='{string}'"), tmp_path, quiet=True)


def test_a_string_in_which_nobody_is_automated(tmp_path) -> None:
    nobody = "scenario.string={size: 10, penetration: 0}"
    with pytest.raises(ConfigError, match=r"nobody is automated.* say agent=none"):
        training.run(tiny("train", "variant=alcc", nobody), tmp_path / "a", quiet=True)
    cfg = tiny("evaluate", "variant=alcc", nobody, "agent=none", agent=False)
    rows = evaluation.run(cfg, tmp_path / "b", quiet=True)
    assert set(rows["strategy"]) == {"direct"}
    assert (rows["hdv_energy_kj"] > 0).all()


# -- what comes with results ----------------------------------------------------------------------


def policy_file(path, **changes) -> None:
    cfg = OmegaConf.create(plain(tiny("train", "variant=alcc")))
    for key, value in changes.items():
        OmegaConf.update(cfg, key.replace("__", "."), value)
    save_policy({"w": torch.ones(1)}, cfg, path)


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "subprocess.Popen",
        "lcc_rl.config.import_module",
        "lcc_rl.data.sources.Path",
        "lcc_rl.io.files.write_parquet",
        "mine.Comfort",
    ],
)
def test_a_policy_that_names_foreign_code_is_refused(tmp_path, target) -> None:
    path = tmp_path / "policy.pt"
    policy_file(path, agent___target_=target)
    with pytest.raises(ResultsError, match=rf"policy\.pt: agent\._target_ names '{target}'"):
        load_policy(path)


def test_ones_own_module_can_be_trusted_by_name(tmp_path) -> None:
    path = tmp_path / "policy.pt"
    policy_file(path, reward__terms__safety___target_="mine.Comfort")
    assert load_policy(path, trust=["mine"])[1].variant == "alcc"
    with pytest.raises(ResultsError, match=r"say trust=\[mine\]"):
        load_policy(path, trust=["other"])


def test_every_shipped_configuration_is_trusted() -> None:
    for variant in ("alcc", "reference", "idm", "direct"):
        check_targets(plain(load("train", [f"variant={variant}"])), "shipped")


def test_references_in_a_stored_configuration_are_refused(tmp_path) -> None:
    (tmp_path / "config.yaml").write_text("variant: alcc\nseed: ${oc.env:HOME}\n")
    with pytest.raises(ResultsError, match="seed refers to"):
        load_config(tmp_path)


@pytest.mark.parametrize("text", ["- 1", "variant: [", "!!python/object:os.system {}", "x: 1"])
def test_damaged_or_malicious_configurations(tmp_path, text) -> None:
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ResultsError, match=r"config\.yaml"):
        load_config(tmp_path)


@pytest.mark.slow
def test_two_policies_that_rows_cannot_tell_apart(tmp_path) -> None:
    folder = tmp_path / "one"
    training.run(tiny("train", "variant=alcc"), folder, quiet=True)
    cfg = tiny("evaluate", "variant=alcc", f"policy={folder}", f"compare=[{folder}]")
    with pytest.raises(ConfigError, match="two policies of variant alcc with training seed 0"):
        evaluation.run(cfg, tmp_path / "b")


@pytest.mark.slow
def test_policies_of_two_agents_stand_side_by_side(tmp_path) -> None:
    for agent in ("ddpg", "analytic"):
        cfg = tiny("train", "variant=alcc", f"agent={agent}", agent=False)
        training.run(cfg, tmp_path / agent, quiet=True)
    compared = f"compare=[{tmp_path / 'analytic'}]"
    cfg = tiny("evaluate", "variant=alcc", f"policy={tmp_path / 'ddpg'}", compared, agent=False)
    rows = evaluation.run(cfg, tmp_path / "both", quiet=True)
    assert list(rows["strategy"].unique()) == [*UNTRAINED, "alcc analytic", "alcc ddpg"]
    energies = rows.groupby("strategy")["total_energy_kj"].mean()
    assert energies["alcc analytic"] != energies["alcc ddpg"]


# -- files ----------------------------------------------------------------------------------------


def test_an_older_table_is_migrated(tmp_path, monkeypatch) -> None:
    path = tmp_path / "a.parquet"
    write_parquet(pd.DataFrame({"energy": [1.0]}), path)
    monkeypatch.setattr(files, "SCHEMA_VERSION", "3")
    rename = {"energy": "energy_kj"}
    steps = {1: lambda f: f.rename(columns=rename), 2: lambda f: f.assign(unit="kJ")}
    monkeypatch.setattr(files, "MIGRATIONS", steps)
    assert read_parquet(path).to_dict("list") == {"energy_kj": [1.0], "unit": ["kJ"]}


def test_one_wrong_byte_in_weights_is_noticed(tmp_path) -> None:
    path = tmp_path / "policy.pt"
    write_torch({"w": torch.randn(5000)}, path)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x10
    path.write_bytes(content)
    with pytest.raises(ResultsError, match=r"policy\.pt"):
        read_torch(path)


def test_a_killed_writer_leaves_nothing_that_is_read(tmp_path) -> None:
    (tmp_path / f".episodes.parquet.{os.getpid()}.tmp").write_bytes(b"PAR1 half")
    with pytest.raises(ResultsError, match=r"no episodes\.parquet"):
        results.load(tmp_path)
