"""The ring study: one command from the humans' wave to the page."""

from __future__ import annotations

import pandas as pd
import pytest

from lcc_rl.io.files import read_parquet
from lcc_rl.studies import ring
from lcc_rl.studies.reproduce import main

SMALL = (
    "scenario.string=automated human*5",
    "scenario.circumference=72",
    "evaluation.humans_first=2",
    "scenario.horizon=40",
    "evaluation.warm_up=1",
    "evaluation.profiles=2",
)


@pytest.mark.usefixtures("blank_figures")
def test_one_command_writes_the_table(tmp_path) -> None:
    assert main(["ring", "--out", str(tmp_path / "ring"), *SMALL]) == 0
    table = read_parquet(tmp_path / "ring" / "tables" / "ring.parquet").set_index("driven by")
    assert {"FollowerStopper", "PI with saturation", "field experiment"} < set(table.index)
    assert table.loc["simulated drivers", "speeds against humans"] == "0.0 %"
    text = (tmp_path / "ring" / "results.md").read_text()
    assert "4 s after 2 s in which humans drive all cars, the first 1 s not counted" in text


def test_changes_are_against_the_humans() -> None:
    """Energy is divided by the distance of all cars; who never damps is counted."""
    rows = pd.DataFrame(
        {
            "strategy": ["human", "human", "pi_saturation", "pi_saturation"],
            "total_net_energy_kj": [40.0, 60.0, 30.0, 30.0],
            "cav_distance_m": [10.0, 10.0, 20.0, 20.0],
            "hdv_distance_m": [90.0, 90.0, 80.0, 80.0],
            "speed_std_mps": [2.0, 2.0, 0.5, 0.3],
            "damping_time_s": [float("nan"), 40.0, 20.0, 30.0],
            "mean_speed_mps": [3.0, 3.0, 4.0, 5.0],
            "min_gap_m": [1.0, 2.0, 3.0, 2.5],
        }
    )
    found = ring.table(rows).set_index("driven by").loc["PI with saturation"]
    assert found["speeds against humans"] == "−80.0 %"
    assert found["fuel"] == "−40.0 %"
    assert (found["damped after"], found["smallest gap [m]"]) == ("25 s", 2.5)
    assert ring.table(rows)["damped after"][0] == "1 of 2"
    assert found["mean speed [m/s]"] == pytest.approx(4.5)
