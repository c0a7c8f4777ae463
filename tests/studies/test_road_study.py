"""The road study: one command from trajectories to the table, on the recordings of the package."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd
import pytest
from helpers import check_refused

from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.studies import road
from lcc_rl.studies.reproduce import main

SMALL = (
    "calibration=local",
    "scenario.string.size=4",
    "scenario.horizon=60",
    "evaluation.warm_up=1",
    "evaluation.profiles=2",
    "evaluation.drivers=1",
    "compare=[idm_acc]",
)


@pytest.mark.usefixtures("blank_figures")
def test_one_command_writes_table_figure_and_reports(tmp_path) -> None:
    command = ["road", "--out", str(tmp_path / "road"), "--shares", "25,50", *SMALL]
    assert main(command) == 0
    table = read_parquet(tmp_path / "road" / "tables" / "road.parquet")
    assert table["automated_pct"].tolist() == [25.0, 25.0, 50.0, 50.0]
    humans, rule = table.iloc[0], table.iloc[1]
    assert (humans["strategy"], rule["strategy"]) == ("human", "idm_acc")
    share = 100.0 * (1.0 - rule["fuel_l_per_100km"] / humans["fuel_l_per_100km"])
    assert rule["fuel_saved_pct"] == pytest.approx(share)
    assert humans["co2_g_per_km"] == pytest.approx(23.48 * humans["fuel_l_per_100km"])
    page = (tmp_path / "road" / "results.md").read_text(encoding="utf-8")
    assert "4 vehicles, 1 time behind each of 2 windows of 6 s, the first 1 s not counted" in page
    assert "## Data\n\n* read 6 episodes" in page
    assert "## Drivers" in page
    assert "RMSPE of 6 " in page
    rows = read_parquet(tmp_path / "road" / "evaluation" / "25" / "episodes.parquet")
    rows["collided"] |= rows["strategy"] == "idm_acc"
    half = read_parquet(tmp_path / "road" / "evaluation" / "50" / "episodes.parquet")
    write_parquet(rows, tmp_path / "road" / "evaluation" / "25" / "episodes.parquet")
    found = road.study_results(tmp_path / "road")
    crashed, whole = (found.tables["road"].iloc[row] for row in (1, 3))
    for key in ("fuel_l_per_100km", "fuel_saved_pct", "flow_vph", "flow_vph_low"):
        assert np.isnan(crashed[key]), key
        assert np.isfinite(whole[key]), key
    words = r"25 % automated: Episodes end in a collision.*: tuned IDM 2 of 2;"
    assert len([block for block in found.blocks if re.match(words, block)]) == 1
    half["collided"] |= half["strategy"] == "human"
    write_parquet(half, tmp_path / "road" / "evaluation" / "50" / "episodes.parquet")
    humans, whole = road.study_results(tmp_path / "road").tables["road"].iloc[2:].iloc
    assert np.isnan([whole["fuel_saved_pct"], whole["flow_vph_low"]]).all()
    assert np.isfinite([whole["fuel_l_per_100km"], humans["fuel_l_per_100km"]]).all()
    file = tmp_path / "road" / "evaluation" / "50" / "config.yaml"
    file.write_text(file.read_text().replace("horizon: 60", "horizon: 80"))
    with pytest.raises(ResultsError, match=r"50 differs from .*25 in scenario.horizon; remove"):
        road.study_results(tmp_path / "road")
    again = read_parquet(tmp_path / "road" / "leaders.parquet")
    assert again.groupby("drive").size().max() == 4209  # seven minutes
    with pytest.raises(ResultsError, match="of other data; choose another folder"):
        road.run(tmp_path / "road", [*SMALL, "data=stream"], ("25",))


def test_shares_that_no_string_has_are_refused_by_name() -> None:
    road.check_shares(["5", "10", "12.5", "100"], 40)
    cases = [(share, f"got {share!r}") for share in ("0", "101", "abc", "")]
    cases += [("2", "--shares 2: 20 vehicles have no 2 %; use scenario.string.size=50")]
    check_refused(lambda share: road.check_shares([share], 20), cases, ConfigError)


def test_a_leader_is_one_drive_whoever_follows() -> None:
    rows = {
        "recording": ["a"] * 8,
        "leader_id": [1, 1, 1, 1, 1, 2, 2, 1],
        "time_s": [0.0, 0.1, 0.1, 0.2, 9.0, 0.0, 0.1, 9.1],
        "leader_speed_mps": [5.0, 6.0, 6.0, 7.0, 1.0, 2.0, 3.0, 4.0],
    }
    found = road.leader_drives(pd.DataFrame(rows), 0.1)
    drives = {str(name): part["speed_mps"].tolist() for name, part in found.groupby("drive")}
    assert road.samples_of(found, 0.1, 0.2).tolist() == [2, 1, 1]
    assert drives == {
        "a leader 1 from 0.0 s": [5.0, 6.0, 7.0],
        "a leader 1 from 9.0 s": [1.0, 4.0],
        "a leader 2 from 0.0 s": [2.0, 3.0],
    }


def test_windows_count_as_much_time_as_they_can() -> None:
    cases = [([3611] * 4 + [506, 546, 4209], 200, 3610), ([601] * 9, 200, 600)]
    cases += [([9000] * 3, 200, 4000), ([100, 5000], 50, 4000)]
    for samples, begun, steps in cases:
        assert road.window_steps(np.array(samples), begun) == steps
