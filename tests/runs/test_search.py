"""A search by Optuna ends at the wanted number of trials, however often it was stopped."""

from __future__ import annotations

from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf

from lcc_rl.runs.search import resume_search

optuna = pytest.importorskip("optuna", reason="extra sweeps")
SPACE = {"agent.gamma": optuna.distributions.UniformDistribution(0.0, 1.0)}


def search(folder: Path, trials: int) -> DictConfig:
    sweeper = {
        "_target_": "hydra_plugins.hydra_optuna_sweeper.optuna_sweeper.OptunaSweeper",
        "storage": f"sqlite:///{folder}/optuna.db",
        "study_name": "lcc_rl",
        "n_trials": trials,
    }
    return OmegaConf.create({"hydra": {"sweeper": sweeper, "sweep": {"dir": str(folder)}}})


def begun(folder: Path) -> optuna.Study:
    """Two trials finished, one failed, one was cut off."""
    sweeper = search(folder, 1).hydra.sweeper
    study = optuna.create_study(storage=sweeper.storage, study_name=sweeper.study_name)
    trials = [study.ask(SPACE) for _ in range(4)]
    for trial in trials[:2]:
        study.tell(trial, 1.0)
    study.tell(trials[2], state=optuna.trial.TrialState.FAIL)
    return study


@pytest.mark.parametrize(("wanted", "left"), [(5, 3), (2, 0), (1, 0)])
def test_only_what_lacks_is_left(tmp_path, caplog, wanted, left) -> None:
    begun(tmp_path)
    cfg = search(tmp_path, wanted)
    OmegaConf.set_readonly(cfg, True)
    with caplog.at_level("INFO", "lcc_rl"):
        resume_search(cfg, alone=True)
    assert cfg.hydra.sweeper.n_trials == left
    assert ("finished before" in caplog.text) == (left == 0)


def test_a_trial_that_was_cut_off_is_tried_first_and_queued_once(tmp_path) -> None:
    study = begun(tmp_path)
    lost = study.get_trials()[3].params
    for _ in range(2):
        resume_search(search(tmp_path, 5), alone=True)
    again = study.ask(SPACE)
    assert again.params == lost
    assert study.ask(SPACE).params != lost


def test_the_trials_of_others_at_work_are_left_to_them(tmp_path) -> None:
    study = begun(tmp_path)
    resume_search(search(tmp_path, 5), alone=False)
    assert [trial.state.name for trial in study.get_trials()].count("WAITING") == 0


def test_a_search_that_has_not_begun_and_a_grid_are_left_alone(tmp_path) -> None:
    cfg = search(tmp_path, 5)
    resume_search(cfg, alone=True)
    assert cfg.hydra.sweeper.n_trials == 5
    grid = OmegaConf.create({"hydra": {"sweeper": {"_target_": "hydra…BasicSweeper"}}})
    resume_search(grid, alone=True)
