"""Records that are implausible are left out and counted, or refused where they are many."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from helpers import check_episodes, check_refused
from ngsim_text import csv_text, native_text, pair
from table_text import pairs

from lcc_rl.data.agreement import agreement
from lcc_rl.data.grid import Place
from lcc_rl.data.ngsim import METRES, read_ngsim
from lcc_rl.data.plausible import Plausible, doubts, hard_share
from lcc_rl.data.smoothing import averaged
from lcc_rl.data.sources import EpisodesSource, NgsimSource
from lcc_rl.data.speed_records import read_speed_record
from lcc_rl.errors import Concern, DataError
from lcc_rl.io.files import write_parquet

# Column, value in row 95 (episode 3), what is said of it.
FLAWS = [
    (
        "leader_speed_mps",
        540.0,
        r"holds 540 m/s \(is it in km/h .* for no target\?\), .*max_speed=70",
    ),
    ("follower_speed_mps", 60.0, r"changes by 400 m/s², data\.plausible\.max_acceleration=10"),
    ("leader_length_m", 1.4, r"holds 1\.4 m, data\.plausible\.min_length=2"),
    ("leader_length_m", 60.0, r"holds 60 m, data\.plausible\.max_length=30"),
    ("gap_m", 4000.0, r"holds 4000 m \(is it in cm, data\.units\.gap=cm, .*max_gap=500"),
]


@pytest.mark.parametrize(("column", "value", "words"), FLAWS)
def test_an_implausible_episode_is_left_out_and_many_are_refused(
    tmp_path: Path, column: str, value: float, words: str
) -> None:
    frame, path = pairs(), str(tmp_path / "pairs.parquet")
    frame.loc[95, column] = value
    write_parquet(frame, path)
    loaded = EpisodesSource(path=path).load()
    assert sorted(set(range(20)) - set(loaded.episodes["episode"])) == [3]
    check_episodes(loaded.episodes)
    said = [line for line in loaded.report if line.startswith("left out")]
    assert len(said) <= 2  # a jump is one of two samples
    assert pd.Series(said).str.contains(rf"a, .*data row \d+, column '{column}' {words}").all()
    frame.loc[95:215:30, column] = value  # five of twenty
    write_parquet(frame, path)
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
NOWHERE = {"leader_position_m": 0.0, "follower_position_m": 0.0}


def irregular(seconds: float = 60.0) -> pd.DataFrame:
    """Three episodes whose speeds vary irregularly, from which lags can be told."""
    time, parts = np.arange(0.0, seconds, 0.1), []
    for episode in range(3):
        waves = [(0.9, 0.31, 1.0), (0.7, 0.83, 2.0), (0.4, 1.7, 0.3 + episode)]
        leader = 15 + sum(size * np.sin(rate * time + phase) for size, rate, phase in waves)
        follower = 15 + sum(
            0.8 * size * np.sin(rate * (time - 0.9) + phase - 0.2) for size, rate, phase in waves
        )
        relative = leader - follower
        way = np.append(0.0, np.cumsum((relative[1:] + relative[:-1]) * 0.05))
        part = {"time_s": 100.0 * episode + time, "gap_m": 25.0 + way, "episode": episode}
        parts.append(pd.DataFrame(part | {SPEEDS[0]: leader, SPEEDS[1]: follower}))
    return pd.concat(parts, ignore_index=True)


def rows_of(table: pd.DataFrame) -> Place:
    """Describe a sample by its row."""
    return lambda row, column: f"row {row}, {column}"


def judged(table: pd.DataFrame, units: dict[str, str] | None = None, **settings) -> list[str]:
    """Lines on a table of pairs in which rows are numbered."""
    settings = {
        "max_speed": 200.0,
        "max_acceleration": 99.0,
        "min_gap": -1e4,
        "max_gap": 1e4,
    } | settings
    return Plausible(**settings).select(table, "f.csv", rows_of, units=units)[1]


def test_speeds_of_a_coarse_resolution_are_reported_until_they_are_averaged() -> None:
    for step, said in ((0.1, ["of 0.1 m/s, 0.1"]), (1 / 3.6, ["of 0.28 m/s, 0.1"]), (0.01, [])):
        table = irregular()
        table[SPEEDS] = step * (table[SPEEDS] / step).round()
        lines = doubts(table, "data")
        assert [line for line, x in zip(lines, said, strict=True) if x in line] == lines
        assert all(isinstance(x, Concern) and "data.average_s=1.1" in x for x in lines)
        assert not doubts(averaged(table.assign(**NOWHERE), 1.1, "")[0], "data")


def test_drives_in_knots_or_in_frames_are_asked_about() -> None:
    time = np.arange(0.0, 600.0, 0.1)
    table = pd.DataFrame({"time_s": time, "speed_mps": 10 - 10 * np.cos(time / 20), "episode": 0})
    assert not doubts(table, "leader")
    assert "reach 60 m/s" in doubts(table.assign(speed_mps=3 * table["speed_mps"]), "leader")[0]
    (line,) = doubts(table.assign(time_s=10 * time), "leader")
    assert "are times frames (leader.units.time=frames/10)?" in line


@pytest.mark.parametrize("bias", [0.0, 0.5])
def test_consistent_gaps_have_the_slope_one_and_no_lag_also_with_a_biased_speedometer(bias) -> None:
    table = wavy().assign(leader_speed_mps=lambda x: x["leader_speed_mps"] + bias)
    found = agreement(table)
    assert found["row"].tolist() == [0, 600, 1200, 0]
    np.testing.assert_allclose(found[["leader", "follower"]], 1.0, atol=1e-3 + bias / 10)
    assert (found["fit"] > 0.99 - bias / 10).all()
    assert (found["late"] == 0.0).all()
    if not bias:
        assert judged(wavy())[-1].endswith("speeds 1.00, lag 0.0 s of 3 pair(s)")
    short = judged(wavy(12.0))
    assert short[-1].endswith("1 m/s; slope and lag unknown for 3")


BOTH, LEADER, FOLLOWER = [*SPEEDS], SPEEDS[:1], SPEEDS[1:]
# Columns, their factor, units of the file, and what is said of the pair.
MISTAKES = [
    (BOTH, 3.6, {}, r"by 0\.28 m, where .* by -0\.28 m; are both speeds in km/h\?"),
    (BOTH, 2.23694, {}, r"by 0\.45 m, .*; are both speeds in mph\?"),
    (BOTH, 1.94384, {}, r"by 0\.51 m, .*; are both speeds in kn\?"),
    (BOTH, 3.28084, {}, r"by 0\.30 m, .*; are both speeds in ft/s\?"),
    (["gap_m"], 3.28084, {}, r"by 3\.28 m, .*; is the gap in ft\?"),
    (["gap_m"], 100.0, {}, r"by 100\.00 m, .*; is the gap in cm\?"),
    (["gap_m"], 3.28084, {"gap": "m"}, r"; is the gap in ft \(data\.units\.gap=ft\)\?"),
    (["gap_m"], 0.3048, {"gap": "ft"}, r"is the gap in m \(.*\)\? or are both speeds in ft/s\?"),
    (BOTH, 1 / 3.6, {"speed": "km/h"}, r"are both speeds in m/s \(data\.units\.speed=m/s\)\?"),
    (
        BOTH,
        2.5,
        {"time": "frames/10"},
        r"is the time in frames/25 \(data\.units\.time=frames/25\)\?;",
    ),
    (["gap_m"], -1.0, {}, r"by -1\.00 m, where .* by 1\.00 m; are leader and follower exchanged"),
    (
        LEADER,
        2.23694,
        {},
        r"leader_speed_mps: .* by 0\.45 m, .* by -1\.00 m; is the leader's speed in mph",
    ),
    (
        FOLLOWER,
        3.6,
        {},
        r"follower_speed_mps: .* by 1\.00 m, .* by -0\.28 m; is the follower's speed in km",
    ),
    (
        LEADER,
        1 / 3.6,
        {"leader_speed": "km/h", "follower_speed": "m/s"},
        r"is the leader's speed in m/s \(data\.units\.leader_speed=m/s\)\?",
    ),
]


def test_a_pair_in_another_unit_or_exchanged_is_named() -> None:
    for wrong, first in ((1, 1200), (3, 600)):  # the one in the middle

        def read(columns: list[str], factor: float, units: dict[str, str], wrong=wrong) -> None:
            table = wavy()
            table.loc[table["episode"] >= 3 - wrong, columns] *= factor
            judged(table, units)

        ends = rf"(?=.*; {wrong} of 3 pairs)"
        cases = [(*given, rf"f\.csv: {ends}row {first}, .*{words}") for *given, words in MISTAKES]
        check_refused(read, cases, DataError)


def later(table: pd.DataFrame, signal: str, seconds: float) -> pd.DataFrame:
    """The table with a signal that is late."""
    moved = table.groupby("episode")[signal].shift(round(10 * seconds))
    return table.assign(**{signal: moved.fillna(table[signal])})


@pytest.mark.parametrize(
    ("signal", "words"),
    [("leader_speed_mps", "leader"), ("follower_speed_mps", "follower"), ("gap_m", "gap")],
)
def test_a_signal_that_is_late_is_named_or_reported(signal: str, words: str) -> None:
    table = irregular()
    assert not any(isinstance(line, Concern) for line in judged(table))
    for seconds in (-2.0, -0.5, 0.2, 0.5, 1.0, 1.5):
        late, side = later(table, signal, seconds), "late" if seconds > 0 else "early"
        said = f"{signal}: {words} {abs(seconds)} s {side}; are clocks apart"
        if abs(seconds) > 1:
            with pytest.raises(DataError, match=rf"f\.csv: row \d+, {said}.*3 of 3 pairs"):
                judged(late)
            judged(late, max_lag=3.0)
        else:
            loud = [line for line in judged(late) if isinstance(line, Concern)]
            assert [said in line for line in loud] == [True] * (abs(seconds) >= 0.3), seconds


def test_a_gap_that_jumps_to_another_car_is_no_other_unit() -> None:
    table = wavy(20.0)  # of about 300 m
    jump = table.assign(gap_m=table["gap_m"] + 150.0 * (table.index >= 100) * (table.index < 200))
    judged(jump)
    table.loc[:199, "follower_speed_mps"] /= 2.23694
    with pytest.raises(
        DataError, match=r"row 0, .* drives 83.* m, the leader 17.* is the leader.s speed in mph\?"
    ):
        judged(table)


def test_a_faulty_sensor_fits_no_unit_and_is_refused_only_where_all_are() -> None:
    table, rng = irregular(), np.random.default_rng(0)
    noise = 20 + 5 * np.cumsum(rng.normal(size=len(table))) / 10
    one = table.assign(gap_m=table["gap_m"].where(table["episode"] > 0, noise))
    assert judged(one)[-1].endswith("of 2 pair(s), slope and lag unknown for 1")
    with pytest.raises(DataError, match=r"f\.csv: the gap changes by -?0\.\d\d m .* no unit fits"):
        judged(table.assign(gap_m=noise))
    noisy = table.assign(gap_m=table["gap_m"] + rng.normal(size=len(table)))
    judged(noisy)
    with pytest.raises(DataError, match=r"f\.csv: where .*; are leader and follower exchanged\?"):
        judged(noisy.rename(columns=dict(zip(SPEEDS, SPEEDS[::-1], strict=True))))


def test_a_start_from_standing_is_not_said_to_be_in_another_unit() -> None:
    time = np.arange(0.0, 40.0, 0.1)
    leader, follower = (np.clip(6.0 * ((time % 20) - late), 0.0, 25.0) for late in (0.0, 1.0))
    gap = 5.0 + np.append(
        0.0, np.cumsum(np.diff(leader, prepend=0)[1:] * 0 + (leader - follower)[1:] * 0.1)
    )
    table = pd.DataFrame({"episode": 0, "time_s": time, "gap_m": gap})
    table = table.assign(leader_speed_mps=leader, follower_speed_mps=follower)
    with pytest.raises(DataError, match=r"max_hard=0\.005; gaps agree: .* such changes"):
        judged(table, max_acceleration=999.0)


def test_speeds_and_gaps_in_other_units_that_agree_are_refused(shared_data: Path) -> None:
    table = EpisodesSource(path=str(shared_data / "i80_pairs.parquet")).load().episodes
    assert hard_share(table) < 0.0005
    table[SPEEDS] *= 3.6
    table["gap_m"] /= 0.3048
    with pytest.raises(
        DataError, match=r"more than 4 m/s within a second for 5.* are both in another unit"
    ):
        Plausible().select(table, "f.csv", rows_of)
    Plausible(max_hard=0.1).select(table, "f.csv", rows_of)


def test_forgotten_feet_are_refused_where_cars_brake_and_said_where_they_stand(shared_data) -> None:
    table = EpisodesSource(path=str(shared_data / "i80_pairs.parquet")).load().episodes
    feet = table.assign(**{name: table[name] / 0.3048 for name in [*SPEEDS, "gap_m"]})
    with pytest.raises(
        DataError, match=r"more than 4 m/s within .* gaps agree: are both in another unit, or"
    ):
        judged(feet)
    queue = wavy().assign(gap_m=6.0, **dict.fromkeys(SPEEDS, 0.0))
    assert not isinstance(judged(queue)[-1], Concern)
    last = judged(queue.assign(gap_m=6.0 / 0.3048))[-1]
    assert isinstance(last, Concern)
    assert "cars stand 19.7 m apart: are all columns in feet?" in last
    assert "feet" not in judged(queue.assign(gap_m=6.0 / 0.3048), {"gap": "ft"})[-1]


@pytest.mark.parametrize(("spell", "lengths"), [(csv_text, True), (native_text, False)])
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
    check_episodes(loaded.episodes)
    sizes = loaded.episodes.groupby("episode").size()
    assert sizes.to_dict() == {0: 200, 3: 399, 1: 554, 2: 600}
    report = "\n".join(loaded.report)
    assert "2 of 3 records were cut there: 47 samples, 5 s, are left out" in report
    assert "speeds below 0, the least -0.0015 m/s, count as 0" in report


BLANK = {0: 200, 3: 399, 1: 600, 2: 600}  # samples of the parts


def test_a_blank_cell_or_a_row_twice_costs_the_row(tmp_path: Path) -> None:
    for column, cell, sizes in (
        ("gap_m", "", BLANK),
        ("follower_speed_mps", "n/a", BLANK),
        ("leader_speed_mps", "NaN", BLANK),
        ("time_s", "", BLANK),
        ("time_s", 19.9, BLANK),  # the time of the row before
        ("gap_m", None, {0: 600, 1: 600, 2: 600}),  # None: the row is there twice
    ):
        frame = wavy().astype({column: object})
        if cell is None:
            frame = pd.concat([frame, frame.iloc[[200]]])
        else:
            frame.loc[200, column] = cell
        frame.to_csv(tmp_path / "pairs.csv", index=False)
        loaded = EpisodesSource(path=str(tmp_path / "pairs.csv")).load()
        assert loaded.episodes.groupby("episode").size().to_dict() == sizes, (column, cell)
        (said,) = (x for x in loaded.report if re.search("(left out|dropped) 1 rows", x))
        assert f"data row {1801 if cell is None else 201}, column" in said


def with_gap(rows: slice, values: object, base: pd.DataFrame | None = None) -> pd.DataFrame:
    """The table with other gaps in some rows; a function gets the gaps of these rows."""
    table = irregular() if base is None else base
    gap = table["gap_m"].to_numpy().copy()
    gap[rows] = values(gap[rows]) if callable(values) else values
    return table.assign(gap_m=gap)


def held_while(table: pd.DataFrame) -> pd.DataFrame:
    """The table with a leader that speeds away while the gap of 4 s is that of their start."""
    faster = table["leader_speed_mps"].to_numpy().copy()
    faster[200:240] += 3.0 * np.sin(np.linspace(0, np.pi, 40))
    way = np.cumsum(np.where(table["episode"] == 0, faster - table["leader_speed_mps"], 0.0)) * 0.1
    return with_gap(
        slice(200, 240),
        lambda x: x[:1],
        table.assign(leader_speed_mps=faster, gap_m=table.gap_m + way),
    )


def noisy(size: float) -> pd.DataFrame:
    noise = np.random.default_rng(0).normal(0.0, size, 1800)
    return with_gap(slice(None), lambda gap: gap + noise)


# Words, table, least and most rows left out, row of the first jump (None: no jump).
JUMPS = [
    ("consistent", irregular(), 0, 0, None),
    ("noise", noisy(0.5), 0, 0, None),
    ("whole metres", with_gap(slice(None), np.round), 0, 0, None),
    (
        "a value for each second",
        with_gap(slice(None), lambda x: np.repeat(x[::10], 10)),
        0,
        0,
        None,
    ),
    ("a car cuts in", with_gap(slice(300, 600), lambda x: x - 8.0), 1, 9, 300),
    ("and the gap is noisy", with_gap(slice(300, 600), lambda x: x - 8.0, noisy(0.5)), 1, 9, 300),
    ("another car for 6 s", with_gap(slice(300, 360), lambda x: x * 0.45), 60, 70, 300),
    ("255 m for none", with_gap(slice(300, 360), 255.0), 60, 70, 300),
    ("none for longer than the least part", with_gap(slice(300, 450), 100.0), 150, 160, 300),
    ("none at the end", with_gap(slice(450, 600), 100.0), 150, 160, 450),
    ("another for the last two samples", with_gap(slice(598, 600), lambda x: x - 5.0), 2, 12, 598),
    ("none at the begin", with_gap(slice(0, 150), 0.0), 150, 160, 0),
    ("held over a dropout", held_while(irregular()), 40, 45, 200),
]


def test_records_are_cut_where_the_gap_jumps_or_is_held() -> None:
    for words, table, least, most, first in JUMPS:
        kept, lines = Plausible().select(table.assign(row=table.index), "f.csv", rows_of)
        said = [line for line in lines if "where the gap jumps or is held" in line]
        assert least <= len(table) - len(kept) <= most, (words, len(table) - len(kept))
        assert len(said) == (first is not None), words
        if said:
            row = int(re.search(r"first: row (\d+), gap_m changes by", said[0])[1])
            assert abs(row - first) <= ("nois" in words), (words, said)
            assert any("1 of 3 records were cut there" in line for line in lines), words
            assert any("parts behind another car are records, too" in line for line in lines)
        if "nois" not in words and "metres" not in words:
            assert "lag 0.0 s of " in lines[-1], (words, lines[-1])  # the parts are checked


def test_zeros_of_gap_and_leader_for_no_leader_are_cut() -> None:
    for begin in (0, 300, 450):
        table = irregular().assign(follower_id=lambda x: x["episode"])
        table.loc[begin : begin + 149, ["gap_m", "leader_speed_mps"]] = 0.0
        kept, lines = Plausible().select(table.assign(row=table.index), "f.csv", rows_of)
        assert 150 <= len(table) - len(kept) <= 160, begin
        assert "lag 0.0 s of 3 pair(s)" in lines[-1], (begin, lines)


def test_jumps_do_not_hide_other_mistakes_and_many_are_refused() -> None:
    cut = with_gap(slice(300, 600), lambda x: x - 8.0)
    flicker = np.where(np.arange(1800) // 50 % 2, 0.0, 100.0)
    cases = [
        (cut.assign(gap_m=cut["gap_m"] / 0.3048), "is the gap in ft"),
        (cut.rename(columns=dict(zip(SPEEDS, SPEEDS[::-1], strict=True))), "exchanged"),
        (later(cut, "leader_speed_mps", 2.0), "leader 2.0 s late"),
        (with_gap(slice(None), lambda x: x + flicker), r"max_jump=4; expected the gap to one lead"),
    ]
    check_refused(judged, cases, DataError)


def scaled(columns: list[str], factor: float = 1.0, more: float = 0.0) -> pd.DataFrame:
    table = irregular()
    return table.assign(**{name: factor * table[name] + more for name in columns})


# Table, and what is reported of it; nothing where it is None.
BIASES = [
    (irregular(), None),
    (scaled(LEADER, more=-1.5), r"by \+1\.5 m/s .* Add 1\.5 m/s to the leader's, or multiply"),
    (scaled(FOLLOWER, more=-1.0), r"by -1\.0 m/s .* Add -1\.0 m/s to the leader's, or multiply"),
    (scaled(FOLLOWER, 1.03), r"by \+0\.[45] m/s .* multiply the follower's by 0\.97"),
    (scaled(LEADER, 1.05), r"by -0\.[78] m/s .* Add -0\.[78] m/s to the leader's"),
    (scaled(BOTH, 1.3), r"by 0\.77 m where both speeds give 1 m; is a clock .*3 of 3 pairs"),
    (scaled(BOTH, 1 / 1.3), r"by 1\.30 m where both speeds give 1 m; is a clock .*3 of 3 pairs"),
    (
        scaled(BOTH, 1.3).where(irregular()["episode"] == 1, irregular()),
        r"row 600, gap_m: the gap .* 0\.77 m where .* is a clock .*1 of 3 pairs",
    ),
    (
        scaled(LEADER, more=-1.5)
        .assign(gap_m=noisy(1.0)["gap_m"])
        .where(irregular()["episode"] == 1, irregular()),
        r"row 600, leader_speed_mps: .* by \+1\.5 m/s .*; 1 of 3 pairs",
    ),
]


def test_gaps_that_include_the_leaders_length_are_known_by_slow_cars() -> None:
    one = wavy().assign(gap_m=8.0, **dict.fromkeys(SPEEDS, 1.0))
    table = pd.concat([one, one.assign(episode=one["episode"] + 3)], ignore_index=True)
    words = "no gap is shorter than a car: do gaps include the leader's length"
    assert words in judged(table)[-1]
    near = table.assign(gap_m=table["gap_m"].where(table["episode"] > 0, 2.0))
    for other in (near, table.assign(leader_length_m=9.0), one):
        assert words not in judged(other)[-1]
    assert words in judged(table.assign(leader_length_m=0.0))[-1]


def test_a_slope_of_one_proves_the_units_of_speeds() -> None:
    far = wavy().assign(gap_m=lambda x: x["gap_m"] + 120.0)
    last = judged(far, {"follower_speed": "km/h", "leader_speed": "km/h"})[-1]
    assert "time gap" in last
    assert not isinstance(last, Concern), last


def test_a_biased_speed_or_a_slow_clock_is_reported_with_its_remedy() -> None:
    for table, words in BIASES:
        loud = " ".join(line for line in judged(table) if isinstance(line, Concern))
        assert re.search(words, loud) if words else not loud, (words, loud)


def test_a_relative_speed_is_no_leaders_speed() -> None:
    table = wavy()
    table[SPEEDS] = table[SPEEDS].add(2.6 * table["follower_speed_mps"], axis=0)  # own in km/h
    *_, last = judged(table, {"relative_speed": "m/s"})
    assert (type(last), last[-32:]) == (Concern, "data.units.follower_speed=km/h)?")
    slow = wavy().assign(gap_m=lambda x: x["gap_m"] + 120.0)
    *_, last = judged(slow, {"relative_speed": "m/s", "follower_speed": "km/h"})
    assert "; is the own speed in m/s (data.units.follower_speed=m/s)?" in last
    assert not isinstance(judged(slow, {"relative_speed": "m/s"})[-1], Concern)
    table = irregular()
    relative = table["leader_speed_mps"] - table["follower_speed_mps"]
    cases = [
        (table.assign(leader_speed_mps=0.1 * relative), "is the leader's speed relative to the fo"),
        (
            table.assign(leader_speed_mps=3 * relative),
            r"m/s \(is it relative to another car, or ag",
        ),
    ]
    check_refused(judged, cases, DataError)
    table["leader_speed_mps"] += table["follower_speed_mps"]  # relative_speed holds the leader's
    words = r"the follower does, by -2\.0.* is it the leader's speed \(data\.columns\.leader_speed"
    check_refused(judged, [(table, {"relative_speed": "m/s"}, words)], DataError)


def test_two_names_of_one_car_are_refused() -> None:
    same = irregular().assign(leader_speed_mps=lambda x: x["follower_speed_mps"])
    cases = [
        (same, "row 600, leader_speed_mps: both speeds are equal, but the gap changes.*3 of 3"),
        (irregular().assign(follower_id=7, leader_id=7), "row 0, leader_id is the follower itself"),
    ]
    check_refused(judged, cases, DataError)


def test_lengths_in_another_unit_than_positions_are_named(tmp_path) -> None:
    rows = pair(range(200), v_Length=15, Space_Headway=62, v_Vel=39)
    mixed = [row.copy() for row in rows]
    for row in mixed:
        for place in (5, 11, 12, 16):  # Local_Y, v_Vel, v_Acc, Space_Headway
            row[place] = f"{float(row[place]) * 0.3048:.4f}"
    path = tmp_path / "mixed.csv"
    path.write_text(csv_text(mixed))
    words = r"mixed\.csv: recording .* gap of 0\.\d+ s; are lengths alone in feet"
    check_refused(
        lambda unit: read_ngsim(path, units=unit), [(x, words) for x in METRES], DataError
    )
