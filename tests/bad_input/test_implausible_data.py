"""Data that are wrong without being malformed: left out and counted, or refused in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from ngsim_text import cells, csv_text, native_text, pair

from lcc_rl.config import load
from lcc_rl.data.episodes import validate_episodes, write_episodes
from lcc_rl.data.leaders import RecordLeaders, from_trajectories
from lcc_rl.data.ngsim import read_ngsim
from lcc_rl.data.plausible import Plausible
from lcc_rl.data.sources import EpisodesSource, NgsimSource
from lcc_rl.data.speed_records import read_speed_record
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.nodes import build


def table(episodes: int = 20, rows: int = 30) -> pd.DataFrame:
    """Episodes at 20 m/s."""
    number = np.repeat(np.arange(episodes), rows)
    time = np.tile(0.1 * np.arange(rows), episodes)
    return pd.DataFrame(
        {
            "episode": number,
            "recording": "a",
            "follower_id": number + 100,
            "leader_id": number + 200,
            "time_s": time,
            "follower_position_m": 20.0 * time,
            "follower_speed_mps": 20.0,
            "leader_position_m": 20.0 * time + 15.0,
            "leader_speed_mps": 20.0,
            "leader_length_m": 5.0,
            "gap_m": 10.0,
        }
    )


def written(folder: Path, frame: pd.DataFrame) -> EpisodesSource:
    write_episodes(frame, folder / "pairs.parquet")
    return EpisodesSource(path=str(folder / "pairs.parquet"))


# Column, value in row 95 (episode 3), what is said of it.
FLAWS = {
    "speed": ("leader_speed_mps", 540.0, r"holds 540 m/s \(is it km/h or ft/s\?\), .*max_speed=70"),
    "jump": (
        "leader_speed_mps",
        1.2,
        r"changes by -188 m/s², data\.plausible\.max_acceleration=10",
    ),
    "jump of the follower": ("follower_speed_mps", 60.0, "changes by 400 m/s²"),
    "length": ("leader_length_m", 1.4, r"holds 1\.4 m, data\.plausible\.min_length=2"),
    "long": ("leader_length_m", 60.0, r"holds 60 m, data\.plausible\.max_length=30"),
    "gap": ("gap_m", 4000.0, r"holds 4000 m, data\.plausible\.max_gap=500"),
}


@pytest.mark.parametrize("flaw", FLAWS)
def test_an_implausible_episode_is_left_out_and_counted(tmp_path: Path, flaw: str) -> None:
    column, value, words = FLAWS[flaw]
    frame = table()
    frame.loc[95, column] = value
    loaded = written(tmp_path, frame).load()
    assert sorted(set(range(20)) - set(loaded.episodes["episode"])) == [3]
    validate_episodes(loaded.episodes, "what is left")
    said = [line for line in loaded.report if line.startswith("left out")]
    role = "follower" if column.startswith(("follower", "gap")) else "leader"
    vehicle = {"leader": 203, "follower": 103}[role]
    place = rf"row 95 \(recording a, vehicle {vehicle} \({role}\), 0\.5 s\), column '{column}'"
    assert len(said) == 1
    pattern = rf"left out 1 implausible record\(s\), the first: {place} {words}"
    assert pd.Series(said).str.contains(pattern).all(), said


@pytest.mark.parametrize("flaw", FLAWS)
def test_more_than_a_share_is_refused(tmp_path: Path, flaw: str) -> None:
    column, value, words = FLAWS[flaw]
    frame = table()
    frame.loc[95:215:30, column] = value  # five of twenty
    source = written(tmp_path, frame)
    share = r"5 of 20 records are implausible \(at most data\.plausible\.max_share=0\.1"
    with pytest.raises(DataError, match=rf"pairs\.parquet: {share}.* row 95 .*{words}") as caught:
        source.load()
    assert "\n" not in str(caught.value)
    lenient = EpisodesSource(path=source.path, plausible=Plausible(max_share=0.25))
    assert lenient.load().episodes["episode"].nunique() == 15


def test_nothing_left_is_refused_whatever_the_share(tmp_path: Path) -> None:
    frame = table().assign(leader_speed_mps=100.0)
    source = written(tmp_path, frame)
    with pytest.raises(DataError, match="20 of 20 records are implausible"):
        EpisodesSource(path=source.path, plausible=Plausible(max_share=1.0)).load()
    kept = EpisodesSource(path=source.path, plausible=Plausible(max_speed=120.0)).load()
    assert len(kept.episodes) == len(frame)


def test_samples_far_apart(tmp_path: Path) -> None:
    frame = table()
    source = written(tmp_path, frame.assign(time_s=5000.0 * frame["time_s"]))
    with pytest.raises(DataError, match=r"is 500 s after the sample before it, .*max_step=10"):
        source.load()


def test_a_sudden_change_between_episodes_is_none(tmp_path: Path) -> None:
    frame = table()
    frame["leader_speed_mps"] = np.where(frame["episode"] % 2, 5.0, 30.0)
    assert written(tmp_path, frame).load().episodes["episode"].nunique() == 20


@pytest.mark.parametrize(
    "given",
    [{"max_speed": 0.0}, {"max_acceleration": float("nan")}, {"max_share": 1.1}, {"max_step": -1}],
)
def test_impossible_thresholds(given: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(given))):
        Plausible(**given)


def test_thresholds_are_settings_with_one_default() -> None:
    cfg = load("train", ["data=ngsim", "data.path=x", "data.plausible.max_speed=90"])
    assert build(cfg.data, "data").plausible.max_speed == 90.0
    cfg = load("train", ["variant=cacc", "leader.plausible.max_acceleration=20"])
    assert build(cfg.leader, "leader").plausible.max_acceleration == 20.0


# -- speed records ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (
            [(0, 540), (1, 540)],
            r"data row 1 .*'speed_mps' holds 540 m/s .*leader\.plausible.max_speed",
        ),
        (
            [(0, 5), (500, 5), (1e11, 5)],
            "data row 2 .*'time_s' is 500 s after the sample before it",
        ),
        ([(0, 5), (1, 5), (1e11, 5)], r"data row 3 .*'time_s' is 1e\+11 s after"),
        ([(0, 5), (0.1, 23.8), (0.2, 5)], "data row 2 .*'speed_mps' changes by 188 m/s²"),
    ],
)
def test_an_implausible_leader_is_refused(tmp_path: Path, rows: list, words: str) -> None:
    path = tmp_path / "leader.csv"
    pd.DataFrame(rows, columns=["time_s", "speed_mps"]).to_csv(path, index=False)
    with pytest.raises(DataError, match=rf"leader\.csv: .*{words}"):
        read_speed_record(str(path))
    stretch = {"record": {"path": str(path)}}
    with pytest.raises(DataError, match=words):
        RecordLeaders(training=stretch, held_out=stretch).load(0.1, 10, 1)


def test_a_threshold_can_be_raised(tmp_path: Path) -> None:
    path = tmp_path / "leader.csv"
    path.write_text("time_s,speed_mps\n0,5\n15,6\n30,7\n")
    time, _ = read_speed_record(str(path), Plausible(max_step=20.0))
    assert len(time) == 3


# -- NGSIM files -----------------------------------------------------------------------------------


def in_metres(rows: list[list[str]], lengths: bool = True) -> list[list[str]]:
    """The same rows with lengths, speeds and accelerations in metres."""
    places = (5, 8, 11, 12, 16)  # Local_Y, v_Length, v_Vel, v_Acc, Space_Headway
    return [
        [
            "0" if i == 8 and not lengths else f"{float(x) * 0.3048:.4f}" if i in places else x
            for i, x in enumerate(row)
        ]
        for row in rows
    ]


@pytest.mark.parametrize("spell", [csv_text, native_text])
@pytest.mark.parametrize("lengths", [True, False])
def test_a_file_in_metres_is_refused_and_read_when_said(tmp_path, spell, lengths: bool) -> None:
    path, feet = tmp_path / "a.csv", tmp_path / "feet.csv"
    near = {"Space_Headway": 25}
    path.write_text(spell(in_metres(pair(range(200), **near), lengths)))
    feet.write_text(spell(pair(range(200), **near)))
    found = r"the median length of vehicles is 4\.57" if lengths else r"the least headway .* 7\.62"
    words = rf"a\.csv: recording .*: {found} feet; expected .* say data\.units=metres"
    with pytest.raises(DataError, match=words):
        read_ngsim(path)
    metres, published = read_ngsim(path, units="metres").samples, read_ngsim(feet).samples
    names = ["position_m", "speed_mps", "acceleration_mps2", "space_headway_m"]
    pd.testing.assert_frame_equal(metres[names], published[names], atol=1e-3)
    if lengths:
        with pytest.raises(DataError, match=r"is 15 metres; .* say data\.units=feet"):
            read_ngsim(feet, units="metres")


def test_units_are_a_setting() -> None:
    with pytest.raises(ConfigError, match=r"units must be 'feet' or 'metres'"):
        NgsimSource(path="x", units="feets").load()
    cfg = load("train", ["data=ngsim", "data.path=x", "data.units=metres"])
    assert build(cfg.data, "data").units == "metres"


def test_raw_speeds_that_jump_are_refused_with_the_remedy(tmp_path: Path) -> None:
    rows = pair(range(200))
    rows[300][11] = "60"  # the leader falls from 100 to 60 ft/s within a frame
    (tmp_path / "a.csv").write_text(csv_text(rows))
    words = r"a\.csv: 1 of 1 records .*vehicle 9 \(leader\), 10 s.*data\.smoothing=\{_target_:"
    with pytest.raises(DataError, match=words):
        NgsimSource(path=str(tmp_path / "a.csv")).load()
    with pytest.raises(DataError, match=words):
        from_trajectories(tmp_path / "a.csv", 0.1)


def test_short_vehicles_are_left_out_of_an_ngsim_file(tmp_path: Path) -> None:
    rows = []
    for number in range(1, 13):
        follower, leader = 10 * number + 1, 10 * number + 2
        length = 4.5 if number == 5 else 15.0
        for k in range(160):
            rows.append(cells(follower, k, Preceding=leader, Space_Headway=60))
            rows.append(cells(leader, k, Local_Y=10.0 * k + 60, v_Length=length))
    (tmp_path / "a.csv").write_text(csv_text(rows))
    loaded = NgsimSource(path=str(tmp_path / "a.csv")).load()
    assert loaded.episodes["episode"].nunique() == 11
    assert "left out 1 implausible record(s)" in loaded.report[-1]
    assert "vehicle 52 (leader)" in loaded.report[-1]


def test_real_records_pass(shared_data: Path) -> None:
    for name, count in (("i80_pairs.parquet", 264), ("i80_pairs_ngsim_layout.csv.gz", 264)):
        make = EpisodesSource if name.endswith("parquet") else NgsimSource
        loaded = make(path=str(shared_data / name)).load()
        assert loaded.episodes["episode"].nunique() == count
        assert not any(line.startswith("left out") for line in loaded.report)
    for path in sorted(shared_data.glob("cycle_*.csv")) + sorted(shared_data.glob("leader_*.csv")):
        read_speed_record(str(path))
    with pytest.raises(DataError, match=r"implausible .*data\.smoothing="):
        NgsimSource(path=str(shared_data / "ngsim_raw_rows_feet.csv.gz")).load()
