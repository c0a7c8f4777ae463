"""What limits the numbers of an evaluation is measured, and said in the log and the table."""

from __future__ import annotations

import logging
import shlex

import numpy as np
import pandas as pd
import pytest
import torch
from commands import tiny

from lcc_rl.api import Run
from lcc_rl.commands import evaluation
from lcc_rl.config import load
from lcc_rl.data.leaders import stretch
from lcc_rl.data.profiles import from_records
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.named import controller_of
from lcc_rl.evaluation.rows import leader_faster
from lcc_rl.results.measures import FASTER, REACH
from lcc_rl.results.names import in_words
from lcc_rl.results.remarks import leader_too_fast, remarks
from lcc_rl.results.report import windows_for


def test_the_share_of_time_by_hand() -> None:
    records = [torch.tensor([10.0, 20.0, 30.0, 30.0]), torch.full((4,), 5.0)]
    profiles = from_records(records, ["a", "b"], ["x", "x"], 0.1)
    shares = leader_faster(
        profiles, torch.tensor([1, 0, 0, 0, 0]), np.array([4.0, 25.0, 20.0, 30.0, 9.0])
    )
    assert shares.tolist() == [1.0, 0.5, 0.5, 0.0, 1.0]


@pytest.mark.parametrize(
    ("v0", "others", "said"), [(2.0, False, True), (40.0, False, False), (2.0, True, False)]
)
def test_slow_drivers_behind_faster_leaders_are_said(tmp_path, caplog, v0, others, said) -> None:
    words = ["variant=alcc", "agent=none", "scenario.string=human", "drivers=fixed"]
    start = "scenario.start.human=${scenario.start.automated}"
    words += ["controller@scenario.controllers.human=acc", start] * others
    cfg = tiny("evaluate", *words, f"drivers.desired_speed={v0}", agent=False)
    with caplog.at_level(logging.WARNING, logger="lcc_rl"):
        rows = evaluation.run(cfg, tmp_path, quiet=True)
    assert (rows[FASTER].mean() > 0.5) == said
    assert rows[["desired_speed_mps", "time_gap_s"]].isna().all(axis=None) == others
    assert ("Raise v0: drivers=highway" in caplog.text) == said


def test_every_baseline_with_a_desired_speed_is_warned_of() -> None:
    shares = {"direct": 0.3, "human": 0.3, "idm": 0.1, "recorded": np.nan, "alcc": 0.3}
    shares |= {"acc_filtered": 1.0, "idm_acc_filtered X=1.2": 1.0, "mine": 0.9}
    rows = pd.DataFrame({"strategy": shares.keys(), FASTER: shares.values()})
    said = [line.split("speed of ")[1].split()[0] for line in leader_too_fast(windows_for(rows))]
    assert said == ["direct", "human", "mine"]


def test_the_remedy_for_a_controller_is_an_option() -> None:
    rows = pd.DataFrame({"strategy": ["human", "acc", "mine"], FASTER: [0.1, 0.9, 0.8]})
    acc, mine = (line.split("Raise v0: ")[1] for line in leader_too_fast(windows_for(rows)))
    assert mine == "desired_speed: 45 beside its other settings in compare="
    words = shlex.split(acc)
    assert words.pop() == "compare=[<run>]"
    faster, tuned = load("evaluate", words).scenario.controllers["automated"], controller_of("acc")
    assert faster.settings == {**tuned.settings, "desired_speed": 45}


def test_a_scale_that_makes_a_leader_implausibly_fast() -> None:
    assert stretch("udds", 0.1, scale=2.0).speeds.max() > 50.0
    with pytest.raises(ConfigError, match=r"udds at scale=100 drives up to .* m/s, leader.plaus"):
        stretch("udds", 0.1, scale=100.0)


CARS = ("compact", "midsize", "suv", "pickup", "electric")
ONLY_TRUCKS = ["energy=mixture", *(f"energy.shares.{name}=0" for name in CARS)]


@pytest.mark.parametrize(
    "words",
    [
        ["variant=idm", "energy=fuel", "energy.vehicle=Class8Tractor"],
        ["task=i24-follow5", "compare=[idm_acc]", "task.unit=kJ/km", *ONLY_TRUCKS],
    ],
)
def test_what_no_truck_can_do_is_said_in_log_and_table(tmp_path, caplog, words) -> None:
    cfg = tiny("evaluate", *words, agent=False)
    with caplog.at_level(logging.WARNING, logger="lcc_rl"):
        rows = evaluation.run(cfg, tmp_path, quiet=True)
    (line,) = remarks(windows_for(rows))
    shares = rows.groupby("strategy")[list(REACH)].mean().max(axis=1)
    assert f"{in_words(shares.idxmax())} {shares.max():.2%}" in line
    assert line in caplog.text
    (found,) = evaluation.reports(rows, cfg)
    assert line in found.note
    for full in (False, True):
        assert line in " ".join(Run(tmp_path, rows, cfg).printed(full).split())


def test_a_hundredth_of_the_time_beyond_reach_needs_no_words() -> None:
    rows = pd.DataFrame({"strategy": ["human", "mine"], "cav_share_infeasible": [0.009, 0.02]})
    (line,) = remarks(windows_for(rows))
    assert "(mine 2.00%)" in line
    assert remarks(windows_for(rows[:1])) == []
