"""A search by Optuna ends at the wanted number of trials, however often it was stopped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from commands import TINY, run_command
from hydra.core.override_parser.overrides_parser import OverridesParser

from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.runs.search import SearchSweeper, distribution, resumed
from lcc_rl.runs.states import claim

optuna = pytest.importorskip("optuna", reason="extra sweeps")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:sqlalchemy.*")
SPACE = {"agent.gamma": optuna.distributions.FloatDistribution(0.0, 1.0)}


def sweeper(folder: Path, trials: int = 5, **other: Any) -> SearchSweeper:
    settings = {"directions": ["minimize"], "n_jobs": 1, "seed": 0, "params": {}, **other}
    address = f"sqlite:///{folder}/optuna.db"
    return SearchSweeper(storage=address, study_name="lcc_rl", n_trials=trials, **settings)


def begun(folder: Path) -> optuna.Study:
    """Two trials finished, one failed, one was cut off."""
    study = sweeper(folder).study(optuna)
    trials = [study.ask(SPACE) for _ in range(4)]
    for trial in trials[:2]:
        study.tell(trial, 1.0)
    study.tell(trials[2], state=optuna.trial.TrialState.FAIL)
    return study


def test_a_trial_that_was_cut_off_is_tried_first_and_queued_once(tmp_path) -> None:
    study = begun(tmp_path)
    cut_off = study.get_trials()[3].params
    (tmp_path / "run").mkdir()
    with claim(tmp_path / "run"):  # of another process, which has its own trials
        assert resumed(study, tmp_path, 5) == 2
    assert [trial.state.name for trial in study.get_trials()].count("WAITING") == 0
    for _ in range(2):
        assert resumed(study, tmp_path, 5) == 2
    assert study.ask(SPACE).params == cut_off
    assert study.ask(SPACE).params != cut_off


def test_a_resumed_search_draws_what_it_would_have_drawn(tmp_path) -> None:
    drawn = []
    for folder, again in ((tmp_path / "one", False), (tmp_path / "two", True)):
        folder.mkdir()
        search = sweeper(folder)
        study = search.study(optuna)
        values = []
        for _ in range(13):  # the first ten are random
            study = search.study(optuna) if again else study
            trial = search.ask(study, SPACE)
            values.append(trial.params["agent.gamma"])
            study.tell(trial, (values[-1] - 0.3) ** 2)
        drawn.append(values)
    assert drawn[0] == drawn[1]
    assert len(set(drawn[0])) == 13


def test_sweeps_in_hydras_words() -> None:
    kinds = optuna.distributions
    expected = {
        "interval(0.1, 2)": kinds.FloatDistribution(0.1, 2.0),
        "tag(log, interval(1, 10))": kinds.FloatDistribution(1.0, 10.0, log=True),
        "tag(int, interval(1, 9))": kinds.IntDistribution(1, 9),
        "range(1, 4)": kinds.CategoricalDistribution(["1", "2", "3"]),
        "[64,64],[16]": kinds.CategoricalDistribution(["[64,64]", "[16]"]),
    }
    parsed = OverridesParser.create().parse_overrides([f"key={typed}" for typed in expected])
    assert [distribution(optuna, sweep) for sweep in parsed] == list(expected.values())


def test_wrong_settings_are_named(tmp_path) -> None:
    for typed in ("interval(2, 1)", "tag(log, interval(0, 1))"):
        (sweep,) = OverridesParser.create().parse_overrides([f"agent.gamma={typed}"])
        with pytest.raises(ConfigError, match=r"agent\.gamma: expected two numbers"):
            distribution(optuna, sweep)
    with pytest.raises(ConfigError, match="'down'"):
        sweeper(tmp_path, directions=["down"])
    with pytest.raises(ConfigError, match="n_trials"):
        sweeper(tmp_path, trials=0)
    sweeper(tmp_path).study(optuna)
    with pytest.raises(ResultsError, match="1 objectives"):
        sweeper(tmp_path, directions=["minimize", "minimize"]).study(optuna)


@pytest.mark.slow
def test_a_search_from_the_command_line_and_its_resumption(tmp_path) -> None:
    words = ["-m", "variant=reference", *TINY, "hydra/sweeper=lcc_optuna", "sweep=search"]
    words = [*words, "~hydra.sweeper.params", "+hydra.sweeper.params={}"]
    words = [*words, "agent.gamma=interval(0.8,0.99)", "objective=total_path_energy_kj"]
    words = [*words, "hydra.sweeper.directions=[minimize]"]
    run_command("lcc_rl.cli.train", *words, "hydra.sweeper.n_trials=1", cwd=tmp_path, check=True)
    done = run_command(
        "lcc_rl.cli.train", *words, "hydra.sweeper.n_trials=2", cwd=tmp_path, check=True
    )
    folder = tmp_path / "outputs" / "train" / "search"
    best = yaml.safe_load((folder / "optimization_results.yaml").read_text())["best"]
    assert len(list(folder.glob("*/episodes.parquet"))) == 2
    assert len(best) == 1
    assert 0.8 < best[0]["params"]["agent.gamma"] < 0.99
    assert "1 of 2 trials done before" in done.stdout + done.stderr
