"""Every task at the size of a test, with a rule to compare with."""

from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import DATA
from helpers import check_refused, slow_but

from lcc_rl.api import Run
from lcc_rl.cli.table import main as table_again
from lcc_rl.commands import evaluation
from lcc_rl.config import load
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.fit import other_drivers, task_of
from lcc_rl.results.names import in_words

TASKS = sorted(path.stem for path in Path("conf/task").glob("*.yaml"))
QUICK = ("i80-follow", "ring-22")
FEW = ("experiment=smoke", "evaluation.profiles=2", "scenario.horizon=12")
MORE = {
    "i80-follow": [*DATA, "evaluation.drivers=2"],
    "ring-22": ["evaluation.profiles=1"],  # no interval, as wide as its episodes are short
    "i24-follow5": DATA,
    # One window: with an interval below −10 % its table is 81 columns wide.
    "i24-fleet": [*DATA, "scenario.string='(automated human)*2'", "evaluation.profiles=1"],
    "i24-mixed": [*DATA, "scenario.string={size: 8, penetration: 0.25}"],
    "platoon-highway": [*DATA, "leader.least_variation=0"],
}


def test_a_task_brings_its_leaders_whatever_the_variant() -> None:
    for task in TASKS:
        own, other = (
            load("evaluate", [f"task={task}", *more]).leader for more in ([], ["variant=cacc"])
        )
        assert other == own, task


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize("name", slow_but(QUICK, TASKS))
def test_a_task_compares_rivals_by_name_and_prints_its_scores(name, tmp_path, capsys) -> None:
    cfg = load("evaluate", [f"task={name}", "compare=[pi_saturation]", *FEW, *MORE.get(name, ())])
    rows = evaluation.run(cfg, tmp_path)
    assert set(rows["strategy"]) == {*cfg.evaluation.baselines, "pi_saturation"}
    printed = capsys.readouterr().out
    assert f"{name}: " in printed
    against = in_words(task_of(cfg).against)
    words = (
        f"no saving: the baseline, {against}," if name == "ring-22" else f"saved: against {against}"
    )
    assert words in " ".join(printed.split())
    assert max(map(len, printed.splitlines())) <= 80
    # The same table again, by program and for a paper: the task's score in its unit.
    run = Run(tmp_path, rows, cfg)
    for line in str(run).splitlines()[4:8]:
        assert line.strip() in printed
    assert run.reports()[0].label == task_of(cfg).label
    table_again([str(tmp_path), "--format", "csv"])
    again = pd.read_csv(StringIO(capsys.readouterr().out))
    np.testing.assert_allclose(again["score"], run.headline["score"])
    table_again([str(tmp_path), "--all", "--format", "csv"])
    every = pd.read_csv(StringIO(capsys.readouterr().out))
    np.testing.assert_allclose(every["score"], run.headline["score"])
    limits = task_of(cfg).limits
    assert {*limits, *(f"limit_{x}" for x in limits), "total_path_energy_kj"} <= set(every)
    table_again([str(tmp_path), "--format", "latex", "--columns", "driver,saved_pct"])
    heads = capsys.readouterr().out.splitlines()[2]
    assert heads.split(" & ") == ["driven by", r"saved [\%] \\"]
    with pytest.raises(ConfigError, match="Did you mean 'saved_pct'"):
        table_again([str(tmp_path), "--columns", "saved"])
    with pytest.raises(ConfigError, match="--against, --unit need a run's folder"):
        table_again(["a.parquet", "--against", "idm", "--unit", "mpg"])


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize("name", slow_but(["i24-mixed"], ["i24-mixed", "ring-22"]))
def test_the_share_0_of_a_task_is_a_table_of_humans(name, tmp_path, capsys, caplog) -> None:
    share = "scenario.string={size: 8, penetration: 0}"
    words = [f"task={name}", "compare=[pretrained,idm_acc]", *FEW, *MORE.get(name, ()), share]
    rows = evaluation.run(load("evaluate", words), tmp_path)
    assert set(rows["strategy"]) == {"direct"}
    (line,) = (x for x in capsys.readouterr().out.splitlines() if x.startswith("no automated car"))
    assert line.split()[-2:] == ["0", "yes"]
    assert "left out: pretrained, idm_acc" in caplog.text


def test_mistakes_are_named_before_the_data_are_read(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(evaluation, "load_inputs", lambda cfg: pytest.fail("data were read"))
    task, flow = "task=i80-follow compare=[idm]", "+task.limits.flow_vph"
    cases = {
        f"{task} task.unit=mpg": "unit=mpg",
        "task.unit=kWh/100km compare=[idm]": "task.name is required: choose a task, such as task=",
        f"{task} +task.limits.gap=3": "task.limits 'gap'",
        f"{task} {flow}=recorded": "flow_vph=recorded: add recorded to evaluation.baselines",
        f"{task} {flow}=-5": r"flow_vph: must be a number of .* 0, recorded, or a share .*, got -5",
        "variant=idm compare=[follower_stoper]": "follower_stopper",
        "variant=idm compare=[hcfs]": "variant hcfs is learned: compare the run folder",
        "variant=alcc": "variant alcc is learned: give policy=",
        "variant=idm evaluation.shards=2 evaluation.shard=2": "shard must lie from 0 to",
        "variant=cacc evaluation.warm_up=5": "warm_up needs evaluation.rows=episodes",
    }
    check_refused(
        lambda words: evaluation.run(load("evaluate", words.split()), tmp_path),
        cases.items(),
        ConfigError,
    )


DRIVERS = sorted(path.stem for path in Path("conf/drivers").glob("*.yaml"))


@pytest.mark.parametrize("each", slow_but([1], [1, len(DRIVERS)]))
def test_any_population_fits_any_task(each) -> None:
    path = "drivers.path=lcc_rl/assets/i80_drivers.parquet"
    for place, task in enumerate(TASKS):
        own = load("evaluate", [f"task={task}"])
        assert other_drivers(own) == "", task
        for name in (DRIVERS[(place + turn) % len(DRIVERS)] for turn in range(each)):
            words = [f"task={task}", f"drivers={name}"]
            cfg = load("evaluate", [*words, path] if name == "calibrated" else words)
            alone = load("evaluate", [f"drivers={name}", *[path] * (name == "calibrated")])
            assert cfg.drivers == alone.drivers, words
            driven = cfg.drivers != own.drivers and "human" in cfg.scenario.vehicles.names
            assert bool(other_drivers(cfg)) == driven, words
    # The noise of the task's drivers has gone with them.
    human = load("evaluate", ["task=i24-mixed", "drivers=i80"]).scenario.controllers["human"]
    assert human == load("evaluate", ["drivers=i80"]).scenario.controllers["human"]
