"""Leaders faster than any driver wants to be: said in log, table and page, with the remedy."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from commands import tiny
from helpers import slow_but
from study_frames import episodes

from lcc_rl.commands import evaluation
from lcc_rl.data.profiles import from_records
from lcc_rl.evaluation.rows import leader_faster
from lcc_rl.figures.page import Page
from lcc_rl.io.files import write_parquet
from lcc_rl.results.tables import FASTER, leader_too_fast, summary
from lcc_rl.studies.alcc.report import add_main


def test_the_share_of_time_by_hand() -> None:
    records = [torch.tensor([10.0, 20.0, 30.0, 30.0]), torch.full((4,), 5.0)]
    profiles = from_records(records, ["a", "b"], ["x", "x"], 0.1)
    shares = leader_faster(
        profiles, torch.tensor([1, 0, 0, 0, 0]), np.array([4.0, 25.0, 20.0, 30.0, 9.0])
    )
    assert shares.tolist() == [1.0, 0.5, 0.5, 0.0, 1.0]


def test_slow_drivers_behind_faster_leaders_are_said(tmp_path: Path, caplog) -> None:
    words = ["variant=alcc", "agent=none", "scenario.string=human", "drivers=fixed"]
    for v0, said in ((2.0, True), (40.0, False)):
        caplog.clear()
        cfg = tiny("evaluate", *words, f"drivers.desired_speed={v0}", agent=False)
        with caplog.at_level(logging.WARNING, logger="lcc_rl"):
            rows = evaluation.run(cfg, tmp_path / str(v0), quiet=True)
        assert (rows[FASTER].mean() > 0.5) == said
        found = "Raise v0: drivers=highway" in caplog.text
        assert found == said


def fast(share: float) -> pd.DataFrame:
    frame = episodes()
    shares = {FASTER: np.where(frame["strategy"] == "idm", share, 0.02)}
    return frame.assign(**shares, cav_distance_m=500.0, hdv_distance_m=500.0)


AROUND = [(0.19, False), (0.21, True)]


@pytest.mark.parametrize(("share", "said"), slow_but(AROUND[1:], AROUND))
def test_the_warning_stands_in_table_and_page(tmp_path: Path, share: float, said: bool) -> None:
    frame = fast(share)
    found = leader_too_fast(frame)
    assert [line.partition(" for ")[0] for line in found] == [
        "the leaders drive faster than the desired speed of idm"
    ] * said
    assert [line.partition("Raise v0: ")[2] for line in leader_too_fast(frame, True)] == [
        "compare with human, whose v0 is that of drivers=…"
    ] * said
    table = summary(frame).set_index("strategy")
    assert table.loc["idm", FASTER] == pytest.approx(share)
    write_parquet(frame, tmp_path / "evaluation" / "episodes.parquet")
    page = Page(tmp_path)
    add_main(page)
    words = "variant=idm scenario.controllers.automated.desired_speed=45"
    assert (words in " ".join(page.sections[0]["paragraphs"])) == said


def test_rows_without_the_share_give_no_warning() -> None:
    assert leader_too_fast(episodes()) == []
