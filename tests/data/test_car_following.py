"""Extraction of car-following episodes: each criterion, its count, and the real pairs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from helpers import check_episodes, check_refused
from ngsim_text import cells, csv_text, pair

from lcc_rl.data.car_following import Criteria, ExtractionReport, extract
from lcc_rl.data.episodes import SCHEMA
from lcc_rl.data.ngsim import read_ngsim
from lcc_rl.data.sources import EpisodesSource
from lcc_rl.errors import ConfigError, DataError

FOOT = 0.3048
SHORT = Criteria(min_duration_s=1.0)


def extracted(
    folder: Path, rows: list[list[str]], criteria: Criteria = SHORT
) -> tuple[pd.DataFrame, ExtractionReport]:
    (folder / "file.csv").write_text(csv_text(rows))
    episodes, report = extract(read_ngsim(folder / "file.csv"), criteria)
    pd.testing.assert_frame_equal(check_episodes(episodes), episodes)
    assert report.candidates - sum(report.removed.values()) == report.kept
    assert report.rows == len(episodes)
    return episodes, report


def test_an_episode_holds_both_vehicles_and_the_gap(tmp_path: Path) -> None:
    episodes, report = extracted(tmp_path, pair())
    assert {str(name): str(kind) for name, kind in episodes.dtypes.items()} == SCHEMA
    assert (report.candidates, report.kept, len(episodes)) == (1, 1, 20)
    row = episodes.drop(columns="recording").iloc[4].to_dict()
    assert episodes["recording"].unique().tolist() == ["2005-04-13T22:58:55Z"]
    assert row == pytest.approx(
        {
            "episode": 0,
            "follower_id": 7,
            "leader_id": 9,
            "time_s": 0.4,
            "follower_position_m": 40 * FOOT,
            "follower_speed_mps": 100 * FOOT,
            "leader_position_m": 100 * FOOT,
            "leader_speed_mps": 100 * FOOT,
            "leader_length_m": 15 * FOOT,
            "gap_m": 45 * FOOT,
        },
        rel=1e-6,
    )


def test_the_gap_ends_at_the_rear_of_the_leader(tmp_path: Path) -> None:
    # Fronts are 60 ft apart, the leader is 20 ft long, the follower 12 ft: 60 − 20 = 40 ft.
    rows = pair(v_Length=12.0)
    for row in rows[20:]:
        row[8] = "20.0"
    episodes, _ = extracted(tmp_path, rows)
    assert episodes["gap_m"].to_numpy() == pytest.approx(40 * FOOT, rel=1e-6)


def test_a_new_leader_begins_a_new_episode(tmp_path: Path) -> None:
    rows = pair(range(40)) + [cells(8, k, Local_Y=10.0 * k + 30) for k in range(40)]
    for row in rows[15:40]:
        row[14], row[16] = "8", "30"
    episodes, _ = extracted(tmp_path, rows)
    pairs = episodes.groupby("episode")[["leader_id", "time_s"]].agg(["first", "last"])
    assert pairs["leader_id", "first"].tolist() == pairs["leader_id", "last"].tolist() == [9, 8]
    assert pairs["time_s", "last"].tolist() == [1.4, 3.9]
    assert episodes["gap_m"].iloc[-1] == pytest.approx(15 * FOOT)


def test_a_missing_frame_of_either_vehicle_splits(tmp_path: Path) -> None:
    frames = [*range(15), *range(16, 30)]
    for rows in (
        pair(frames)[: len(frames)] + pair(range(30))[30:],
        pair(range(30))[:30] + pair(frames)[len(frames) :],
    ):
        episodes, _ = extracted(tmp_path, rows)
        assert episodes.groupby("episode").size().tolist() == [15, 14]


def lane_change() -> list[list[str]]:
    """The follower is on lane 3 in frames 12 to 14 of 0 to 29, behind the same leader."""
    rows = pair(range(30))
    for row in rows[12:15]:
        row[13] = "3"
    return rows


def test_a_lane_change_splits_or_rejects(tmp_path: Path) -> None:
    episodes, report = extracted(tmp_path, lane_change())
    assert episodes.groupby("episode").size().tolist() == [12, 15]
    assert report.candidates == 2
    first = "recording 2005-04-13T22:58:55Z, vehicle 7 (follower), 1.2 s, column 'lane'"
    line = f"left out 3 samples: the preceding vehicle is on another lane, the first: {first}"
    assert line in report.lines()
    reject = Criteria(min_duration_s=1.0, lane_changes="reject")
    with pytest.raises(DataError, match=r"no episode is left after .*'lane_changes: reject'"):
        extracted(tmp_path, lane_change(), reject)
    _, report = extracted(tmp_path, pair(), reject)
    assert report.removed["lane_changes: reject"] == 0
    both = pair(range(30))
    for row in both[15:30] + both[45:60]:
        row[13] = "3"
    episodes, _ = extracted(tmp_path, both)
    assert episodes.groupby("episode").size().tolist() == [15, 15]


def population() -> list[list[str]]:
    """Pairs (11, 12), (21, 22) …; each but the first breaks one criterion."""
    flaws: list[dict[str, object]] = [
        {},
        {"frames": 9},
        {"frames": 60},
        {"v_Class": 3},
        {"Space_Headway": 16},
        {"Space_Headway": 400},
    ]
    rows = []
    for number, flaw in enumerate(flaws, 1):
        frames = range(int(str(flaw.pop("frames", 30))))
        follower, leader = 10 * number + 1, 10 * number + 2
        for k in frames:
            change = {"Preceding": leader, "Space_Headway": 60, **flaw}
            rows += [cells(follower, k, **change), cells(leader, k, Local_Y=10.0 * k + 60)]
    return rows


def test_each_criterion_removes_its_candidates_in_order(tmp_path: Path) -> None:
    criteria = Criteria(min_duration_s=1.0, max_duration_s=5.0, min_gap_m=1.0, max_gap_m=100.0)
    episodes, report = extracted(tmp_path, population(), criteria)
    assert report.candidates == 4
    assert report.removed == {
        "min_duration_s: 1": 1,
        "max_duration_s: 5": 1,
        "passenger_cars_only": 1,
    }
    assert report.left_out["gap beyond min_gap_m=1"] == 30
    assert report.left_out["gap beyond max_gap_m=100"] == 30
    assert episodes["follower_id"].unique().tolist() == [11]
    assert "left out 30 samples: gap beyond min_gap_m=1, the first: recording" in str(report)


def test_a_gap_beyond_the_limits_cuts(tmp_path: Path) -> None:
    rows = pair(range(60))
    for row in rows[20:23]:
        row[16] = "1000"
    episodes, report = extracted(tmp_path, rows, Criteria(min_duration_s=1.0))
    assert episodes.groupby("episode").size().tolist() == [20, 37]
    assert report.left_out["gap beyond max_gap_m=120"] == 3


def test_impossible_criteria() -> None:
    cases = [
        ({"min_duration_s": 0.0}, "min_duration_s"),
        ({"max_duration_s": 14.0}, "min_duration_s=15.0 is above max_duration_s=14.0"),
        ({"min_gap_m": 200.0}, "min_gap_m=200.0 is above max_gap_m=120.0"),
        ({"lane_changes": "keep"}, "lane_changes must be 'split' or 'reject'"),
    ]
    check_refused(lambda own: Criteria(**own), cases, ConfigError)


def identified(group: tuple[int, pd.DataFrame]) -> tuple[tuple[float, float], pd.DataFrame]:
    """First time and position of an episode, and its rows."""
    first = group[1].iloc[0]
    return (round(first["time_s"], 1), round(float(first["follower_position_m"]), 1)), group[1]


def test_all_real_pairs_are_recovered(shared_data: Path) -> None:
    found, _ = extract(read_ngsim(shared_data / "i80_pairs_ngsim_layout.csv.gz"), Criteria())
    truth = EpisodesSource(path=str(shared_data / "i80_pairs.parquet")).load().episodes
    assert found["episode"].nunique() == truth["episode"].nunique() == 264
    # Ids differ; a pair is identified by its first time and position, which no two pairs share.
    expected = dict(map(identified, truth.groupby("episode")))
    assert len(expected) == 264
    tolerances = {"time_s": 1e-3, "follower_speed_mps": 0.01, "leader_speed_mps": 0.01}
    for place, episode in map(identified, found.groupby("episode")):
        other = expected.pop(place)
        for name in (*SCHEMA,)[4:]:
            tolerance = tolerances.get(name, 0.02)
            np.testing.assert_allclose(episode[name], other[name], atol=tolerance, rtol=0)
    assert not expected
