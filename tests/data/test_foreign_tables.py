"""Tables that other programs write: names with units, times of all kinds, empty columns."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from page_files import highd
from table_text import BY_GAP, LENGTH, long_table, written

from lcc_rl.data.columns import UNITS, named_unit
from lcc_rl.data.leaders import DriveLeaders
from lcc_rl.data.sources import EpisodesSource
from lcc_rl.data.table_source import TableSource
from lcc_rl.errors import Concern, DataError

NAMED = {
    "Target Speed, mph": "mph",
    "v [km/h]": "km/h",
    "speed_kmh": "km/h",
    "SpeedKph": "km/h",
    "speed_km_h_filtered": "km/h",
    "wind knots": "kn",
    "speed miles per hour": "mph",
    "Speed [kilometres per hour]": "km/h",
    "v_fps": "ft/s",
    "gap (ft)": "ft",
    "SpaceFeet": "ft",
    "position_km": "km",
    "t_ms": "ms",
    "Time [us]": "us",
}
UNNAMED = {
    "speed": ("kmhspeed", "knee", "maximum_s", "lamps"),
    "grade": ("slope", "trade"),
    "length": ("gap_m", "left", "min_gap", "shift"),
    "time": ("time_s", "timestamps", "min_time", "status"),
}


def test_the_name_of_a_column_may_say_its_unit(tmp_path) -> None:
    for quantity, names in UNNAMED.items():
        assert [named_unit(name, quantity) for name in names] == [None] * len(names)
    for name in ("speed_mps", "v_mps", "v_ms", "speed_m_s", "v [m/s]"):
        assert named_unit(name, "speed") == "m/s"
    keys = {"speed": "speed", "length": "gap", "time": "time"}
    for name, unit in NAMED.items():
        quantity = next(x for x in ("speed", "length", "time") if unit in UNITS[x])
        assert named_unit(name, quantity) == unit
        key = keys[quantity]
        columns = {**BY_GAP, key: name}
        frame = long_table(rows=400).rename(columns={BY_GAP[key]: name})
        frame[name] /= UNITS[quantity][unit]
        path = written(tmp_path, frame, "named.csv", quotechar='"')
        words = re.escape(f"the name of column {name!r} contains {unit}, but it is read in")
        with pytest.raises(DataError, match=rf"{words} .*; set data\.units\.{key}={unit}, or"):
            TableSource(path=path, columns=columns).load()
        loaded = TableSource(path=path, columns=columns, units={key: unit}).load()
        assert len(loaded.episodes) == 800, name


def test_a_known_column_that_nothing_reads_is_loud(tmp_path) -> None:
    pairs = {"time": "t", "follower_speed": "v", "leader_speed": "w", "gap": "d"}
    log = pd.DataFrame({"t": 0.1 * np.arange(200), "v": 9.0, "w": 9.0, "d": 20.0, "valid": 1})
    drives = pd.DataFrame({"time_s": np.arange(400.0), "speed_mps": 9.0, "grade": 0.01})
    drives["speed_mps"] += 3.0 * np.sin(0.5 * drives["time_s"])
    path, other = written(tmp_path, log, "log.csv"), written(tmp_path, drives, "drives.csv")
    words = "column 'valid' is not read unless data.columns.valid names it"
    for read in ({"valid": "valid"}, {"valid": None}, {}):
        report = EpisodesSource(path=path, columns=pairs | read).load().report
        found = [x for x in report if isinstance(x, Concern)]
        assert found == ([] if read else [f"{path}: {words}"]), read
    report = DriveLeaders(path=other, evaluation_share=1.0).load(0.1, 300).report
    words = "column 'grade' is not read unless leader.columns.grade names it for lcc-rl energy"
    assert [x for x in report if isinstance(x, Concern)] == [f"{other}: {words}"]


def test_an_empty_last_column_is_left_out_with_and_without_a_name(tmp_path) -> None:
    for sign, end in ((",", ""), (",", ","), (";", ";"), ("\t", "")):
        path = Path(written(tmp_path, long_table(), sep=sign))
        head, *rows = path.read_text().splitlines()
        path.write_text("\n".join([head + end, *(row + sign for row in rows), ""]))
        assert len(TableSource(path=str(path), columns=BY_GAP).load().episodes) == 800, (sign, end)


def test_dates_and_times_are_read_as_they_are(tmp_path) -> None:
    frame = long_table()
    stamp = pd.to_datetime("2026-01-02T10:00:00") + pd.to_timedelta(frame["t"].round(1), unit="s")
    expected = TableSource(path=written(tmp_path, frame), columns=BY_GAP).load().episodes
    text = stamp.map("2026-01-02 10:{:%M:%S.%f}".format)
    paths = [written(tmp_path, frame.assign(t=text + x), f"{x}.csv") for x in ("", "Z", "+02:00")]
    for zone in ("UTC", None):  # as types of parquet
        paths.append(str(tmp_path / f"{zone}.parquet"))
        frame.assign(t=stamp.dt.tz_localize(zone)).to_parquet(paths[-1])
    for path in paths:
        found = TableSource(path=path, columns=BY_GAP).load().episodes
        np.testing.assert_allclose(found["gap_m"], expected["gap_m"], atol=1e-4, err_msg=path)


def test_vehicles_may_be_numbered_from_0_with_blank_leaders(tmp_path) -> None:
    frame = long_table()
    frame["id"] -= 1
    frame["ahead"] = (frame["ahead"] - 1).where(frame["id"] > 0)  # 0.0, and blank for the first
    whole = frame.astype({"ahead": "Int64"})
    whole.to_parquet(tmp_path / "my.parquet")
    paths = written(tmp_path, frame, "a.csv"), written(tmp_path, whole, "b.csv")
    for path in (*paths, str(tmp_path / "my.parquet")):
        loaded = TableSource(path=path, columns=BY_GAP).load()
        assert len(loaded.episodes) == 800, path
        assert {*loaded.vehicles.values()} == {"0", "1", "2"}, path


def test_positions_that_begin_anew_are_no_other_unit(tmp_path) -> None:
    words = r"positions jump \d+ times, the first at .*data row \d+, vehicle 1: do they begin"
    for step in (0.1, 1.0):
        frame = long_table(rows=400, step=step)
        frame["x"] %= 150.0  # a link, or a ring
        source = TableSource(path=written(tmp_path, frame), columns={**BY_GAP, "position": "x"})
        with pytest.raises(DataError, match=words):
            source.load()


def test_irregular_samples_are_interpolated_and_counted(tmp_path) -> None:
    frame, rng = long_table(rows=600), np.random.default_rng(0)
    drawn = frame[rng.random(len(frame)) < 0.4]
    report = TableSource(path=written(tmp_path, drawn), columns=BY_GAP).load().report
    assert any(re.match(r"samples 0\.2 s apart, \d+ of them irregular, were", x) for x in report)
    assert any("cut their trajectories 0 times" in x for x in report)
    drives = [drawn[drawn["id"] == car].assign(drive=f"d{car}") for car in (1, 2, 3)]
    path = written(tmp_path, pd.concat(drives), "drives.csv")
    names = {"time": "t", "speed": "v"}
    leaders = DriveLeaders(path=path, columns=names, evaluation_share=1.0).load(0.1, 100)
    assert len(leaders.report) == 6  # read, interpolated, 3 drives, held out: none is divided


def test_a_drive_is_described_and_of_many_the_fastest(tmp_path) -> None:
    for number in range(7):
        frame = long_table(cars=1)[["t", "v"]].assign(v=lambda x, n=number: x["v"] + n)
        written(tmp_path, frame, f"trip{number}.csv")
    settings = {"columns": {"time": "t", "speed": "v"}, "evaluation_share": 1.0}
    report = DriveLeaders(path=str(tmp_path), **settings).load(0.1, 100).report
    lines = [line for line in report if "m/s, at most" in line]
    assert [line[:5] for line in lines] == ["trip6", "trip5", "trip4", "trip3", "trip2"]
    assert re.fullmatch(r"trip6: 40 s, speed 1\d\.\d m/s, at most 21 m/s", lines[0])
    assert "… and 2 slower records" in report


def test_highd_by_its_two_conversions(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    highd(tmp_path / "01_tracks.csv")
    page = (Path(__file__).parents[2] / "docs" / "data.md").read_text(encoding="utf-8")
    exec(re.search(r"```python\n(import numpy as np\n.*?)```", page, flags=re.DOTALL)[1], {})
    columns = {"vehicle": "id", "time": "frame", "speed": "speed", "position": "front"}
    columns |= {"lane": "laneId", "leader": "precedingId", "length": "width"}
    settings = {"path": "highd.csv", "units": {"time": "frames/25"}}
    found = TableSource(**settings, columns=columns).load().episodes
    assert found["follower_id"].unique().tolist() == [12, 13, 14, 22, 23, 24]
    widths = pd.read_csv("highd.csv").groupby("id")["width"].first()
    first = found.groupby("follower_id").first()
    # The fronts are 20 m and a length of 5 m apart; here cars are 4 to 6 m long.
    expected = 20.0 + LENGTH - widths[first["leader_id"]].to_numpy()
    np.testing.assert_allclose(first["gap_m"], expected, atol=1e-3)
    right = pd.read_csv("highd.csv").query("laneId == 4")
    right.assign(speed=right["speed"]).to_csv("right.csv", index=False)
    corner = TableSource(
        **settings | {"path": "right.csv"}, columns=columns | {"position": "x"}
    ).load()
    off = corner.episodes.groupby("follower_id").first()["gap_m"] - first["gap_m"].loc[22:]
    lengths = widths[first["leader_id"].loc[22:]].to_numpy()
    np.testing.assert_allclose(off, widths[off.index] - lengths, atol=1e-3)
    assert corner.report[-1].endswith("slope of gaps over speeds 1.00, lag 0.0 s of 3 pair(s)")


def test_a_table_that_sumo_writes_is_read_at_once(tmp_path) -> None:
    home = Path(pytest.importorskip("sumo").SUMO_HOME)
    nodes = "".join(
        f'<node id="{name}" x="{x}" y="0"/>' for name, x in (("a", 0), ("b", 900), ("c", 1800))
    )
    edges = "".join(
        f'<edge id="{first}{last}" from="{first}" to="{last}" numLanes="1" speed="{speed}"/>'
        for first, last, speed in (("a", "b", 25), ("b", "c", 12))
    )
    routes = (
        '<vType id="car" carFollowModel="IDM" length="4.5"/><route id="r" edges="ab bc"/>'
        '<flow id="f" type="car" route="r" begin="0" end="30" number="6" departSpeed="max"/>'
    )
    for name, text in (("nodes", nodes), ("edges", edges), ("routes", routes)):
        (tmp_path / f"{name}.xml").write_text(f"<{name}>{text}</{name}>")
    for words in (
        "netconvert -n nodes.xml -e edges.xml -o net.xml",
        "sumo -n net.xml -r routes.xml --end 80 --step-length 0.1 --fcd-output fcd.csv "
        "--fcd-output.max-leader-distance 150",
    ):
        program, *options = words.split()
        command = [home / "bin" / program, *options]
        environment = {**os.environ, "SUMO_HOME": str(home)}
        subprocess.run(command, cwd=tmp_path, env=environment, check=True, capture_output=True)
    columns = {"vehicle": "vehicle_id", "time": "timestep_time", "speed": "vehicle_speed"}
    columns |= {"leader": "vehicle_leaderID", "gap": "vehicle_leaderGap"}
    path = str(tmp_path / "fcd.csv")
    loaded = TableSource(path=path, columns=columns).load()
    assert loaded.episodes["episode"].nunique() >= 3
    assert "slope of gaps over speeds 1.0" in loaded.report[-1]
    with pytest.raises(DataError, match=r"positions jump .* do they begin anew by lane or link"):
        TableSource(path=path, columns=columns | {"position": "vehicle_pos"}).load()
