"""An evaluation builds each environment once, before files are written."""

from __future__ import annotations

import sys

import pytest

import lcc_rl
from lcc_rl.envs import factory
from lcc_rl.evaluation import comparison

SMALL = ("evaluation.profiles=2", "evaluation.drivers=2", "scenario.horizon=40")
SMALL += ("evaluation.warm_up=0",)


@pytest.fixture
def built(monkeypatch) -> list[int]:
    """The batch sizes of environments that are built."""
    found, build = [], factory.build_env

    def counted(*args, **given):
        found.append(args[3])
        return build(*args, **given)

    for module in [x for name, x in sys.modules.items() if name.startswith("lcc_rl")]:
        if getattr(module, "build_env", None) is build:
            monkeypatch.setattr(module, "build_env", counted)
    return found


def test_a_comparison_builds_one_environment_for_each_strategy(
    built, tmp_path, monkeypatch, caplog
) -> None:
    monkeypatch.setattr(comparison, "BETWEEN_LINES", 0.0)
    caplog.set_level("INFO")
    rules = ["idm_acc_filtered", "acc_filtered"]
    run = lcc_rl.compare(rules, "alcc", ["+filter=cbf", *SMALL], tmp_path / "run")
    assert len(built) == run.rows["strategy"].nunique()
    assert caplog.text.count(": episode 4/4 ") == len(built)  # a line each, if they last


def test_a_training_builds_a_trial_its_own_environment_and_that_of_the_evaluation(
    built, tmp_path
) -> None:
    lcc_rl.learn("alcc", ["experiment=smoke", "training.episodes=20"], tmp_path / "run")
    assert len(built) == 3
