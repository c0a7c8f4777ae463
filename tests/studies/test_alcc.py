"""Settings of the ALCC study: every run composes, and wrong settings are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from helpers import check_refused
from table_text import long_table

from lcc_rl.config.schemas import as_plain
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.studies.alcc import study
from lcc_rl.studies.study import Study

NAMES = "data.columns={vehicle: id, time: t, speed: v, leader: ahead, gap: gap}"


def one(folder: Path, recipe: str = "paper_alcc", **more: Any) -> Study:
    return Study(folder, recipe, **{"seeds": 1, **more})


@pytest.mark.slow
def test_every_run_composes_and_each_ablation_changes_the_recipe(tmp_path) -> None:
    own = one(tmp_path)
    main = as_plain(study.alcc_trainings(own, study.MAIN)["alcc/seed_0"])
    seen = []
    for name, change in study.ABLATIONS.items():
        runs = study.alcc_trainings(own, change)
        assert [f"{x}/seed_0" for x in change.variants] == [*runs]
        assert [cfg.variant for cfg in runs.values()] == [*change.variants]
        cfg = as_plain(runs["alcc/seed_0"])
        assert (cfg == main) == (name in ("recipe_paper_alcc", "gamma_0.9"))
        assert cfg == main or cfg not in seen
        seen.append(cfg)
    quick = one(tmp_path, "quickstart")
    found = study.alcc_trainings(quick, study.ABLATIONS["recipe_paper_alcc"])["alcc/seed_0"]
    assert as_plain(found) == main
    single = study.Change(("split.profile=5",), recipes=("single_profile",))
    cfg = study.alcc_trainings(own, single)["alcc/seed_0"]
    assert (cfg.split.made().profile, cfg.scenario.pieces["leader"].made().start) == (5, "first")
    assert cfg.training.episodes == 3000


def test_wrong_settings_come_before_any_work(tmp_path) -> None:
    cases = [
        ({"seeds": 0}, {}, "seeds must lie from 1 to"),
        ({}, {"ablations": ["no_safty"]}, "no_safety"),
        ({"overrides": ("sede=1",)}, {}, "sede"),
        ({}, {"parts": ["ablation"]}, "ablations"),
    ]
    check_refused(lambda own, how: study.run(one(tmp_path, **own), **how), cases, ConfigError)
    assert not list(tmp_path.iterdir())


def test_paths_with_any_character_reach_hydra_whole(tmp_path) -> None:
    folder = tmp_path / "it's a, [strange]=folder"
    cfg = study.alcc_trainings(one(folder, "smoke"), study.MAIN)["alcc/seed_0"]
    assert Path(cfg.data.made().path) == folder / "trajectories.parquet"


def of_one_file(folder: Path, *overrides: str) -> Study:
    """A study of a table that is one recording, calibrated quickly."""
    long_table(cars=4).to_csv(folder / "lab.csv", index=False)
    path = f"data.path='{folder / 'lab.csv'}'"
    quick = [f"calibration.{x}_genetic.generations=2" for x in ("local", "global")]
    words = ("data=table", path, NAMES, *quick, *overrides)
    return one(folder / "study", "smoke", overrides=words)


@pytest.mark.usefixtures("blank_figures")
def test_a_study_of_one_file_divides_it_by_vehicle(tmp_path, monkeypatch) -> None:
    for name in ("train_all", "complete"):
        monkeypatch.setattr(study, name, lambda *arguments: None)
    own = of_one_file(tmp_path, "split.by=vehicle")
    study.run(own, ["main"])
    assert (own.folder / study.DRIVERS_FILE).is_file()
    change = study.ABLATIONS["one_training_profile"]
    single = study.alcc_trainings(own, change)["alcc/seed_0"]
    assert single.split.settings["held_out"].settings["by"] == "vehicle"
    assert single.split.settings["profile"] == 0


def test_a_study_whose_data_cannot_be_divided_leaves_no_file(tmp_path) -> None:
    own = of_one_file(tmp_path)
    with pytest.raises(DataError, match=r"only \['lab'\] found"):
        study.run(own, ["main"])
    assert not own.folder.exists()
