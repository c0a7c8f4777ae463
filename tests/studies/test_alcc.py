"""Settings of the ALCC study: every run composes, and wrong settings are refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from lcc_rl.config.schemas import as_plain
from lcc_rl.errors import ConfigError
from lcc_rl.studies.alcc import study


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
