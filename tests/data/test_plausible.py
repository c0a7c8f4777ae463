"""Records that are implausible are left out and counted, or refused where they are many."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from ngsim_text import csv_text, native_text, pair
from table_text import pairs

from lcc_rl.data.episodes import validate_episodes, write_episodes
from lcc_rl.data.ngsim import read_ngsim
from lcc_rl.data.plausible import Plausible, farther, gap_rate, hard_share
from lcc_rl.data.sources import EpisodesSource, NgsimSource
from lcc_rl.data.speed_records import read_speed_record
from lcc_rl.errors import DataError

# Column, value in row 95 (episode 3), what is said of it.
FLAWS = [
    ("leader_speed_mps", 540.0, r"holds 540 m/s \(is it km/h or ft/s\?\), .*max_speed=70"),
    ("follower_speed_mps", 60.0, r"changes by 400 m/s², data\.plausible\.max_acceleration=10"),
    ("leader_length_m", 1.4, r"holds 1\.4 m, data\.plausible\.min_length=2"),
    ("leader_length_m", 60.0, r"holds 60 m, data\.plausible\.max_length=30"),
    ("gap_m", 4000.0, r"holds 4000 m, data\.plausible\.max_gap=500"),
]


@pytest.mark.parametrize(("column", "value", "words"), FLAWS)
def test_an_implausible_episode_is_left_out_and_many_are_refused(
    tmp_path: Path, column: str, value: float, words: str
) -> None:
    frame, path = pairs(), str(tmp_path / "pairs.parquet")
    frame.loc[95, column] = value
    write_episodes(frame, path)
    loaded = EpisodesSource(path=path).load()
    assert sorted(set(range(20)) - set(loaded.episodes["episode"])) == [3]
    validate_episodes(loaded.episodes, "what is left")
    said = [line for line in loaded.report if line.startswith("left out")]
    assert len(said) <= 2  # a jump is one of two samples
    assert (
        pd.Series(said).str.contains(rf"recording a, data row \d+, column '{column}' {words}").all()
    )
    frame.loc[95:215:30, column] = value  # five of twenty
    write_episodes(frame, path)
    with pytest.raises(DataError, match=r"pairs\.parquet: 2[58].* % of the samples are impl"):
        EpisodesSource(path=path).load()
    lenient = EpisodesSource(path=path, plausible=Plausible(max_share=0.3))
    assert lenient.load().episodes["episode"].nunique() == 15


def wavy(seconds: float = 60.0) -> pd.DataFrame:
    """Three episodes whose gap is the integral of the relative speed, with other offsets."""
    time = np.arange(0.0, seconds, 0.1)
    parts = []
    for episode in range(3):
        leader, follower = (15 + 2 * np.sin(time / 3 + episode - late) for late in (0.0, 0.7))
        relative = leader - follower
        way = np.append(0.0, np.cumsum((relative[1:] + relative[:-1]) * 0.05))
        part = {"time_s": 100.0 * episode + time, "gap_m": 20.0 + 5 * episode + way}
        part |= {"leader_speed_mps": leader, "follower_speed_mps": follower}
        parts.append(pd.DataFrame(part).assign(episode=episode))
    return pd.concat(parts, ignore_index=True)


SPEEDS = ["leader_speed_mps", "follower_speed_mps"]


def test_consistent_gaps_have_the_rate_one_also_with_a_biased_speedometer() -> None:
    assert gap_rate(wavy()) == pytest.approx(1.0, abs=1e-6)
    assert gap_rate(wavy().assign(leader_speed_mps=lambda x: x["leader_speed_mps"] + 1.5)) == (
        pytest.approx(1.0, abs=1e-6)
    )
    assert gap_rate(wavy(12.0)) is None  # too little to tell


@pytest.mark.parametrize(
    ("columns", "factor", "said"),
    [(SPEEDS, 3.6, 0.28), (SPEEDS, 2.23694, 0.45), (["gap_m"], 3.28084, 3.28), (["gap_m"], -1, -1)],
)
def test_gaps_in_other_units_than_the_speeds_are_refused(columns, factor, said) -> None:
    table = wavy()
    table[columns] *= factor
    with pytest.raises(DataError, match=rf"f\.csv: gaps change by {said:.2f} m where"):
        Plausible(max_speed=100.0, min_gap=-1e3).select(
            table, "f.csv", lambda row, column: f"row {row}"
        )


def test_a_gap_that_jumps_to_another_car_is_no_other_unit() -> None:
    table = wavy(20.0)  # of about 300 m
    jump = table.assign(gap_m=table["gap_m"] + 150.0 * (table.index >= 100) * (table.index < 200))
    Plausible().select(jump, "f.csv", lambda row, column: f"row {row}")
    table.loc[:199, "follower_speed_mps"] /= 2.23694
    assert farther(table)["factor"].round(1).tolist() == [2.2, 1.0, 1.0]
    with pytest.raises(DataError, match=r"f\.csv: row 0: by its speed, .* in mph\?"):
        Plausible().select(table, "f.csv", lambda row, column: f"row {row}")


def test_speeds_and_gaps_in_other_units_that_agree_are_refused(shared_data: Path) -> None:
    table = EpisodesSource(path=str(shared_data / "i80_pairs.parquet")).load().episodes
    assert hard_share(table) < 0.0005
    table[SPEEDS] *= 3.6
    table["gap_m"] /= 0.3048
    with pytest.raises(DataError, match=r"more than 4 m/s within a second for 5.* in km/h, mph"):
        Plausible().select(table, "f.csv", lambda row, column: f"row {row}")
    Plausible(max_hard=0.1).select(table, "f.csv", lambda row, column: f"row {row}")


def test_forgotten_feet_are_found_where_cars_stand_or_brake(shared_data: Path) -> None:
    table = EpisodesSource(path=str(shared_data / "i80_pairs.parquet")).load().episodes
    queue = wavy().assign(gap_m=6.0, **dict.fromkeys(SPEEDS, 0.0))
    for metres, words in ((table, "more than 4 m/s within"), (queue, r"cars stand 19\.7 m behind")):
        Plausible().select(metres, "f.csv", lambda row, column: f"row {row}")
        feet = metres.assign(**{name: metres[name] / 0.3048 for name in [*SPEEDS, "gap_m"]})
        with pytest.raises(DataError, match=words):
            Plausible().select(feet, "f.csv", lambda row, column: f"row {row}")


@pytest.mark.parametrize("spell", [csv_text, native_text])
@pytest.mark.parametrize("lengths", [True, False])
def test_a_file_in_metres_is_refused_and_read_when_said(tmp_path, spell, lengths: bool) -> None:
    near = pair(range(200), Space_Headway=25)
    metres = [row.copy() for row in near]
    for row in metres:
        for place in (5, 8, 11, 12, 16):  # Local_Y, v_Length, v_Vel, v_Acc, Space_Headway
            row[place] = f"{float(row[place]) * 0.3048 * (lengths or place != 8):.4f}"
    path, feet = tmp_path / "a.csv", tmp_path / "feet.csv"
    path.write_text(spell(metres))
    feet.write_text(spell(near))
    found = r"the median length of vehicles is 4\.57" if lengths else r"the least headway .* 7\.62"
    with pytest.raises(DataError, match=rf"a\.csv: recording .*: {found} feet; .*units=metres"):
        read_ngsim(path)
    names = ["position_m", "speed_mps", "acceleration_mps2", "space_headway_m"]
    own, published = read_ngsim(path, units="metres").samples, read_ngsim(feet).samples
    pd.testing.assert_frame_equal(own[names], published[names], atol=1e-3)


def test_real_records_pass(shared_data: Path) -> None:
    for name, kind in (
        ("i80_pairs.parquet", EpisodesSource),
        ("i80_pairs_ngsim_layout.csv.gz", NgsimSource),
    ):
        loaded = kind(path=str(shared_data / name)).load()
        assert loaded.episodes["episode"].nunique() == 264
        assert not any(line.startswith("left out") for line in loaded.report)
    for path in sorted(shared_data.glob("cycle_*.csv")) + sorted(shared_data.glob("leader_*.csv")):
        read_speed_record(str(path))
    raw = NgsimSource(path=str(shared_data / "ngsim_raw_rows_feet.csv.gz")).load()
    assert any("max_acceleration=10; to keep it, smooth it" in line for line in raw.report)


def test_a_bad_sample_costs_itself_and_divides_its_record(tmp_path: Path) -> None:
    frame = wavy().assign(recording="a", follower_id=2, leader_id=1)
    frame["leader_speed_mps"] -= frame["leader_speed_mps"].min() + 0.0015  # from -0.0015 m/s on
    frame["follower_speed_mps"] -= frame["follower_speed_mps"].min() + 0.0015
    frame.loc[200, "leader_speed_mps"] = 90.0
    frame.loc[645, "gap_m"] = -3.0  # 4.5 s after its record began
    path = tmp_path / "pairs.csv"
    frame.to_csv(path, index=False)
    loaded = EpisodesSource(path=str(path)).load()
    validate_episodes(loaded.episodes, "what is left")
    sizes = loaded.episodes.groupby("episode").size()
    assert sizes.to_dict() == {0: 200, 3: 399, 1: 554, 2: 600}
    report = "\n".join(loaded.report)
    assert "2 of 3 records were cut there: 47 samples, 5 s, are left out" in report
    assert "speeds below 0, the least -0.0015 m/s, count as 0" in report


BLANK = {0: 200, 3: 399, 1: 600, 2: 600}  # samples of the parts


@pytest.mark.parametrize(
    ("column", "cell", "sizes"),
    [
        ("gap_m", "", BLANK),
        ("follower_speed_mps", "n/a", BLANK),
        ("leader_speed_mps", "NaN", BLANK),
        ("time_s", "", BLANK),
        ("time_s", 19.9, BLANK),  # the time of the row before
        ("gap_m", None, {0: 600, 1: 600, 2: 600}),  # None: the row is there twice
    ],
)
def test_a_blank_cell_or_a_row_twice_costs_the_row(tmp_path: Path, column, cell, sizes) -> None:
    frame = wavy().astype({column: object})
    if cell is None:
        frame = pd.concat([frame, frame.iloc[[200]]])
    else:
        frame.loc[200, column] = cell
    path = tmp_path / "pairs.csv"
    frame.to_csv(path, index=False)
    loaded = EpisodesSource(path=str(path)).load()
    assert loaded.episodes.groupby("episode").size().to_dict() == sizes
    said = [line for line in loaded.report if line.startswith("left out 1 rows")]
    assert len(said) == 1
    assert f"data row {1801 if cell is None else 201}, column" in said[0]
