"""Every task at the size of a test, and rivals by name."""

from pathlib import Path

import pytest
from commands import DATA, tiny
from helpers import slow_but

from lcc_rl.commands import evaluation, training
from lcc_rl.commands.tasks import task_of
from lcc_rl.config import load
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.strategies import BASELINES, DIRECT, rules

TASKS = sorted(path.stem for path in Path("conf/task").glob("*.yaml"))
QUICK = ("i80-follow", "i24-mixed", "ring-22")
FEW = ("experiment=smoke", "evaluation.profiles=2", "scenario.horizon=12")
MORE = {
    "i80-follow": [*DATA, "evaluation.drivers=2"],
    "i24-follow5": DATA,
    "i24-mixed": [*DATA, "scenario.string={size: 8, penetration: 0.25}"],
    "platoon-highway": [*DATA, "leader.least_variation=0"],
}


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize("name", slow_but(QUICK, TASKS))
def test_a_task_compares_rivals_by_name_and_prints_its_scores(name, tmp_path, capsys) -> None:
    words = [f"task={name}", "compare=[pi_saturation]", *FEW, *MORE.get(name, ())]
    cfg = load("evaluate", words)
    rows = evaluation.run(cfg, tmp_path)
    task = task_of(cfg)
    assert set(rows["strategy"]) == {*cfg.evaluation.baselines, "pi_saturation"}
    printed = capsys.readouterr().out
    assert f"task {name}" in printed
    assert f"saved against {task.against}" in printed
    assert "keeps the limits" in printed


def test_rules_have_names_and_others_are_refused(tmp_path) -> None:
    assert {DIRECT, *BASELINES, "follower_stopper", "pi_saturation", "acc"} <= set(rules())
    assert not {"action", "hcfs"} & set(rules())
    cfg = tiny("evaluate", "variant=idm", "compare=[follower_stoper]", agent=False)
    with pytest.raises(Exception, match="follower_stoper"):
        evaluation.run(cfg, tmp_path)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("task.unit=mpg", "unit=mpg"),
        ("task.score=fuel", "task.score"),
        ("+task.limit=3", "limit"),
        ("+task.limits.gap=3", "task.limits 'gap'; valid: max_gap_m"),
    ],
)
def test_mistakes_of_a_task_are_named_before_it_begins(override, words, tmp_path) -> None:
    cfg = load("evaluate", ["task=i80-follow", "compare=[idm]", override])
    with pytest.raises(ConfigError, match=words):
        evaluation.run(cfg, tmp_path / "run")
    assert not (tmp_path / "run" / "episodes.parquet").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["variant=idm", "compare=[follower_stoper]"], "compare.*Did you mean 'follower_stopper'"),
        (["variant=alcc"], "variant alcc is learned: give policy="),
        (["variant=idm", "evaluation.shards=2", "evaluation.shard=2"], "shard must lie from 0 to"),
    ],
)
def test_what_is_wrong_is_said_before_the_data_are_read(
    words, message, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(evaluation, "load_inputs", lambda cfg: pytest.fail("data were read"))
    with pytest.raises(ConfigError, match=message):
        evaluation.run(load("evaluate", words), tmp_path)


def test_a_training_refuses_to_leave_out_shards_of_its_evaluation(tmp_path) -> None:
    cfg = load("train", ["experiment=smoke", "evaluation.shards=2"])
    with pytest.raises(ConfigError, match=r"evaluation.shards=2: a training's evaluation"):
        training.run(cfg, tmp_path)
