"""Settings of the ALCC study: every run composes, and wrong settings are refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers import POPULATION, wavy_profiles

from lcc_rl.agents.factory import build_agent
from lcc_rl.config.schemas import as_plain, as_text
from lcc_rl.data.profiles import SingleProfile, Split
from lcc_rl.envs import build_env
from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.studies.alcc import report as alcc_report
from lcc_rl.studies.alcc import study as alcc
from lcc_rl.studies.alcc.settings import PRECISE, followers_change, followers_study


def test_every_run_composes_and_each_ablation_changes_the_recipe(tmp_path) -> None:
    study = alcc.Study(tmp_path, "paper_alcc", 1)
    seen = {}
    for name, change in alcc.ABLATIONS.items():
        runs = study.runs(tmp_path, change)
        assert [f"variant={variant}" for variant in change.variants] == [
            run.overrides[1] for run in runs
        ]
        seen.setdefault(as_text(runs[0].compose()), []).append(name)
    main = as_text(study.runs(tmp_path)[0].compose())
    # The recipe itself, and nothing else is.
    assert seen.pop(main) == ["recipe_paper_alcc", "gamma_0.9"]
    assert all(len(names) == 1 for names in seen.values())
    single = alcc.Change(("split.profile=5",), recipes=("single_profile",))
    cfg = study.runs(tmp_path, single)[0].compose()
    assert (cfg.split["profile"], cfg.scenario.pieces["leader"]["start"]) == (5, "first")
    assert cfg.training.episodes == 3000


def test_a_recipe_brings_all_that_it_says_whatever_came_before(tmp_path) -> None:
    paper = alcc.Study(tmp_path, "paper_alcc", 1).runs(tmp_path)[0].compose()
    change = alcc.ABLATIONS["recipe_paper_alcc"]
    found = alcc.Study(tmp_path, "quickstart", 1).runs(tmp_path, change)[0].compose()
    assert as_plain(found) == as_plain(paper)


def test_followers_learn_with_the_analytic_agent_unless_another_is_asked_for(tmp_path) -> None:
    study = alcc.Study(tmp_path, "quickstart", 1)
    change = followers_change(study.overrides, 5)
    cfg = followers_study(study).runs(tmp_path, change)[0].compose()
    assert cfg.agent["_target_"].endswith("Analytic")
    assert cfg.scenario.string == "automated human*5"
    assert change.evaluation == ("evaluation.profiles=null",)
    study = alcc.Study(tmp_path, overrides=("agent=td3", "evaluation.profiles=3"))
    change = followers_change(study.overrides, 1)
    assert change.overrides == (*PRECISE[1:], "scenario.string='automated human*1'")
    assert change.evaluation == ()


def test_settings_of_ddpg_are_not_those_of_the_followers(tmp_path) -> None:
    given = ("agent.batch_size=64", "training.episodes=40", "scenario.horizon=40")
    study = alcc.Study(tmp_path, "quickstart", 1, given)
    cfg = followers_study(study).runs(tmp_path, followers_change(study.overrides, 2))[0].compose()
    assert (cfg.scenario.horizon, cfg.training.episodes) == (40, 30720)
    own = alcc.Study(tmp_path, "quickstart", 1, ("agent=td3", *given))
    cfg = followers_study(own).runs(tmp_path, followers_change(own.overrides, 2))[0].compose()
    assert (cfg.agent["batch_size"], cfg.training.episodes) == (64, 40)


@pytest.mark.parametrize("name", alcc.ABLATIONS)
def test_every_ablation_can_be_built(tmp_path, name) -> None:
    run = alcc.Study(tmp_path, "smoke", 1).runs(tmp_path, alcc.ABLATIONS[name])[0]
    cfg = run.compose()
    if name.startswith("recipe_"):
        cfg.training.environments = 20
    build_env(cfg, wavy_profiles(samples=400), POPULATION, 2).rollout(2)
    build_agent(cfg, POPULATION)
    assert cfg.training.episodes % cfg.training.environments == 0


def test_a_typo_in_an_ablation_costs_no_calibration(tmp_path) -> None:
    study = alcc.Study(tmp_path, ablations=("mine:reward.terms.safty.weight=0",))
    with pytest.raises(ConfigError, match="'safty'"):
        alcc.run(study, ["ablations"], "typed")
    assert not list(tmp_path.iterdir())


def test_the_filter_is_put_on_once(tmp_path) -> None:
    with pytest.raises(ConfigError, match="not both"):
        alcc.run(alcc.Study(tmp_path, overrides=("+filter=cbf",)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"seeds": 0}, "seeds must be at least 1"),
        ({"ablations": ("no_safty",)}, "no_safety"),
    ],
)
def test_impossible_studies(tmp_path, settings, words) -> None:
    with pytest.raises(ConfigError, match=words):
        alcc.Study(tmp_path, **settings)


def test_unknown_parts_and_typing_errors_come_before_any_work(tmp_path) -> None:
    with pytest.raises(ConfigError, match="ablations"):
        alcc.run(alcc.Study(tmp_path, seeds=1), ["ablation"])
    with pytest.raises(ConfigError, match="sede"):
        alcc.run(alcc.Study(tmp_path, seeds=1, overrides=("sede=1",)))
    assert not list(tmp_path.iterdir())


def test_a_folder_without_an_evaluation_has_no_page(tmp_path) -> None:
    with pytest.raises(ResultsError, match=r"no evaluation/episodes\.parquet"):
        alcc_report.write_results(tmp_path)


def test_one_profile_for_both_sides() -> None:
    profiles = wavy_profiles()
    training, evaluation = SingleProfile(profile=2)(profiles)
    assert training.names == evaluation.names == (profiles.names[2],)
    split = Split(by="vehicle", evaluation_share=0.5)
    many, held_out = split(profiles)
    training, evaluation = SingleProfile(profile=1, held_out=split)(profiles)
    assert training.names == (many.names[1],)
    assert evaluation.names == held_out.names
    with pytest.raises(ConfigError, match=r"split\.profile must lie in 0…3"):
        SingleProfile(profile=4)(profiles)


def test_paths_with_any_character_reach_hydra_whole(tmp_path) -> None:
    folder = tmp_path / "it's a, [strange]=folder"
    run = alcc.Study(folder, "smoke", 1).runs(folder / "train")[0]
    assert Path(run.compose().data["path"]) == folder / "trajectories.parquet"
