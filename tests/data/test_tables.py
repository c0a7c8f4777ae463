"""Tables of any layout: columns, units, separators, leaders; native OpenACC files."""

from __future__ import annotations

import gzip
from functools import partial
from io import StringIO

import numpy as np
import pandas as pd
import pytest
from helpers import check_episodes, check_refused
from table_text import GAP, LENGTH, long_table, openacc_text, pairs, speed, written

from lcc_rl.config import load
from lcc_rl.data import text
from lcc_rl.data.car_following import Criteria
from lcc_rl.data.episodes import SCHEMA
from lcc_rl.data.leaders import Leaders
from lcc_rl.data.openacc import OpenAccSource
from lcc_rl.data.plausible import Plausible
from lcc_rl.data.smoothing import SavitzkyGolay
from lcc_rl.data.sources import EpisodesSource, LoadedEpisodes
from lcc_rl.data.speed_records import DRIVE_COLUMNS, read_drives
from lcc_rl.data.table_source import TableSource
from lcc_rl.data.trajectories import FOOT
from lcc_rl.errors import Concern, ConfigError, DataError
from lcc_rl.io.files import write_parquet

BASE = {"vehicle": "id", "time": "t", "speed": "v"}
BY_GAP = {**BASE, "leader": "ahead", "gap": "gap"}
BY_LANE = {**BASE, "lane": "lane", "position": "x", "length": "length"}


def truth(loaded: LoadedEpisodes, cars: int = 3) -> pd.DataFrame:
    """Check episodes against the motion they were made from, and return them."""
    table = check_episodes(loaded.episodes)
    assert table.groupby("episode")[["follower_id", "leader_id"]].first().to_numpy().tolist() == [
        [car, car - 1] for car in range(2, cars + 1)
    ]
    for (follower,), part in table.groupby(["follower_id"]):
        time = part["time_s"].to_numpy()
        for role, car in (("follower", follower), ("leader", follower - 1)):
            given = part[f"{role}_speed_mps"]
            np.testing.assert_allclose(given, speed(time, car), atol=2e-3)
        assert abs(part["gap_m"].iloc[0] - GAP) < 0.01
        between = part["leader_position_m"] - part["follower_position_m"]
        np.testing.assert_allclose(between, part["gap_m"] + part["leader_length_m"], atol=0.02)
    return table


# -- data=table ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "columns"), [("my.csv.gz", BY_GAP), ("my.parquet", BY_LANE)])
def test_the_leader_is_named_or_the_next_on_the_lane(tmp_path, name, columns) -> None:
    path = written(tmp_path, long_table(), name)
    loaded = TableSource(path=path, columns=columns).load()
    table = truth(loaded)
    assert len(table) == 800
    assert loaded.report[0] == f"read 1,200 rows from {path}; kept 1,200"
    assert table["leader_length_m"].iloc[0] == (LENGTH if "length" in columns else 0.0)


UNITS = {"time": ("ms", 1e-3), "speed": ("km/h", 1 / 3.6), "position": ("ft", 0.3048)}
UNITS |= {"gap": ("cm", 0.01), "length": ("ft", 0.3048)}


def test_units(tmp_path) -> None:
    frame, columns = long_table(), {**BY_GAP, **BY_LANE}
    for key, (_, size) in UNITS.items():
        frame[columns[key]] /= size
    units = {key: unit for key, (unit, _) in UNITS.items()}
    truth(TableSource(path=written(tmp_path, frame), columns=columns, units=units).load())


def test_smoothed_positions_far_from_zero_keep_their_precision(tmp_path) -> None:
    near, found = long_table(), []
    for frame in (near, near.assign(x=near["x"] + 4_200_000.0)):  # as northings
        settings = {"columns": BY_LANE, "smoothing": SavitzkyGolay()}
        found.append(TableSource(path=written(tmp_path, frame), **settings).load())
    for name in ("follower_speed_mps", "gap_m"):
        np.testing.assert_allclose(*(x.episodes[name] for x in found), atol=1e-3)
    assert any("positions are counted from the least" in line for line in found[1].report)


def test_times_of_a_clock(tmp_path) -> None:
    # As programs and as spreadsheets write them.
    for form, mark in (("{:02d}:{:02d}:{:04.1f}", "."), (" {:d}:{:02d}:{:04.1f}", ",")):
        frame, first = long_table(), 7 * 36_000 + 15 * 600
        tenths = (frame["t"] * 10.0).round().astype(int) + first
        parts = zip(tenths // 36_000, tenths // 600 % 60, tenths % 600 / 10.0, strict=True)
        clock = pd.Series([form.format(*part).replace(".", mark) for part in parts])
        for units in ({}, {"time": "hh:mm:ss"}):
            path = written(tmp_path, frame.assign(t=clock))
            found = TableSource(path=path, columns=BY_GAP, units=units).load().episodes
            assert found["time_s"].min() == pytest.approx(0.1 * first)
            truth(LoadedEpisodes(found.assign(time_s=found["time_s"] - 0.1 * first), []))
    clock[7] = "25:00:61"
    with pytest.raises(DataError, match=r"row 8.*'25:00:61'.*expected a number"):
        TableSource(path=written(tmp_path, frame.assign(t=clock)), columns=BY_GAP).load()


def test_separators_and_decimal_commas(tmp_path) -> None:
    frame = long_table().assign(gap=lambda table: table["gap"].fillna(99.0))
    for separator, decimal in ((";", ","), (";", "."), ("\t", "."), (" ", ".")):
        path = written(tmp_path, frame, sep=separator, decimal=decimal)
        loaded = TableSource(path=path, columns=BY_GAP).load()
        truth(loaded)
        assert any("columns are separated by" in line for line in loaded.report)
        assert any("decimal comma" in line for line in loaded.report) == (decimal == ",")


NAMES = {0: "0", 1: "Audi, A8", 2: "BMW", 3: "Ford"}


def named() -> pd.DataFrame:
    """The table with names of vehicles, in km/h and feet."""
    frame = long_table(rows=800).replace({"id": NAMES, "ahead": NAMES})
    return frame.assign(v=3.6 * frame["v"], gap=frame["gap"] / FOOT)


def test_names_keep_their_commas_and_number_the_vehicles(tmp_path) -> None:
    path = written(tmp_path, named(), sep=";", decimal=",")
    loaded = TableSource(path=path, columns=BY_GAP, units={"speed": "km/h", "gap": "ft"}).load()
    truth(loaded)
    assert loaded.vehicles == {1: "Audi, A8", 2: "BMW", 3: "Ford"}
    assert "3 vehicles are numbered from 1 by name: Audi, A8, BMW, Ford" in loaded.report


@pytest.mark.parametrize("code", ["utf-8", "latin-1", "utf-16"])
def test_a_file_larger_than_a_block_is_the_same_table(tmp_path, monkeypatch, code) -> None:
    frame = named().assign(note="–" if code == "utf-16" else "é")
    settings = {"columns": BY_GAP, "units": {"speed": "km/h", "gap": "ft"}}
    path = written(tmp_path, frame, sep=";", decimal=",", encoding=code)
    whole = TableSource(path=path, **settings).load()
    monkeypatch.setattr(text, "BLOCK_BYTES", 10_001)
    parts = TableSource(path=path, **settings).load()
    pd.testing.assert_frame_equal(parts.episodes, whole.episodes, check_exact=True)
    assert parts.report == whole.report
    frame = frame.astype(object)
    frame.loc[2000, "gap"] = "wide"
    with pytest.raises(DataError, match="data row 2001, column 'gap' holds 'wide'"):
        TableSource(path=written(tmp_path, frame), **settings).load()


FEET = {"gap": "ft"}
MISREAD = [
    (FEET, {"v": 80.0}, "row 801, vehicle BMW, column 'v' holds 80 m/s"),
    (FEET, {}, r"speed: m/s, gap: ft} for 't', 'v', 'gap': .* in km/h \(data.units.speed=km/h"),
    ({"speed": "km/h"}, {}, "speed: km/h, gap: m} for 't', 'v', 'gap': .*changes by 3"),
    ({"time": "ms"}, {}, "{time: ms, speed: m/s, gap: m} for .* is the time, .* in s"),
    ({}, {"t": 0.0}, "data row 2, vehicle Audi, A8, column 't' repeats .* as do 100 %"),
    ({}, {"t": 1e3}, "{time: s, speed: m/s, gap: m} for .* are 100 s apart"),
]


def test_errors_name_columns_units_and_vehicles(tmp_path) -> None:
    def read(units: dict[str, str], change: dict[str, float]) -> None:
        frame = named()
        for name, value in change.items():
            frame[name] = value if name == "v" else value * frame[name]
        TableSource(path=written(tmp_path, frame), columns=BY_GAP, units=units).load()

    cases = [(*given, rf"my\.csv.*{words}") for *given, words in MISREAD]
    check_refused(read, cases, DataError)


def test_samples_left_out_are_described_by_their_rows(tmp_path) -> None:
    frame = named().sample(frac=1.0, random_state=0)  # in any order
    frame.iloc[700, frame.columns.get_loc("v")] = 3.6 * 90.0
    frame.iloc[[800, 900], frame.columns.get_loc("gap")] = np.nan
    frame.iloc[[800, 900], frame.columns.get_loc("ahead")] = ["BMW", "0"]
    path, units = written(tmp_path, frame), {"speed": "km/h", "gap": "ft"}
    source = TableSource(path=path, columns=BY_GAP, units=units, plausible=Plausible(max_share=0.5))
    report = "\n".join(source.load().report)
    vehicle = frame["id"].iloc[700]
    assert f"data row 701, vehicle {vehicle}, column 'v' holds 90 m/s" in report
    blank = f"the first: {path}: data row 801, column 'gap' is blank"
    assert f"1 samples have a leader but a blank gap, {blank}" in report


@pytest.mark.parametrize(("step", "columns"), [(0.04, BY_GAP), (1.0, BY_LANE)])
def test_other_steps_are_interpolated(tmp_path, step, columns) -> None:
    path = written(tmp_path, long_table(rows=round(40 / step), step=step))
    loaded = TableSource(path=path, columns=columns).load()
    table = check_episodes(loaded.episodes)
    assert np.allclose(table.groupby("episode")["time_s"].diff().dropna(), 0.1)
    for (follower,), part in table.groupby(["follower_id"]):
        expected = speed(part["time_s"].to_numpy(), follower)
        np.testing.assert_allclose(part["follower_speed_mps"], expected, atol=0.06 * step + 1e-3)
        assert abs(part["gap_m"].iloc[0] - GAP) < 0.01
    how = "averaged over" if step < 0.1 else "interpolated to"
    assert f"samples {step:g} s apart were {how} 0.1 s" in loaded.report


def test_jitter_is_interpolated_and_holes_divide(tmp_path) -> None:
    frame = long_table()
    frame["t"] += np.random.default_rng(0).uniform(-0.02, 0.02, len(frame))
    frame["v"] = np.concatenate([speed(part["t"], car) for car, part in frame.groupby("id")])
    frame = frame.drop(index=range(600, 610))  # of vehicle 2, after 20 s
    loaded = TableSource(path=written(tmp_path, frame), columns=BY_GAP).load()
    lengths = loaded.episodes.groupby(["follower_id", "episode"]).size()
    assert len(lengths) == 4
    assert any("cut their trajectories 1 times" in line for line in loaded.report)
    for (follower,), part in loaded.episodes.groupby(["follower_id"]):
        expected = speed(part["time_s"].to_numpy(), follower)
        np.testing.assert_allclose(part["follower_speed_mps"], expected, atol=0.01)


def test_a_leader_that_is_not_there_and_duplicates_are_counted(tmp_path) -> None:
    frame = long_table()
    frame = pd.concat([frame, frame.iloc[[5, 6]]])
    frame.loc[frame["id"] == 2, "ahead"] = 77
    frame.loc[frame["id"] == 1, "ahead"] = 1
    frame.loc[20, "v"] = np.nan
    empty = pd.DataFrame({"t": [999.0]})  # as SUMO writes where the road is empty
    path = written(tmp_path, pd.concat([frame, empty]))
    loaded = TableSource(path=path, columns=BY_GAP).load()
    words = "dropped 2 rows: rows that repeat a time of their vehicle, 0 of them with"
    assert any(line.startswith(words) for line in loaded.report)
    assert "dropped 2 rows: blank time, speed or position" in loaded.report
    assert loaded.episodes["follower_id"].unique().tolist() == [3]
    unseen = "left out 400 samples: the preceding vehicle is not seen in that frame, the first: "
    assert any(x.startswith(unseen) for x in loaded.report)
    assert any("samples name the vehicle itself as its leader" in x for x in loaded.report)


def test_the_first_sample_left_out_is_named_by_file_row_and_column(tmp_path) -> None:
    frame = long_table()
    frame.loc[700, "gap"] = -1.0
    frame.loc[1100, "ahead"] = 77
    path = written(tmp_path, frame)
    report = TableSource(path=path, columns=BY_GAP).load().report
    where = "the first: recording my, data row"
    assert [line for line in report if line.startswith("left out 1 sample:")] == [
        f"left out 1 sample: the preceding vehicle is not seen in that frame, {where} 1101, "
        "vehicle 3, column 'ahead'",
        f"left out 1 sample: gap beyond min_gap_m=0, {where} 701, vehicle 2, column 'gap'",
    ]


def test_a_unit_declared_for_si_is_named(tmp_path) -> None:
    frame = named()
    frame["v"] *= 3.0 / 3.6  # m/s, fast enough to tell
    frame["gap"] *= 3.0 * FOOT
    path = written(tmp_path, frame)
    feet = r"gap in m \(data.units.gap=m\)\? or are both speeds in ft/s .*=ft/s\)\?;"
    metres = r"are both speeds in m/s \(data.units.speed=m/s\)\?;"
    both = r"where the leader drives 1 m, .*{} 2 of 2 pairs"
    cases = [
        ({"gap": "ft"}, both.format(feet)),
        ({"speed": "km/h"}, both.format(metres)),
        ({"speed": "kn"}, both.format(metres)),
        ({"time": "ms"}, r"0\.0001 s apart; .* is the time, .* in s \(data\.units\.time="),
    ]
    read = partial(TableSource, path=path, columns=BY_GAP)
    check_refused(lambda units: read(units=units).load(), cases, DataError)


# Columns, what is in another unit, by which factor, of which car, and what is said.
OTHER_UNIT = [
    (BY_GAP, "v", 3.6, 2, r"row 601, vehicle 2, .*is the leader's speed in km/h\?; 2 of 7 pairs"),
    (BY_GAP, "v", 3.6, 1, "row 1, vehicle 1, .*is the leader's speed in km/h"),
    (BY_GAP, "gap", 1 / FOOT, 3, "row 1201, vehicle 3, .*'gap': .* by 3.28 .*gap=ft.*1 of 7"),
    (
        BY_LANE,
        *("v", 3.6, 7),
        "by its positions the vehicle from .*data row 3601, vehicle 7, on drives 726 m, by its",
    ),
    (BY_LANE, "x", 1 / FOOT, 7, "data row 3601, vehicle 7, on drives 2382 m, by its sp"),
]


def test_one_vehicle_in_another_unit_is_named(tmp_path) -> None:
    def read(columns: dict[str, str], name: str, factor: float, car: int) -> None:
        frame = long_table(cars=8, rows=600)
        frame.loc[frame["id"] == car, name] *= factor
        limits = Plausible(max_acceleration=30.0)
        TableSource(path=written(tmp_path, frame), columns=columns, plausible=limits).load()

    cases = [(*given, rf"my\.csv, with .*{words}") for *given, words in OTHER_UNIT]
    check_refused(read, cases, DataError)


def test_one_pair_in_another_unit_is_named_as_the_file_calls_it(tmp_path) -> None:
    names = {"leader_speed": "ahead", "follower_speed": "v"}
    table = pairs(episodes=3, rows=120).rename(columns={f"{x}_mps": names[x] for x in names})
    table[["v", "ahead"]] *= 3.6
    table.loc[table["episode"] == 1, "v"] /= 3.6
    kmh, path = dict.fromkeys(names, "km/h"), written(tmp_path, table)
    source = EpisodesSource(path=path, columns=names, units=kmh)
    words = r"data row 121, column 'v': by their .* follower's speed in m/s \(d.*; 1 of 3"
    with pytest.raises(DataError, match=words):
        source.load()


def test_the_report_of_an_extraction_without_episode_is_divided_by_semicolons(tmp_path) -> None:
    path = written(tmp_path, long_table(rows=100))
    with pytest.raises(
        DataError, match=r"lasts 9\.9 s; 2 candidates: .* another; removed 2: min_d"
    ):
        TableSource(path=path, columns=BY_GAP).load()


def test_impossible_tables() -> None:
    cases = [
        ({"units": {"speed": "kmh"}}, r"unit in data\.units\.speed: 'kmh'.*Did you mean 'km/h'"),
        ({"columns": {**BY_GAP, "sped": "w"}}, "'sped'.*Did you mean 'speed'"),
        ({"columns": {**BY_GAP, "time": None}}, r"data\.columns\.time must name a column"),
        ({"columns": {**BY_GAP, "leader": None}}, "must name leader, or lane and position"),
        ({"columns": {**BY_GAP, "gap": None}}, "must name gap, or position and length"),
        ({"columns": {**BY_GAP, "gap": "t"}}, "names the column 't' twice"),
        ({"vehicle_length": -1.0}, "vehicle_length must be greater"),
        ({"smoothing": SavitzkyGolay()}, "smooths positions"),
        *(
            (
                {"units": {"time": unit}},
                r"unit in data\.units\.time: .*frames/<rate>, hh:mm:ss, iso, min",
            )
            for unit in ("frames/0", "frames/-1", "frames/x", "frames/nan", "frames")
        ),
    ]
    usual = {"path": "x.csv", "columns": BY_GAP}
    check_refused(lambda settings: TableSource(**{**usual, **settings}), cases, ConfigError)


# -- data=episodes ---------------------------------------------------------------------------------


def test_episodes_from_csv_without_positions(tmp_path) -> None:
    whole = TableSource(path=written(tmp_path, long_table()), columns=BY_GAP).load().episodes
    names = ["leader_length_m", "leader_position_m", "follower_position_m", "recording"]
    path = written(tmp_path, whole.drop(columns=names), "pairs.csv", sep=";", decimal=",")
    loaded = EpisodesSource(path=path).load()
    np.testing.assert_allclose(truth(loaded)["gap_m"], whole["gap_m"], atol=1e-4)
    assert loaded.episodes["recording"].unique().tolist() == ["pairs"]
    assert any("no positions given" in line for line in loaded.report)
    full = written(tmp_path, whole, "whole.csv.gz")
    pd.testing.assert_frame_equal(
        EpisodesSource(path=str(full)).load().episodes, whole, check_exact=False, check_dtype=False
    )


def test_a_written_table_reads_back_whatever_its_order_and_names(tmp_path) -> None:
    write_parquet(pairs(), tmp_path / "pairs.parquet")
    back = EpisodesSource(path=str(tmp_path / "pairs.parquet")).load().episodes
    assert {str(name): str(kind) for name, kind in back.dtypes.items()} == SCHEMA
    pd.testing.assert_frame_equal(back, pairs(), check_dtype=False)
    other = pairs()[[*SCHEMA][::-1]].assign(comment="x")
    other = other.rename(columns={"episode": "event", "recording": "period"})
    path = written(tmp_path, other, "other.parquet")
    pd.testing.assert_frame_equal(EpisodesSource(path=str(path)).load().episodes, back)


def test_pairs_of_any_columns_units_and_rate_with_holes(tmp_path) -> None:
    whole = TableSource(path=written(tmp_path, long_table(rows=800)), columns=BY_GAP).load()
    found = whole.episodes
    mine = pd.DataFrame(
        {
            "run": [f"run {name}" for name in found["episode"]],
            "clock": 1000.0 * found["time_s"],
            "lead": 3.6 * found["leader_speed_mps"],
            "own": 3.6 * found["follower_speed_mps"],
            "space": found["gap_m"] / FOOT,
        }
    )
    mine = mine.drop(index=[300, 301, 302]).iloc[::2]  # 5 Hz, with a hole in the first run
    path = written(tmp_path, mine.sort_values("clock", kind="stable"), "mine.csv")
    columns = {"episode": "run", "time": "clock", "leader_speed": "lead", "gap": "space"}
    units = {"time": "ms", "leader_speed": "km/h", "follower_speed": "km/h", "gap": "ft"}
    source = EpisodesSource(path=path, columns={**columns, "follower_speed": "own"}, units=units)
    loaded = source.load()
    check_episodes(loaded.episodes)
    assert loaded.episodes.groupby("episode").size().tolist() == [299, 799, 497]
    pair = loaded.episodes.groupby("episode")[["follower_id", "leader_id"]].first()
    assert pair["leader_id"].tolist() == (pair["follower_id"] - 1).tolist()
    for number, follower in ((0, 2), (1, 3), (2, 2)):
        part = loaded.episodes[loaded.episodes["episode"] == number]
        own, ahead = (speed(part["time_s"].to_numpy(), car) for car in (follower, follower - 1))
        np.testing.assert_allclose(part["follower_speed_mps"], own, atol=0.01)
        np.testing.assert_allclose(part["leader_speed_mps"], ahead, atol=0.01)
    report = "\n".join(loaded.report)
    assert "1 holes longer than data.bridge_s=0.1 divide 2 episodes into 3" in report
    assert "samples 0.2 s apart were interpolated to 0.1 s" in report


def test_files_of_pairs_are_recordings_of_their_own(tmp_path) -> None:
    for name in ("a", "b"):
        pairs().drop(columns="recording").to_csv(tmp_path / f"{name}.csv", index=False)
    loaded = EpisodesSource(path=str(tmp_path / "*.csv")).load().episodes
    assert loaded.groupby("recording")["episode"].nunique().to_dict() == {"a": 20, "b": 20}
    assert loaded["episode"].nunique() == 40


# -- native OpenACC files --------------------------------------------------------------------------


@pytest.fixture
def openacc(tmp_path) -> str:
    path = tmp_path / "platoon.csv.gz"
    path.write_bytes(gzip.compress(openacc_text().encode()))
    return str(path)


def test_every_car_follows_the_car_before_it(openacc) -> None:
    loaded = OpenAccSource(path=openacc).load()
    loaded.episodes["time_s"] -= 430
    truth(loaded)
    assert f"{openacc}: 3 cars: SMART, MAZDA, TESLA" in loaded.report
    assert "by driver: 2 unmarked (header: ACC,1); data.driver=human" in "\n".join(loaded.report)


def test_columns_of_missing_cars_are_absent_and_followers_are_chosen(tmp_path) -> None:
    text = openacc_text(cars=5)
    head, table = text.split("Distance_setting,S\n")
    frame = pd.read_csv(StringIO(table)).drop(columns=["Speed3", "IVS2", "IVS3"])
    frame["Driver2"], frame["Driver5"] = "ACC", ["Human"] * 300 + ["ACC"] * 100
    path = tmp_path / "platoon.csv"
    path.write_text(f"{head}Distance_setting,S\n{frame.to_csv(index=False)}")
    loaded = OpenAccSource(path=str(path)).load()
    assert loaded.episodes["follower_id"].unique().tolist() == [2, 5]
    assert "by driver: 1 ACC, 1 ACC and Human (header" in "\n".join(loaded.report)
    found = OpenAccSource(path=str(path), driver="human").load()
    assert found.episodes["follower_id"].tolist() == [5] * 300
    assert f"{path}: 300 samples of followers driven by human, 500 of others" in found.report


def test_native_files_of_other_campaigns(shared_data) -> None:
    for name in ("casale", "zalazone_dynamic_part26"):
        path = shared_data / f"new_openacc_native_{name}.csv.gz"
        criteria = Criteria(max_gap_m=200.0, passenger_cars_only=False)
        loaded = OpenAccSource(path=str(path), criteria=criteria).load()
        check_episodes(loaded.episodes)
        assert len(loaded.episodes) > 1900


def test_a_real_openacc_file(shared_data) -> None:
    path = shared_data / "openacc_astazero_acc_short_9cars.csv.gz"
    if not path.is_file():
        pytest.skip(f"no native OpenACC file in {shared_data}")
    loaded = OpenAccSource(path=str(path)).load()
    assert "dropped 2 rows: blank speed" in loaded.report
    check_episodes(loaded.episodes)
    assert loaded.episodes["follower_id"].unique().tolist() == [2, 3, 4, 5, 6, 7, 8, 9]
    assert 4.0 < loaded.episodes["gap_m"].min() < loaded.episodes["gap_m"].max() < 30.0


def test_lengths_in_feet_are_named(tmp_path) -> None:
    frame = long_table()
    feet = frame.assign(length=frame["length"] / 0.3048)
    path = written(tmp_path, feet, "feet.csv")
    words = (
        r"feet\.csv.* the median length of vehicles is 1\d\.?\d* m; .*data\.units\.length=ft, or m"
    )
    some = frame.assign(length=frame["length"].where(frame["id"] != 2))
    blank = written(tmp_path, some, "blank.csv")
    remedy = r"blank\.csv: data row 401, column 'length' is blank or 0; data\.vehicle_length sets"
    cases = [(path, words), (blank, remedy)]
    check_refused(lambda x: TableSource(path=x, columns=BY_LANE).load(), cases, DataError)
    names = ", ".join(f"{key}: {name}" for key, name in BY_LANE.items())
    told = ["data=table", f"data.path={path}", f"data.columns={{{names}}}"]
    with pytest.raises(DataError, match=words):  # as the command line reads it
        load("calibrate", told).data.made(TableSource).load()
    load("calibrate", [*told, "data.units.length=ft"]).data.made(TableSource).load()
    gaps = [
        TableSource(path=path, columns=BY_LANE, units={"length": x}).load().episodes["gap_m"].mean()
        for x in ("ft", "m")
    ]
    assert gaps[0] == pytest.approx(gaps[1] + (1 / 0.3048 - 1) * frame["length"].mean(), rel=1e-3)


# -- the log of one car ----------------------------------------------------------------------------

SPEEDS = ["leader_speed_mps", "follower_speed_mps"]
LOG = {"time": "t", "follower_speed": "v", "gap": "range", "relative_speed": "range_rate"}
LOG |= {"valid": "ok", "target": "id", "leader_speed": None}
KMH = {"leader_speed": "km/h"}


def car_log() -> pd.DataFrame:
    """100 s at 50 Hz behind target 7, then 9, which is 12 m nearer; a second without a target."""
    time = np.arange(5000) * 0.02
    own, ahead = 15.0 + np.sin(time / 5.0), 15.0 + 2.0 * np.sin(time / 7.0)
    gap = 40.0 + np.cumsum(ahead - own) * 0.02 - 12.0 * (time >= 60.0)
    log = pd.DataFrame({"t": time, "v": own, "range": gap, "range_rate": ahead - own})
    log["ok"], log["id"] = (time < 30.0) | (time >= 31.0), np.where(time < 60.0, 7, 9)
    log.loc[~log["ok"], ["range", "range_rate", "id"]] = 0
    return log


def test_the_log_of_a_car_has_relative_speeds_targets_and_a_flag(tmp_path) -> None:
    log = car_log()
    other = log.assign(ok=log["ok"].map({True: "yes", False: "No"}), id=log["id"].map("t{}".format))
    for path, table in (("log.csv", log), ("log.parquet", log), ("words.csv", other)):
        name = tmp_path / path
        table.to_parquet(name) if name.suffix == ".parquet" else table.to_csv(name, index=False)
        loaded = EpisodesSource(path=str(name), columns=LOG).load()
        found = loaded.episodes
        assert len(found["episode"].unique()) == 3
        assert any("left out 50 rows without a valid target" in line for line in loaded.report)
        assert found["follower_id"].nunique() == 1
        assert found["leader_id"].nunique() == 2
        ids = [loaded.vehicles[number].split()[-1] for number in found["leader_id"].unique()]
        assert ids == [*map(str, table["id"][table["ok"].isin([True, "yes"])].unique())]
        for _, part in found.groupby("episode"):
            time = part["time_s"]
            np.testing.assert_allclose(
                part["leader_speed_mps"], 15.0 + 2.0 * np.sin(time / 7.0), atol=1e-3
            )
            assert part["gap_m"].diff().abs().max() < 0.5
    log.assign(range_rate=3.6 * log["range_rate"]).to_csv(tmp_path / "fast.csv", index=False)
    units = {"relative_speed": "km/h"}
    fast = EpisodesSource(path=str(tmp_path / "fast.csv"), columns=LOG, units=units).load()
    np.testing.assert_allclose(fast.episodes[SPEEDS], found[SPEEDS], atol=1e-4)
    with pytest.raises(DataError, match=r"data.units.leader_speed=km/h has no effect: no column"):
        EpisodesSource(path=str(tmp_path / "log.csv"), columns=LOG, units=KMH).load()
    none = log.assign(range_rate=log["range_rate"].where(log["ok"], 255))
    none.drop(columns="ok").to_csv(tmp_path / "none.csv", index=False)
    plain = {key: name for key, name in LOG.items() if name not in ("ok", "id")}
    report = "".join(EpisodesSource(path=str(tmp_path / "none.csv"), columns=plain).load().report)
    assert "'v' + 'range_rate' holds 167.108 m/s (is it in km/h or ft/s, or a value for" in report
    bad = other.assign(ok="maybe")
    bad.to_csv(tmp_path / "bad.csv", index=False)
    with pytest.raises(DataError, match="data row 1, column 'ok' is 'maybe'; expected 1 or 0"):
        EpisodesSource(path=str(tmp_path / "bad.csv"), columns=LOG).load()


def test_a_log_with_one_speed_in_another_unit_is_refused(tmp_path) -> None:
    found = EpisodesSource(path="platoons").load().episodes
    log = pd.DataFrame({"t": found["time_s"] + 1000.0 * found["episode"], "v": found[SPEEDS[1]]})
    log["range"], log["range_rate"] = found["gap_m"], found[SPEEDS[0]] - log["v"]
    log.assign(ok=1, id=found["episode"] + 1).to_csv(tmp_path / "log.csv", index=False)

    def read(**units: str):
        return EpisodesSource(path=str(tmp_path / "log.csv"), columns=LOG, units=units)

    report = read().load().report[-1]
    assert "slope of gaps over speeds 0.96" in report
    assert report.endswith("between gap and relative_speed, own speed's clock and unit not checked")
    words = r"where the follower's speed changes by 1 m/s, relative_speed changes by -3\.\d\d m/s; "
    words += r"is the follower's speed in m/s \(data\.units\.follower_speed=m/s\)\?.*max_mismatch"
    other = r"is the relative speed in m/s \(data\.units\.relative_speed=m/s\)\?"
    cases = [("follower_speed", words), ("relative_speed", other)]
    check_refused(lambda key: read(**{key: "km/h"}).load(), cases, DataError)
    log.assign(ok=1, range_rate=-log["range_rate"], id=found["episode"] + 1).to_csv(
        tmp_path / "log.csv", index=False
    )
    with pytest.raises(DataError, match=r"'range_rate': .* own speed minus the leader's\?"):
        read().load()


def test_a_recording_that_is_read_twice_is_reported(tmp_path) -> None:
    found = EpisodesSource(path="platoons").load().episodes.query("episode < 2")
    for name in ("a.csv", "b.parquet"):
        path = tmp_path / name
        found.to_csv(path) if name == "a.csv" else found.to_parquet(path)
    pairs = EpisodesSource(path=str(tmp_path), columns={"recording": None}).load().report
    assert [x for x in pairs if isinstance(x, Concern) and "recordings a, b hold the same" in x]
    one = EpisodesSource(path=str(tmp_path / "a.csv"), columns={"recording": None}).load().report
    assert not [x for x in one if isinstance(x, Concern)]
    drive = found.rename(columns={"leader_speed_mps": "speed_mps"})[["time_s", "speed_mps"]][:200]
    for name in ("c.csv", "d.csv"):
        drive.to_csv(tmp_path / name)
    _, lines = read_drives([str(tmp_path / x) for x in ("c.csv", "d.csv")], DRIVE_COLUMNS, 0.1)
    assert [x for x in lines if isinstance(x, Concern) and "recordings c, d hold the same" in x]


def test_gaps_and_positions_that_contradict_each_other_are_refused(tmp_path) -> None:
    found = EpisodesSource(path="platoons").load().episodes.assign(leader_length_m=4.5)
    found["follower_position_m"] -= 4.5

    def read(**columns) -> None:
        found.assign(**columns).to_parquet(tmp_path / "pairs.parquet")
        EpisodesSource(path=str(tmp_path / "pairs.parquet")).load()

    read()
    gap, far = found["gap_m"] + 4.5, found["follower_position_m"] / FOOT
    cases = [
        ({"gap_m": gap}, r"median gap \+4\.5 m from that of positions and .*'gap_m'"),
        ({"follower_position_m": far}, r"by their positions followers drive .* by their speeds"),
    ]
    check_refused(lambda columns: read(**columns), cases, DataError)


def test_episodes_named_by_texts_name_their_drivers(tmp_path) -> None:
    pair = {"time_s": 0.1 * np.arange(300), "gap_m": 20.0}
    pair |= {"leader_speed_mps": 10.0, "follower_speed_mps": 10.0}
    for names, expected in (("ab", ["a", "b"]), ("01", [])):
        pairs = pd.concat([pd.DataFrame(pair).assign(episode=name) for name in names])
        pairs.to_csv(tmp_path / "pairs.csv", index=False)
        loaded = EpisodesSource(path=str(tmp_path / "pairs.csv")).load()
        found = map(loaded.vehicles.get, loaded.episodes["follower_id"].unique())
        assert [name for name in found if name] == expected


def test_speeds_are_averaged_within_their_drive_by_its_own_step(tmp_path) -> None:
    time = np.delete(0.1 * np.arange(400), slice(150, 200))
    drives = [pd.DataFrame({"drive": x, "time_s": time, "speed_mps": x}) for x in (10.0, 20.0)]
    drives[1] = drives[1].iloc[:150]  # a part of the first drive has a number beyond this one's
    slow = 15.0 + np.sin(np.arange(60.0) / 2.0)  # 1 Hz: no other sample is within 0.5 s
    drives.append(pd.DataFrame({"drive": 30.0, "time_s": np.arange(60.0), "speed_mps": slow}))
    pd.concat(drives).to_csv(tmp_path / "some.csv", index=False)
    found, _ = read_drives(str(tmp_path / "some.csv"), DRIVE_COLUMNS, 0.1, average_s=0.5)
    for index, drive in enumerate(map(float, found.recordings)):
        seconds = found.record(index)[::10] if drive == 30.0 else found.record(index)
        np.testing.assert_allclose(seconds, slow if drive == 30.0 else drive, rtol=1e-6)


def test_noisy_speeds_of_a_fast_raster_are_smoothed_by_the_option_of_the_message(tmp_path) -> None:
    log = car_log()
    noise = 0.2 * np.random.default_rng(0).normal(size=len(log))
    log.assign(v=log["v"] + noise).to_csv(tmp_path / "fast.csv", index=False)
    words = ["leader=record", f"leader.path={tmp_path / 'fast.csv'}"]
    words += ["leader.columns={time: t, speed: v}"]

    def read(*more: str) -> Leaders:
        return load("train", ["variant=alcc", *words, *more]).leader.made().load(0.1, 100)

    with pytest.raises(DataError, match=r"smooth it \(leader.average_s=0.5\)"):
        read()
    found = read("leader.average_s=0.5").training.record(0)
    time = 0.24 + 0.1 * np.arange(len(found))
    np.testing.assert_allclose(found, 15.0 + np.sin(time / 5.0), atol=0.2)
    with pytest.raises(DataError, match=r"no record is as long as leader\.average_s=500"):
        read("leader.average_s=500")
    # Pairs: means of the same samples, 5 by default and 25 with the same option.
    source = {"path": str(tmp_path / "fast.csv"), "columns": LOG}
    for seconds, deviation in ((0.0, 0.2 / 5**0.5), (0.5, 0.2 / 25**0.5)):
        pairs = EpisodesSource(**source, average_s=seconds).load()
        assert any("samples 0.02 s apart were averaged over 0.1 s" in x for x in pairs.report)
        first = pairs.episodes[pairs.episodes["episode"] == 0]
        time = first["time_s"].to_numpy()
        error = first["follower_speed_mps"] - 15.0 - np.sin(time / 5.0)
        assert error.std() == pytest.approx(deviation, rel=0.2)
