"""The ALCC study: every run composes; what is finished, foreign or broken is told apart."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import pytest
from helpers import POPULATION, wavy_profiles
from omegaconf import OmegaConf

from lcc_rl import train
from lcc_rl.data.profiles import SingleProfile, Split
from lcc_rl.envs.factory import build_agent, build_env
from lcc_rl.errors import ConfigError, LccError, ResultsError
from lcc_rl.io.files import read_parquet
from lcc_rl.studies import runner
from lcc_rl.studies.alcc import report as alcc_report
from lcc_rl.studies.alcc import study as alcc
from lcc_rl.studies.runner import FAILED, FINISHED, FOREIGN, Outcome, Run

TINY = (
    "data.platoons=4",
    "data.recordings=2",
    "scenario.horizon=40",
    "training.episodes=8",
    "agent.batch_size=64",
    "agent.hidden=[16,16]",
    "calibration.local_genetic.generations=2",
    "calibration.global_genetic.generations=2",
)


def in_this_process(runs: Sequence[Run], jobs: int) -> list[Outcome]:
    """Train here instead of in processes of their own, which start for seconds."""
    outcomes = []
    for run in runs:
        cfg = run.compose()
        if (run.folder / "checkpoint.pt").exists():
            cfg.resume = str(run.folder)
        try:
            train.run(cfg, run.folder, quiet=True)
            outcomes.append(Outcome(run, FINISHED))
        except LccError as error:
            outcomes.append(Outcome(run, FAILED, str(error)))
    return outcomes


@pytest.fixture
def small(tmp_path, monkeypatch) -> alcc.Study:
    monkeypatch.setattr(runner, "_start", in_this_process)
    return alcc.Study(tmp_path / "a study, its folder", "smoke", 2, TINY, profiles=1)


def test_every_run_composes_and_each_ablation_changes_the_recipe(tmp_path) -> None:
    study = alcc.Study(tmp_path, "paper_alcc", 1)
    seen = {}
    for name, change in alcc.ABLATIONS.items():
        configs = [run.compose() for run in study.runs(tmp_path, change)]
        assert [cfg.variant for cfg in configs] == list(change.variants)
        seen.setdefault(OmegaConf.to_yaml(configs[0]), []).append(name)
    main = OmegaConf.to_yaml(study.runs(tmp_path)[0].compose())
    # The recipe itself, and nothing else is.
    assert seen.pop(main) == ["recipe_paper_alcc", "gamma_0.9"]
    assert all(len(names) == 1 for names in seen.values())
    single = alcc.Change(("split.profile=5",), recipes=("single_profile",))
    cfg = study.runs(tmp_path, single)[0].compose()
    assert (cfg.split.profile, cfg.scenario.pieces.leader.start) == (5, "first")
    assert cfg.training.episodes == 3000


def test_a_recipe_brings_all_that_it_says_whatever_came_before(tmp_path) -> None:
    paper = alcc.Study(tmp_path, "paper_alcc", 1).runs(tmp_path)[0].compose()
    change = alcc.ABLATIONS["recipe_paper_alcc"]
    assert alcc.Study(tmp_path, "quickstart", 1).runs(tmp_path, change)[0].compose() == paper


def test_followers_learn_with_the_analytic_agent_unless_another_is_asked_for(tmp_path) -> None:
    study = alcc.Study(tmp_path, "quickstart", 1)
    change = alcc.followers_change(study, 5)
    cfg = alcc.followers_study(study).runs(tmp_path, change)[0].compose()
    assert cfg.agent._target_.endswith("Analytic")
    assert cfg.scenario.followers == 5
    assert change.evaluation == ("evaluation.profiles=null",)
    study = alcc.Study(tmp_path, overrides=("agent=td3", "evaluation.profiles=3"))
    change = alcc.followers_change(study, 1)
    assert change.overrides == (*alcc.PRECISE[1:], "scenario.followers=1")
    assert change.evaluation == ()


def test_settings_of_ddpg_are_not_those_of_the_followers(tmp_path) -> None:
    given = ("agent.batch_size=64", "training.episodes=40", "scenario.horizon=40")
    study = alcc.Study(tmp_path, "quickstart", 1, given)
    cfg = alcc.followers_study(study).runs(tmp_path, alcc.followers_change(study, 2))[0].compose()
    assert (cfg.scenario.horizon, cfg.training.episodes) == (40, 30720)
    own = alcc.Study(tmp_path, "quickstart", 1, ("agent=td3", *given))
    cfg = alcc.followers_study(own).runs(tmp_path, alcc.followers_change(own, 2))[0].compose()
    assert (cfg.agent.batch_size, cfg.training.episodes) == (64, 40)


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
        alcc.run(alcc.Study(tmp_path, overrides=("+filter=barrier",)))
    assert not list(tmp_path.iterdir())


def test_the_whole_study_in_small(small) -> None:
    outcomes = alcc.run(small, ["main", "filter"])
    study = alcc.Study(**{**vars(small), "seeds": 1, "ablations": ("late:agent.tau=0.01",)})
    outcomes += alcc.run(study, ["ablations", "single"])
    settings = {"overrides": (*TINY, "evaluation.profiles=2"), "followers": (1, 2)}
    strings = alcc.Study(**{**vars(study), **settings})
    outcomes += alcc.run(strings, ["followers"])
    assert [outcome.status for outcome in outcomes] == [FINISHED] * (6 + 2 + 2 + 5)
    page = alcc_report.write_results(study.folder)
    episodes = read_parquet(study.folder / "evaluation" / "episodes.parquet")
    counts = episodes.groupby("strategy")["training_seed"].nunique()
    learned = {"alcc": 2, "own_energy": 2, "reference": 2}
    assert counts.to_dict() == {**learned, "direct": 0, "idm": 0}
    tables = {path.stem for path in (study.folder / "tables").iterdir()}
    assert {"headline", "table_iv", "ablations", "single_profile", "learning"} <= tables
    filtered = read_parquet(study.folder / "tables" / "filter.parquet")
    assert len(filtered) == 3 + 4 * len(alcc.FILTERS)
    with_filter = filtered[filtered["filter"] == "full_speed_0"]
    assert set(with_filter["strategy"]) == {"alcc", "reference", "own_energy", "barrier"}
    assert not with_filter["total_energy_kj"].isin(filtered["total_energy_kj"][:3]).any()
    more = read_parquet(study.folder / "tables" / "followers.parquet")
    assert more[["followers", "strategy"]].to_numpy().tolist() == [
        [number, name] for number in (1, 2) for name in ("alcc", "own_energy", "reference")
    ]
    assert not (study.folder / "followers" / "2" / "reference").exists()  # that of 1 is taken
    saved = more.set_index("strategy")["saving_against_own_energy_pct"]
    assert saved["alcc"].notna().all()
    assert saved["own_energy"].isna().all()
    ablated = read_parquet(study.folder / "tables" / "ablations.parquet")
    assert set(ablated["ablation"]) == {alcc_report.ITSELF, "late"}
    html = page.read_text()
    sections = ("Ablations", "Table IV", "One profile", "A filter", "More human drivers")
    for words in (*sections, "late", "seed_1", "Configuration"):
        assert words in html, words
    # The single profile is both trained on and evaluated on.
    (folder,) = (study.folder / "single").iterdir()
    once = read_parquet(folder / "evaluation" / "episodes.parquet")
    assert once["profile_id"].nunique() == 1
    _everything_is_skipped(study, ["main", "filter", "ablations", "single"])
    _everything_is_skipped(strings, ["followers"])
    _the_page_needs_the_parquet_files_only(study)


def _everything_is_skipped(study: alcc.Study, parts: list[str]) -> None:
    before = {p: p.stat().st_mtime_ns for p in study.folder.rglob("*.parquet")}
    assert {outcome.status for outcome in alcc.run(study, parts)} == {FINISHED}
    assert before == {p: p.stat().st_mtime_ns for p in study.folder.rglob("*.parquet")}


def _the_page_needs_the_parquet_files_only(study: alcc.Study) -> None:
    tables = {p.name: read_parquet(p) for p in (study.folder / "tables").iterdir()}
    for path in (*study.folder.rglob("*.pt"), *(study.folder / "tables").iterdir()):
        path.unlink()
    alcc_report.write_results(study.folder)
    for name, frame in tables.items():
        again = read_parquet(study.folder / "tables" / name)
        pd.testing.assert_frame_equal(frame, again, check_exact=True)


def test_foreign_and_broken_runs_do_not_stop_the_others(small) -> None:
    study = small
    alcc.run(study, ["main"])
    train_folder = study.folder / "train"
    broken, other = train_folder / "alcc" / "seed_0", train_folder / "alcc" / "seed_1"
    (broken / "episodes.parquet").unlink()
    (broken / "checkpoint.pt").write_bytes(b"no checkpoint")
    text = (other / "config.yaml").read_text()
    (other / "config.yaml").write_text(text.replace("tau: 0.005", "tau: 0.5"))
    outcomes = {outcome.run.folder: outcome for outcome in alcc.run(study, ["main"])}
    assert outcomes[broken].status == FAILED
    assert "checkpoint.pt" in outcomes[broken].note
    assert outcomes[other].status == FOREIGN
    assert outcomes[other].note == "agent.tau: 0.5 → 0.005"
    episodes = read_parquet(study.folder / "evaluation" / "episodes.parquet")
    assert set(episodes["strategy"]) == {"direct", "idm", "reference", "own_energy"}
    alcc_report.write_results(study.folder)  # without alcc, some sections are left out
    problems = json.loads((study.folder / runner.NOTES).read_text())["problems"]
    assert set(problems) == {"train/alcc/seed_0", "train/alcc/seed_1"}
    # Accepted, the same run counts as finished; the broken one is made anew.
    (broken / "checkpoint.pt").unlink()
    accepting = alcc.Study(**{**vars(study), "accept": ("agent",)})
    assert {outcome.status for outcome in alcc.run(accepting, ["main"])} == {FINISHED}
    assert json.loads((study.folder / runner.NOTES).read_text())["problems"] == {}
    episodes = read_parquet(study.folder / "evaluation" / "episodes.parquet")
    assert episodes["strategy"].nunique() == 5


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


def test_a_part_alone_has_a_page(small) -> None:
    study = alcc.Study(**{**vars(small), "seeds": 1, "ablations": ("late:agent.tau=0.01",)})
    alcc.run(study, ["ablations"])
    assert "late" in alcc_report.write_results(study.folder).read_text()


def test_a_folder_without_an_evaluation_has_no_page(tmp_path) -> None:
    with pytest.raises(ResultsError, match=r"no evaluation/episodes\.parquet"):
        alcc_report.write_results(tmp_path)


def test_one_profile_for_both_sides() -> None:
    profiles = wavy_profiles()
    training, evaluation = SingleProfile(2)(profiles)
    assert training.names == evaluation.names == (profiles.names[2],)
    split = Split("vehicle", 0.5)
    many, held_out = split(profiles)
    training, evaluation = SingleProfile(1, split)(profiles)
    assert training.names == (many.names[1],)
    assert evaluation.names == held_out.names
    with pytest.raises(ConfigError, match=r"split\.profile must lie in 0…3"):
        SingleProfile(4)(profiles)


def test_paths_with_any_character_reach_hydra_whole(tmp_path) -> None:
    folder = tmp_path / "it's a, [strange]=folder"
    run = alcc.Study(folder, "smoke", 1).runs(folder / "train")[0]
    assert Path(run.compose().data.path) == folder / "trajectories.parquet"
