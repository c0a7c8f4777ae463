"""Tables of any layout: columns, units, separators, leaders; native OpenACC files."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from table_text import GAP, LENGTH, long_table, openacc_text, speed

from lcc_rl.config import load
from lcc_rl.data.episodes import read_episodes, validate_episodes
from lcc_rl.data.openacc import OpenAccSource
from lcc_rl.data.sources import EpisodesSource, LoadedEpisodes
from lcc_rl.data.speed_records import read_speed_record
from lcc_rl.data.table_source import TableSource
from lcc_rl.envs import load_inputs
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.nodes import build

BASE = {"vehicle": "id", "time": "t", "speed": "v"}
BY_GAP = {**BASE, "leader": "ahead", "gap": "gap"}
BY_LANE = {**BASE, "lane": "lane", "position": "x", "length": "length"}


def written(folder: Path, frame: pd.DataFrame, name: str = "my.csv", **options: object) -> str:
    path = folder / name
    if path.suffix == ".parquet":
        frame.to_parquet(path)
    else:
        frame.to_csv(path, index=False, **options)
    return str(path)


def truth(loaded: LoadedEpisodes, cars: int = 3) -> pd.DataFrame:
    """Check episodes against the motion they were made from, and return them."""
    table = validate_episodes(loaded.episodes, "episodes")
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


@pytest.mark.parametrize("name", ["my.csv", "my.csv.gz", "my.parquet"])
@pytest.mark.parametrize("columns", [BY_GAP, BY_LANE])
def test_the_leader_is_named_or_the_next_on_the_lane(tmp_path, name, columns) -> None:
    path = written(tmp_path, long_table(), name)
    loaded = TableSource(path=path, columns=columns).load()
    table = truth(loaded)
    assert len(table) == 800
    assert loaded.report[0] == f"read 1,200 rows from {path}; kept 1,200"
    assert table["leader_length_m"].iloc[0] == (LENGTH if "length" in columns else 0.0)


def test_all_from_the_command_line(tmp_path) -> None:
    path = written(tmp_path, long_table())
    columns = "{vehicle: id, time: t, speed: v, leader: ahead, gap: gap, position: x}"
    said = ["variant=alcc", "split.by=vehicle", "data=table", f"data.path={path}"]
    inputs = load_inputs(load("train", [*said, f"data.columns={columns}"]))
    assert (len(inputs.training), len(inputs.evaluation)) == (1, 1)


UNITS = {"time": ("ms", 1e-3), "speed": ("km/h", 1 / 3.6), "position": ("ft", 0.3048)}
UNITS |= {"gap": ("cm", 0.01), "length": ("ft", 0.3048)}


def test_units(tmp_path) -> None:
    frame, columns = long_table(), {**BY_GAP, **BY_LANE}
    for key, (_, size) in UNITS.items():
        frame[columns[key]] /= size
    units = {key: unit for key, (unit, _) in UNITS.items()}
    truth(TableSource(path=written(tmp_path, frame), columns=columns, units=units).load())


@pytest.mark.parametrize(
    ("separator", "decimal"), [(";", ","), (";", "."), ("\t", "."), (" ", ".")]
)
def test_separators_and_decimal_commas(tmp_path, separator, decimal) -> None:
    frame = long_table().assign(gap=lambda table: table["gap"].fillna(99.0))
    path = written(tmp_path, frame, sep=separator, decimal=decimal)
    loaded = TableSource(path=path, columns=BY_GAP).load()
    truth(loaded)
    assert any("columns are separated by" in line for line in loaded.report)
    assert any("decimal comma" in line for line in loaded.report) == (decimal == ",")


def test_a_byte_order_mark_and_shuffled_rows(tmp_path) -> None:
    frame = long_table().sample(frac=1.0, random_state=0)
    path = written(tmp_path, frame, encoding="utf-8-sig")
    loaded = TableSource(path=path, columns=BY_GAP).load()
    truth(loaded)
    assert "rows of a vehicle are not in order of time: sorted" in loaded.report


@pytest.mark.parametrize("step", [0.04, 0.5, 1.0])
@pytest.mark.parametrize("columns", [BY_GAP, BY_LANE])
def test_other_steps_are_interpolated(tmp_path, step, columns) -> None:
    path = written(tmp_path, long_table(rows=round(40 / step), step=step))
    loaded = TableSource(path=path, columns=columns).load()
    table = validate_episodes(loaded.episodes, "episodes")
    assert np.allclose(table.groupby("episode")["time_s"].diff().dropna(), 0.1)
    for (follower,), part in table.groupby(["follower_id"]):
        expected = speed(part["time_s"].to_numpy(), follower)
        np.testing.assert_allclose(part["follower_speed_mps"], expected, atol=0.06 * step + 1e-3)
        assert abs(part["gap_m"].iloc[0] - GAP) < 0.01
    assert f"samples {step:g} s apart were interpolated to 0.1 s" in loaded.report


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


def test_text_names_and_a_change_of_lane(tmp_path) -> None:
    names = {1: "front", 2: "middle", 3: "rear", 0: ""}
    frame = long_table().replace({"id": names, "ahead": names})
    loaded = TableSource(path=written(tmp_path, frame), columns=BY_GAP).load()
    truth(loaded)
    assert "vehicles are numbered from 1 in the order of 3 names" in loaded.report
    frame = long_table()
    frame.loc[frame["id"].eq(2) & frame["t"].ge(20), "lane"] = "right"
    pairs = TableSource(path=written(tmp_path, frame), columns=BY_LANE).load().episodes
    followed = pairs.groupby(["follower_id", "leader_id"]).size().to_dict()
    assert followed == {(2, 1): 200, (3, 1): 200, (3, 2): 200}


def test_a_leader_that_is_not_there_and_duplicates_are_counted(tmp_path) -> None:
    frame = long_table()
    frame = pd.concat([frame, frame.iloc[[5, 6]]])
    frame.loc[frame["id"] == 2, "ahead"] = 77
    loaded = TableSource(path=written(tmp_path, frame), columns=BY_GAP).load()
    assert "dropped 2 rows: exact duplicate (vehicle, time)" in loaded.report
    assert loaded.episodes["follower_id"].unique().tolist() == [3]
    assert any(
        "400 samples that name a preceding vehicle that is not seen" in x for x in loaded.report
    )


def test_several_files_are_recordings(tmp_path) -> None:
    for name in ("a.csv", "b.csv"):
        written(tmp_path, long_table(), name)
    loaded = TableSource(path=f"{tmp_path}/?.csv", columns=BY_GAP).load()
    assert loaded.episodes["recording"].unique().tolist() == ["a", "b"]
    column = {**BY_GAP, "recording": "lane"}
    one = TableSource(path=str(tmp_path / "a.csv"), columns=column).load()
    assert one.episodes["recording"].unique().tolist() == ["left"]


def change(row: int, **cells: object):
    def apply(frame: pd.DataFrame) -> pd.DataFrame:
        frame = frame.astype(dict.fromkeys(cells, object))
        frame.loc[row, list(cells)] = list(cells.values())
        return frame

    return apply


WRONG = {
    "text": (change(500, v="fast"), "data row 501, column 'v' holds 'fast'"),
    "blank": (change(500, v=""), "data row 501, column 'v' holds nothing"),
    "infinite": (change(500, v="inf"), "data row 501, column 'v' holds 'inf'"),
    "infinite gap": (change(500, gap="-inf"), "data row 501, column 'gap' holds '-inf'"),
    "negative gap": (change(500, gap=-1), "data row 501, column 'gap' holds '-1'"),
    "negative speed": (change(500, v=-1), "data row 501, column 'v' holds '-1'"),
    "no vehicle": (change(500, id=""), "data row 501, column 'id' is blank"),
    "conflict": (
        change(500, t=9.9),
        "data row 501 and data row 500 differ, but are of one vehicle",
    ),
    "close": (change(500, t=9.91), r"data row 501 is 0\.01 s after the sample before it"),
    "huge": (change(500, v=1e20), r"data row 501, column 'v' holds '1e\+20'"),
    "late": (change(1199, t=1e11), r"data row 1200 is 1e\+11 s after the first"),
    "ms": (lambda frame: frame.assign(t=1e3 * frame["t"]), "are 100 s apart; .*another unit"),
    "missing": (
        lambda frame: frame.rename(columns={"v": "V"}),
        r"lacks the column v; .*is it 'V'",
    ),
    "twice": (lambda frame: pd.concat([frame, frame["v"]], axis=1), "has column 'v' twice"),
    "empty": (lambda frame: frame.iloc[:0], "has a header but no rows"),
    "row numbers": (lambda frame: frame.assign(id=range(len(frame))), "no vehicle has two samples"),
    "km/h": (
        lambda frame: frame.assign(v=3.6 * frame["v"]),
        "by their positions the vehicles drive",
    ),
    "backwards": (
        lambda frame: frame.assign(x=-frame["x"]),
        "must grow in the direction of travel",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_with_a_table_is_said(tmp_path, case) -> None:
    spoil, words = WRONG[case]
    path = written(tmp_path, spoil(long_table()))
    with pytest.raises(DataError, match=words) as caught:
        TableSource(path=path, columns={**BY_GAP, "position": "x"}).load()
    assert path in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (gzip.compress(long_table().to_csv(index=False).encode())[:2000], "damaged or cut off"),
        (b"", "empty, or names no columns"),
        (b"id,t,v,ahead,gap\n1,0,1,0\n", "data row 1 has 4 columns; expected 5"),
        (b"id,t,v,ahead,gap\n1,0,\xff,0,1\n", "is not text"),
        (b"id,t\r,v\n1,0,5\n", "empty, or names no columns"),
        (b"1,0,5,0,1\n1,0.1,5,0,1\n", "lacks the column id"),
    ],
)
def test_files_that_are_no_table(tmp_path, content, words) -> None:
    path = tmp_path / "my.csv"
    path.write_bytes(content)
    with pytest.raises(DataError, match=rf"my\.csv: .*({words})"):
        TableSource(path=str(path), columns=BY_GAP).load()


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["data.units={speed: kmh}"], r"unit in data\.units\.speed: 'kmh'.*Did you mean 'km/h'"),
        (["+data.units.lane=m"], r"key of data\.units 'lane'"),
        (["+data.columns.sped=v"], r"'sped'.*Did you mean 'speed'"),
        (["data.columns.time=null"], r"data\.columns\.time must name a column"),
        (["data.columns.leader=null"], "must name leader, or lane and position"),
        (["data.columns.gap=null"], r"must name gap, or position and length .*vehicle_length"),
        (["data.columns.gap=t", "data.columns.time=t"], "names the column 't' twice"),
        (["data.vehicle_length=-1"], r"data\.vehicle_length must be greater"),
        (
            ["data.smoothing={_target_: lcc_rl.data.smoothing.ExponentialAverage, width_s: 0.5}"],
            "smooths positions",
        ),
    ],
)
def test_impossible_tables(tmp_path, overrides, words) -> None:
    path = written(tmp_path, long_table())
    said = ["data=table", f"data.path={path}", "data.columns={leader: ahead, gap: gap}"]
    with pytest.raises(ConfigError, match=words):
        build(load("train", [*said, *overrides]).data, "data").load()


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
    pd.testing.assert_frame_equal(read_episodes(full), whole, check_exact=False, check_dtype=False)
    for frame, words in (
        (whole.rename(columns={"gap_m": "gap"}), "lacks the column gap_m"),
        (change(3, gap_m="x")(whole), "row 4, column 'gap_m' holds 'x'"),
    ):
        with pytest.raises(DataError, match=words):
            read_episodes(written(tmp_path, frame, "bad.csv"))


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


def test_blank_cells_divide_and_are_counted(tmp_path) -> None:
    path = tmp_path / "platoon.csv"
    path.write_text(openacc_text(blank={"Speed2": [200, 201], "IVS2": [160]}))
    loaded = OpenAccSource(path=str(path)).load()
    sizes = loaded.episodes.groupby(["follower_id", "episode"]).size()
    assert sizes.tolist() == [200, 198, 160, 198]
    assert "dropped 2 rows: blank speed" in loaded.report
    assert f"{path}: 1 samples with a blank gap follow nobody" in loaded.report


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("IVS2", "gap", "lacks the column IVS2"),
        ("Speed2", "v", "lacks the column Speed2"),
        ("430.5,", "430.4,", "differ, but are of one vehicle"),
        ("430.5,", "-,", "data row 6, column 'Time' holds nothing"),
        ("430.5,", "430.5,-", "data row 6, column 'Speed1' holds '-12"),
    ],
)
def test_what_is_wrong_with_an_openacc_file_is_said(tmp_path, old, new, words) -> None:
    path = tmp_path / "platoon.csv"
    path.write_text(openacc_text().replace(old, new, 1))
    with pytest.raises(DataError, match=rf"platoon\.csv: .*{words}"):
        OpenAccSource(path=str(path)).load()


def test_its_first_car_leads(openacc, tmp_path) -> None:
    said = ["variant=alcc", f"leader.path={openacc}"]
    inputs = load_inputs(load("train", [*said, "leader=record", "scenario.horizon=100"]))
    assert inputs.training.names == ("platoon",)
    np.testing.assert_allclose(inputs.training.record(0), speed(np.arange(267) / 10, 1), atol=1e-3)
    for number in range(12):
        text = openacc_text(blank={"Speed1": [200]} if number == 3 else None)
        (tmp_path / f"file{number}.csv").write_text(text)
    said = ["variant=alcc", "leader=drives", f"leader.path='{tmp_path}/file*.csv'"]
    inputs = load_inputs(load("train", [*said, "scenario.horizon=100"]))
    drives = {name.split("+")[0] for name in (*inputs.training.names, *inputs.evaluation.names)}
    assert drives == {f"file{number}" for number in range(12)}
    assert not set(inputs.training.recordings) & set(inputs.evaluation.recordings)
    assert any("left out 1 rows with a blank Speed1" in line for line in inputs.report)


def test_a_record_too_short_for_the_cut_at_900_s_names_the_way_out(openacc) -> None:
    with pytest.raises(DataError, match=r"covers 430–469\.9 s, .* leader=record takes a record of"):
        load_inputs(load("train", ["variant=cacc", "leader=openacc", f"leader.path={openacc}"]))
    time, own = read_speed_record(openacc)
    np.testing.assert_allclose(own, speed(time - 430, 1))


def test_a_real_openacc_file(shared_data) -> None:
    path = shared_data / "openacc_astazero_acc_short_9cars.csv.gz"
    if not path.is_file():
        pytest.skip(f"no native OpenACC file in {shared_data}")
    loaded = OpenAccSource(path=str(path)).load()
    assert "dropped 2 rows: blank speed" in loaded.report
    validate_episodes(loaded.episodes, "episodes")
    assert loaded.episodes["follower_id"].unique().tolist() == [2, 3, 4, 5, 6, 7, 8, 9]
    assert 4.0 < loaded.episodes["gap_m"].min() < loaded.episodes["gap_m"].max() < 30.0
