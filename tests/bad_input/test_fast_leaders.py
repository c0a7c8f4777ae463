"""Leaders faster than any driver wants to be: said in log, table and page, with the remedy."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import tiny
from study_frames import episodes

from lcc_rl.commands import evaluation
from lcc_rl.data.profiles import from_records
from lcc_rl.evaluation.rows import leader_faster
from lcc_rl.results.tables import FASTER, leader_too_fast, summary


def test_the_share_of_time_by_hand() -> None:
    records = [torch.tensor([10.0, 20.0, 30.0, 30.0]), torch.full((4,), 5.0)]
    profiles = from_records(records, ["a", "b"], ["x", "x"], 0.1)
    shares = leader_faster(
        profiles, torch.tensor([1, 0, 0, 0, 0]), np.array([4.0, 25.0, 20.0, 30.0, 9.0])
    )
    assert shares.tolist() == [1.0, 0.5, 0.5, 0.0, 1.0]


@pytest.mark.parametrize(("v0", "said"), [(2.0, True), (40.0, False)])
def test_slow_drivers_behind_faster_leaders_are_said(tmp_path: Path, caplog, v0, said) -> None:
    words = ["variant=alcc", "agent=none", "scenario.string=human", "drivers=fixed"]
    cfg = tiny("evaluate", *words, f"drivers.desired_speed={v0}", agent=False)
    with caplog.at_level(logging.WARNING, logger="lcc_rl"):
        rows = evaluation.run(cfg, tmp_path, quiet=True)
    assert (rows[FASTER].mean() > 0.5) == said
    assert ("Raise v0: drivers=highway" in caplog.text) == said


@pytest.mark.parametrize(("share", "said"), [(0.19, False), (0.21, True)])
def test_the_warning_stands_in_the_table(share: float, said: bool) -> None:
    assert leader_too_fast(episodes()) == []
    frame = episodes()
    frame[FASTER] = np.where(frame["strategy"] == "idm", share, 0.02)
    frame = frame.assign(cav_distance_m=500.0, hdv_distance_m=500.0)
    assert [line.partition(" for ")[0] for line in leader_too_fast(frame)] == [
        "the leaders drive faster than the desired speed of idm"
    ] * said
    assert summary(frame).set_index("strategy").loc["idm", FASTER] == pytest.approx(share)
