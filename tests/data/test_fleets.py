"""Data of a fleet: folders of days, part files, trips of any length and rate."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
import pytest
from helpers import check_refused
from table_text import BY_GAP, long_table, pairs, written

from lcc_rl.config.inputs import inputs_of
from lcc_rl.data import tables
from lcc_rl.data.leaders import DriveLeaders
from lcc_rl.data.sources import EpisodesSource, find_files
from lcc_rl.data.table_source import TableSource
from lcc_rl.data.text import labels
from lcc_rl.errors import Concern, DataError
from lcc_rl.io import memory

UNKNOWN = ["recording", "follower_id", "leader_id"]
PAIRS = pairs(2, 300).drop(columns=UNKNOWN)
TRIP = {"t": "time_s", "v": "speed_mps"}


def fleet(folder: Path, frame: pd.DataFrame, ending: str) -> str:
    """Write a table for each of three days into folders, as Spark does; return their folder."""
    for day in range(3):
        (folder / f"day={day}").mkdir(parents=True)
        written(folder / f"day={day}", frame, f"part-0.{ending}")
    (folder / "_SUCCESS").touch()
    return str(folder)


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_each_file_in_folders_of_days_is_a_recording(tmp_path, ending) -> None:
    files = [f"day={day}/part-0.{ending}" for day in range(3)]
    for kind, frame, columns, reader in (
        ("pairs", PAIRS, {}, EpisodesSource),
        ("cars", long_table(), BY_GAP, TableSource),
    ):
        folder = fleet(tmp_path / kind, frame, ending)
        for path in (folder, f"{folder}/*/*.{ending}", f"{folder}/**"):
            found = reader(path=path, columns=columns).load().episodes
            drivers = found[["recording", "follower_id"]].drop_duplicates()["recording"]
            assert drivers.tolist() == sorted(2 * files), (kind, path)
        # Names of folders are a column, and drivers without a number are others in each file.
        (Path(folder) / "day=1").rename(Path(folder) / "day=0" / "more")
        found = reader(path=folder, columns={**columns, "recording": "day"}).load().episodes
        assert {*found["recording"]} == {"0", "2"}
        again = {"pairs": 4, "cars": 2}[kind]  # these have numbers
        assert found[found["recording"] == "0"]["follower_id"].nunique() == again
    trips = fleet(tmp_path / "trips", long_table(cars=1).rename(columns=TRIP), ending)
    windows = DriveLeaders(path=trips, evaluation_share=1.0).load(0.1, 399).windows
    assert [*windows.recordings] == files


def test_names_of_files_are_the_same_in_every_folder() -> None:
    for root in ("", "/a/b=1/", "../"):
        names = [f"{root}{x}" for x in ("1/x.csv", "2/x.csv", "2/y.csv.gz", "y.txt", "z.csv")]
        assert labels(names) == ["1/x.csv", "2/x.csv", "2/y.csv.gz", "y.txt", "z"]
    assert labels([]) == []


def test_a_folder_stands_for_the_files_that_are_hashed(tmp_path) -> None:
    folder = fleet(tmp_path / "days", PAIRS, "csv")
    assert [*inputs_of({"data": {"path": folder}})["data"]] == find_files(folder)
    (tmp_path / "none" / "empty").mkdir(parents=True)
    twice = ["days/day=0/part-0.csv", "days/../days/day=0/part-0.csv"]
    cases = [
        (["none"], "none: no file matches this pattern"),
        (["days/*.txt"], "no file matches this pattern"),
        (twice, "part-0.csv: is named twice"),
    ]
    check_refused(lambda x: find_files([str(tmp_path / name) for name in x]), cases, DataError)


def test_records_that_continue_in_another_file_are_named(tmp_path) -> None:
    words = "records continue in another file and are read as two, the first from .*0.csv in .*1.c"
    for kind, frame, columns, reader in (
        ("pairs", pairs(1, 600), {}, EpisodesSource),
        ("alone", pairs(1, 600).drop(columns="episode"), {}, EpisodesSource),
        ("cars", long_table().sort_values("t"), BY_GAP, TableSource),
    ):
        (tmp_path / kind).mkdir()
        half = len(frame) // 2
        for number, part in enumerate((frame[:half], frame[half:])):
            written(tmp_path / kind, part, f"part-{number}.csv")
        report = reader(path=str(tmp_path / kind), columns=columns).load().report
        (line,) = [line for line in report if "continue in another" in line]
        assert isinstance(line, Concern)
        assert re.search(words, line), line
    named = {**BY_GAP, "recording": "lane"}  # one recording: vehicles are read as one
    report = TableSource(path=str(tmp_path / "cars"), columns=named).load().report
    assert not [line for line in report if "continue in another" in line]


def test_short_trips_and_those_of_another_rate_are_named(tmp_path) -> None:
    for number, rows in enumerate((300, 200, 60)):
        trip = long_table(cars=1, rows=rows, step=1.0).rename(columns=TRIP)
        written(tmp_path, trip, f"trip{number}.csv")
    report = DriveLeaders(path=str(tmp_path), evaluation_share=1.0).load(0.1, 1500).report
    assert report.count("samples 1 s apart were interpolated to 0.1 s") == 1
    short = "shorter than an episode of 150 s (scenario.horizon=1500): trip2 (59 s)"
    assert f"left out 1 of 3 record(s), {short}" in report


def test_many_files_have_one_line_progress_and_a_check_of_memory(
    tmp_path, monkeypatch, caplog, subtests
) -> None:
    for number in range(5):
        written(tmp_path, long_table(cars=1).rename(columns=TRIP), f"trip{number}.csv")
    read = DriveLeaders(path=str(tmp_path), evaluation_share=1.0).load
    with subtests.test("one line for many"):
        lines = [line for line in read(0.1, 399).report if "speed record(s)" in line]
        assert len(lines) == 1
        assert "(and 4 lines alike)" in lines[0]
    with subtests.test("progress"):
        monkeypatch.setattr(tables, "EVERY", -1.0)
        with caplog.at_level("INFO", "lcc_rl"):
            read(0.1, 399)
        assert "read 4 of 5 files" in caplog.messages
    with subtests.test("memory"):
        monkeypatch.setattr(memory, "available", lambda device: 1000)
        check_refused(read, [(0.1, 399, r"reading .*trip0\.csv.* needs about .* of memory")])


def test_a_long_name_is_stored_once(tmp_path) -> None:
    names = ["a", "x" * 900, "b "] * 10_000
    written(tmp_path, pd.DataFrame({"name": names, "v": 1.0}), "names.parquet")
    file = tables.TableFile(tmp_path / "names.parquet")
    found = file.read([tables.Column("name", "text")], {"name": "name"})["name"]
    assert found.nbytes < 1e5
    assert list(found[:3]) == ["a", "x" * 900, "b"]
