"""Leaders faster than any driver wants to be: measured, and said with the remedy."""

from __future__ import annotations

import logging

import numpy as np
import pandas as pd
import pytest
import torch
from commands import tiny

from lcc_rl.commands import evaluation
from lcc_rl.data.leaders import stretch
from lcc_rl.data.profiles import from_records
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.rows import leader_faster
from lcc_rl.results.tables import FASTER, leader_too_fast


def test_the_share_of_time_by_hand() -> None:
    records = [torch.tensor([10.0, 20.0, 30.0, 30.0]), torch.full((4,), 5.0)]
    profiles = from_records(records, ["a", "b"], ["x", "x"], 0.1)
    shares = leader_faster(
        profiles, torch.tensor([1, 0, 0, 0, 0]), np.array([4.0, 25.0, 20.0, 30.0, 9.0])
    )
    assert shares.tolist() == [1.0, 0.5, 0.5, 0.0, 1.0]


@pytest.mark.parametrize(("v0", "said"), [(2.0, True), (40.0, False)])
def test_slow_drivers_behind_faster_leaders_are_said(tmp_path, caplog, v0, said) -> None:
    words = ["variant=alcc", "agent=none", "scenario.string=human", "drivers=fixed"]
    cfg = tiny("evaluate", *words, f"drivers.desired_speed={v0}", agent=False)
    with caplog.at_level(logging.WARNING, logger="lcc_rl"):
        rows = evaluation.run(cfg, tmp_path, quiet=True)
    assert (rows[FASTER].mean() > 0.5) == said
    assert ("Raise v0: drivers=highway" in caplog.text) == said


def test_every_baseline_with_a_desired_speed_is_warned_of() -> None:
    shares = {"direct": 0.3, "human": 0.3, "idm": 0.1, "recorded": np.nan, "alcc": 0.3}
    shares |= {"acc_filtered": 1.0, "mine": 0.9}
    rows = pd.DataFrame({"strategy": shares.keys(), FASTER: shares.values()})
    said = [line.split("speed of ")[1].split()[0] for line in leader_too_fast(rows)]
    assert said == ["direct", "human", "mine"]


def test_the_remedy_for_a_controller_is_an_option() -> None:
    rows = pd.DataFrame({"strategy": ["human", "acc", "mine"], FASTER: [0.1, 0.9, 0.8]})
    acc, mine = (line.split("Raise v0: ")[1] for line in leader_too_fast(rows))
    assert acc == "'compare={faster: {_target_: lcc_rl.pieces.LinearACC, desired_speed: 45}}'"
    assert mine == "'compare={faster: {_target_: <its class>, desired_speed: 45}}'"


def test_a_scale_that_makes_a_leader_implausibly_fast() -> None:
    assert stretch("udds", 0.1, scale=2.0).speeds.max() > 50.0
    with pytest.raises(ConfigError, match=r"udds at scale=100 drives up to .* m/s, leader.plaus"):
        stretch("udds", 0.1, scale=100.0)
