"""Settings of the ALCC study: every run composes, and wrong settings are refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from table_text import long_table

from lcc_rl.config.schemas import as_plain
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.studies.alcc import study

NAMES = "data.columns={vehicle: id, time: t, speed: v, leader: ahead, gap: gap}"


def test_every_run_composes_and_each_ablation_changes_the_recipe(tmp_path) -> None:
    own = study.Study(tmp_path, "paper_alcc", 1)
    main = as_plain(own.runs(tmp_path, study.MAIN)[0].compose())
    seen = []
    for name, change in study.ABLATIONS.items():
        runs = own.runs(tmp_path, change)
        assert [f"variant={x}" for x in change.variants] == [run.overrides[1] for run in runs]
        cfg = as_plain(runs[0].compose())
        assert (cfg == main) == (name in ("recipe_paper_alcc", "gamma_0.9"))
        assert cfg == main or cfg not in seen
        seen.append(cfg)
    quick = study.Study(tmp_path, "quickstart", 1)
    found = quick.runs(tmp_path, study.ABLATIONS["recipe_paper_alcc"])[0].compose()
    assert as_plain(found) == main
    single = study.Change(("split.profile=5",), recipes=("single_profile",))
    cfg = own.runs(tmp_path, single)[0].compose()
    assert (cfg.split["profile"], cfg.scenario.pieces["leader"]["start"]) == (5, "first")
    assert cfg.training.episodes == 3000


@pytest.mark.parametrize(
    ("settings", "parts", "words"),
    [
        ({"seeds": 0}, ("main", "ablations"), "seeds must lie from 1 to"),
        ({"ablations": ("no_safty",)}, ("main", "ablations"), "no_safety"),
        ({"ablations": ("mine:reward.terms.safty.weight=0",)}, ["ablations"], "safty"),
        ({"overrides": ("sede=1",)}, ("main", "ablations"), "sede"),
        ({}, ["ablation"], "ablations"),
    ],
)
def test_wrong_settings_come_before_any_work(tmp_path, settings, parts, words) -> None:
    with pytest.raises(ConfigError, match=words):
        study.run(study.Study(tmp_path, **settings), parts, "typed")
    assert not list(tmp_path.iterdir())


def test_paths_with_any_character_reach_hydra_whole(tmp_path) -> None:
    folder = tmp_path / "it's a, [strange]=folder"
    run = study.Study(folder, "smoke", 1).runs(folder / "train", study.MAIN)[0]
    assert Path(run.compose().data["path"]) == folder / "trajectories.parquet"


def of_one_file(folder: Path, *overrides: str) -> study.Study:
    """A study of a table that is one recording, calibrated quickly."""
    long_table(cars=4).to_csv(folder / "lab.csv", index=False)
    path = f"data.path='{folder / 'lab.csv'}'"
    quick = [f"calibration.{x}_genetic.generations=2" for x in ("local", "global")]
    return study.Study(
        folder / "study", "smoke", 1, ("data=table", path, NAMES, *quick, *overrides)
    )


def test_a_study_of_one_file_divides_it_by_vehicle(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(study, "run_all", lambda *arguments: [])
    own = of_one_file(tmp_path, "split.by=vehicle")
    assert study.run(own, ["main"], "typed") == []
    assert (own.folder / study.DRIVERS).is_file()
    single = own.runs(tmp_path, study.ABLATIONS["one_training_profile"])[0].compose()
    assert single.split["held_out"]["by"] == "vehicle"
    assert single.split["profile"] == 0


def test_a_study_whose_data_cannot_be_divided_leaves_no_file(tmp_path) -> None:
    own = of_one_file(tmp_path)
    with pytest.raises(DataError, match=r"only \['lab'\] found"):
        study.run(own, ["main"], "typed")
    assert not own.folder.exists()
