"""The NGSIM reader: every layout, recordings, duplicates, headways, and malformed files."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from ngsim_text import (
    OFFICIAL,
    PORTAL,
    START_MS,
    cells,
    csv_text,
    native_text,
    pair,
    portal_text,
)

from lcc_rl.data import ngsim
from lcc_rl.data.ngsim import read_ngsim
from lcc_rl.data.ngsim_writer import write_ngsim
from lcc_rl.data.trajectories import Trajectories
from lcc_rl.errors import DataError

FOOT = 0.3048
TYPES = (
    "recording category, vehicle int64, frame int32, segment int32, time_s float64, "
    "position_m float32, lane int16, length_m float32, vehicle_class int8, speed_mps float32, "
    "acceleration_mps2 float32, preceding int64, space_headway_m float32"
)


def read(folder: Path, text: str | bytes, name: str = "file.csv", **options: str) -> Trajectories:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    read_back = read_ngsim(path, **options)
    report = read_back.report
    assert report.rows_read == report.rows_kept + sum(report.dropped.values())
    assert report.rows_kept == len(read_back.samples)
    return read_back


LAYOUTS = {
    "csv": csv_text(pair()),
    "csv_crlf": csv_text(pair()).replace("\n", "\r\n"),
    "csv_quoted": "\n".join(
        ",".join(f'"{cell}"' for cell in line.split(",")) for line in csv_text(pair()).splitlines()
    ),
    "native": native_text(pair()),
    "native_tabs": "".join("\t".join(row) + "\n" for row in pair()),
    "native_commas": "".join(",".join(row) + "\n" for row in pair()),
    "native_blank_lines": "\n \n" + native_text(pair()).replace("\n", "\n\n"),
    "portal": portal_text(pair()),
    "portal_field_names": portal_text(pair()).lower(),
    "old_names": csv_text(
        pair(), OFFICIAL.replace("Space_Headway", "Space_Hdwy").replace("Vehicle_ID", "vehicle id")
    ),
    "no_final_newline": csv_text(pair()).rstrip("\n"),
}


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_gives_the_same_samples(tmp_path: Path, layout: str, compressed: bool) -> None:
    text = LAYOUTS[layout].encode()
    samples = read(tmp_path, gzip.compress(text) if compressed else text).samples
    assert ", ".join(f"{name} {kind}" for name, kind in samples.dtypes.items()) == TYPES
    assert samples["vehicle"].tolist() == [7] * 20 + [9] * 20
    assert samples["frame"].tolist() == [*range(20), *range(20)]
    assert samples["segment"].tolist() == [0] * 20 + [1] * 20
    follower = samples.iloc[3]
    assert follower["time_s"] == 0.3
    expected = {
        "position_m": 30 * FOOT,
        "length_m": 15 * FOOT,
        "speed_mps": 100 * FOOT,
        "acceleration_mps2": -1.5 * FOOT,
        "space_headway_m": 60 * FOOT,
    }
    assert follower[list(expected)].to_dict() == pytest.approx(expected, rel=1e-6)
    assert (follower["lane"], follower["vehicle_class"], follower["preceding"]) == (2, 2, 9)
    assert np.isnan(samples["space_headway_m"].iloc[20:]).all()
    time = "2005-04-13T22:58:55Z"
    assert samples["recording"].unique().tolist() == [
        f"i-80@{time}" if "portal" in layout else time
    ]


def test_thousands_separators_are_numbers(tmp_path: Path) -> None:
    rows = [cells(1234, 5678, Preceding=1_000_000), cells(1234, 5679)]
    text = portal_text(rows)
    assert '"1,234","5,678"' in text
    samples = read(tmp_path, text).samples
    assert samples["vehicle"].tolist() == [1234, 1234]
    assert samples["frame"].tolist() == [5678, 5679]
    assert samples["preceding"].tolist() == [1_000_000, 0]


def test_files_larger_than_a_block_lose_no_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ngsim, "BLOCK_BYTES", 10_000)
    rows = [cells(vehicle, k) for vehicle in range(1, 13) for k in range(70)]
    for content in (csv_text(rows), native_text(rows)):
        assert len(content) > 5 * ngsim.BLOCK_BYTES
        read_back = read(tmp_path, content)
        assert read_back.report.rows_kept == 840
        assert read_back.report.segments == read_back.report.vehicles == 12
        assert read_back.samples["position_m"].iloc[-1] == pytest.approx(690 * FOOT)


def test_error_in_a_later_block_names_the_line_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ngsim, "BLOCK_BYTES", 10_000)
    rows = [cells(vehicle, k) for vehicle in range(1, 13) for k in range(70)]
    rows[800] = cells(1, 0, v_Vel="fast")
    with pytest.raises(DataError, match=r"file\.csv: line 802, column 'v_Vel' holds 'fast'"):
        read(tmp_path, csv_text(rows))


def test_blank_cells_where_nothing_needs_them(tmp_path: Path) -> None:
    needed = ["Vehicle_ID", "Frame_ID", "Local_Y", "v_Length", "v_Vel", "v_Acc", "Lane_ID"]
    free = dict.fromkeys(set(OFFICIAL.split(",")) - set(needed), "")
    read_back = read(tmp_path, csv_text([cells(7, k, **free) for k in (1, 2)]))
    assert read_back.samples["preceding"].tolist() == [0, 0]
    assert read_back.samples["vehicle_class"].tolist() == [0, 0]
    assert read_back.samples["recording"].unique().tolist() == ["file#1"]
    assert "v_Class is all zero or blank: nothing to filter vehicle classes on" in str(
        read_back.report
    )


def test_headways_are_derived_where_blank_or_zero(tmp_path: Path) -> None:
    rows = pair(range(4))
    for row, headway in zip(rows, ["60", "0", "", "61"], strict=False):
        row[16] = headway
    read_back = read(tmp_path, csv_text([*rows, cells(5, 1, Preceding=99)]))
    report = read_back.report
    headway = read_back.samples.set_index(["vehicle", "frame"])["space_headway_m"] / FOOT
    assert headway.loc[7].to_numpy() == pytest.approx([60, 60, 60, 61])
    assert np.isnan(headway.loc[5, 1])
    assert (report.headways_given, report.headways_derived, report.headways_unknown) == (2, 2, 1)


def test_headways_are_derived_within_a_recording_only(tmp_path: Path) -> None:
    later = START_MS + 900_000
    first, second = pair(range(3), Space_Headway=0), pair(range(3), Space_Headway=0)
    for row in second:
        row[3] = str(later + 100 * int(row[1]))
        row[5] = str(float(row[5]) + (100 if row[0] == "9" else 0))
    read_back = read(tmp_path, csv_text(first + second))
    samples = read_back.samples
    follower = samples[samples["vehicle"] == 7]
    assert (follower["space_headway_m"] / FOOT).to_numpy() == pytest.approx([60] * 3 + [160] * 3)
    assert list(read_back.report.recordings.values()) == [6, 6]
    assert samples["segment"].nunique() == 4


def test_a_missing_frame_splits_a_trajectory(tmp_path: Path) -> None:
    read_back = read(tmp_path, csv_text([cells(7, k) for k in (9, 1, 2, 3, 7, 8)]))
    assert read_back.samples["frame"].tolist() == [1, 2, 3, 7, 8, 9]
    assert read_back.samples["segment"].tolist() == [0, 0, 0, 1, 1, 1]
    assert (read_back.report.vehicles, read_back.report.segments) == (1, 2)


def test_neighbouring_keys_of_two_vehicles_are_two_segments(tmp_path: Path) -> None:
    # Vehicle 1 ends in the last frame, vehicle 2 begins in frame 0: their keys are consecutive.
    read_back = read(tmp_path, csv_text([cells(1, 1), cells(1, 2), cells(2, 0), cells(2, 1)]))
    assert read_back.samples["segment"].tolist() == [0, 0, 1, 1]


def test_duplicates_are_dropped_and_counted_by_kind(tmp_path: Path) -> None:
    rows = [cells(7, 1), cells(7, 2), cells(7, 1), cells(7, 2, Local_Y=500), cells(7, 2)]
    read_back = read(tmp_path, csv_text(rows))
    assert read_back.report.dropped == {
        "exact duplicate (vehicle, frame)": 2,
        "conflicting duplicate (vehicle, frame)": 1,
    }
    assert (read_back.samples["position_m"] / FOOT).to_numpy() == pytest.approx([10, 20])
    assert "dropped 1 rows: conflicting duplicate" in str(read_back.report)


def test_ids_far_apart(tmp_path: Path) -> None:
    big = 2**53
    rows = [cells(big, 2**31 - 1, Local_Y=2), cells(3, 2**31 - 1, Local_Y=1, Preceding=big)]
    samples = read(tmp_path, csv_text(rows)).samples
    assert samples["vehicle"].tolist() == [3, big]
    assert np.isfinite(samples["space_headway_m"].iloc[0])


@pytest.mark.parametrize("preceding", ["-1", "7", ""])
def test_no_vehicle_ahead(tmp_path: Path, preceding: str) -> None:
    assert read(tmp_path, csv_text([cells(7, 1, Preceding=preceding)])).samples[
        "preceding"
    ].tolist() == [0]


def clocked(starts: list[int], frames: int = 40) -> str:
    """A vehicle per clock, each on for some frames."""
    return csv_text(
        [
            cells(vehicle, k, Global_Time=start + 100 * k)
            for vehicle, start in enumerate(starts, 1)
            for k in range(frames)
        ]
    )


def test_recordings_survive_jitter_and_truncation(tmp_path: Path) -> None:
    generator = np.random.default_rng(1)
    starts = [START_MS + 900_000 * (n % 2) + int(generator.integers(-900, 900)) for n in range(20)]
    assert len(read(tmp_path, clocked(starts)).report.recordings) == 2
    rows = [
        cells(1 + n, k, Global_Time=(START_MS + 900_000 * n + 100 * k) // 10_000 * 10_000)
        for n in range(2)
        for k in range(300)
    ]
    assert list(read(tmp_path, csv_text(rows)).report.recordings.values()) == [300, 300]


def test_a_recording_is_named_by_its_commonest_clock(tmp_path: Path) -> None:
    name = "2005-04-13T22:58:55Z"
    text = clocked([START_MS, START_MS, START_MS + 3000, START_MS - 3000])
    assert list(read(tmp_path, text).report.recordings) == [name]


def test_a_clock_in_seconds_tells_recordings_apart(tmp_path: Path) -> None:
    report = read(tmp_path, clocked([1163018600, 1163030300])).report
    assert list(report.recordings) == ["2006-11-08T20:43:20Z", "2006-11-08T23:58:20Z"]


@pytest.mark.parametrize("clock", ["0", "", "1.11343E+12", "12345"])
def test_without_a_clock_a_file_is_a_recording(tmp_path: Path, clock: str) -> None:
    text = csv_text([cells(7, k, Global_Time=clock) for k in range(4000)])
    (tmp_path / "other.txt.gz").write_bytes(gzip.compress(text.encode()))
    (tmp_path / "file.csv").write_text(text)
    both = read_ngsim([tmp_path / "file.csv", tmp_path / "other.txt.gz"])
    assert both.report.recordings == {"file#1": 4000, "other#1": 4000}
    assert "Global_Time does not tell the recording of 4,000 rows" in str(both.report)


def test_files_of_one_name_are_two_recordings(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "x.csv").write_text(csv_text([cells(7, 1, Global_Time=0)]))
    both = read_ngsim([tmp_path / "a" / "x.csv", tmp_path / "b" / "x.csv"])
    assert both.report.recordings == {"x#1": 1, "x#2": 1}


def test_rows_without_a_clock_join_the_only_recording(tmp_path: Path) -> None:
    rows = [cells(7, 1), cells(7, 2, Global_Time=""), cells(7, 3)]
    report = read(tmp_path, csv_text(rows)).report
    assert report.recordings == {"2005-04-13T22:58:55Z": 3}
    assert report.segments == 1


def test_parts_of_a_recording_in_two_files_join(tmp_path: Path) -> None:
    rows = pair()
    (tmp_path / "a.csv").write_text(csv_text(rows[:10]))
    (tmp_path / "b.csv").write_text(csv_text(rows[10:]))
    both = read_ngsim([tmp_path / "a.csv", tmp_path / "b.csv"])
    whole = read(tmp_path, csv_text(rows))
    pd.testing.assert_frame_equal(both.samples, whole.samples)


def mixed() -> str:
    """Two locations that use the same ids at the same time."""
    return portal_text(pair(range(5))) + "".join(
        line + "\n" for line in portal_text(pair(range(3)), "us-101").splitlines()[1:]
    )


def test_locations_are_recordings_of_their_own(tmp_path: Path) -> None:
    time = "2005-04-13T22:58:55Z"
    assert read(tmp_path, mixed()).report.recordings == {f"i-80@{time}": 10, f"us-101@{time}": 6}


def test_location_filter_counts_what_it_drops(tmp_path: Path) -> None:
    report = read(tmp_path, mixed(), location="US-101").report
    assert report.recordings == {"us-101@2005-04-13T22:58:55Z": 6}
    assert (report.rows_read, report.dropped) == (16, {"other location": 10})


def test_errors_after_the_location_filter_name_the_right_line(tmp_path: Path) -> None:
    lines = mixed().splitlines()
    lines[13] = lines[13].replace(",15.0,", ",long,")
    with pytest.raises(DataError, match="line 14, column 'v_Length' holds 'long'"):
        read(tmp_path, "\n".join(lines), location="us-101")


def changed(**change: object) -> str:
    """A valid file but for one row: line 4 of the file."""
    return csv_text([cells(7, 1), cells(7, 2), cells(7, 3, **change), cells(7, 4)])


def renamed(old: str, new: str) -> str:
    return csv_text(pair(), OFFICIAL.replace(old, new))


GOOD = csv_text(pair())
MALFORMED: dict[str, tuple[str | bytes, str]] = {
    "empty": ("", "is empty"),
    "only blank lines": ("\n \r\n\n", "is empty"),
    "header only": (OFFICIAL + "\n", "has no rows"),
    "truncated line": (GOOD + "7,21,20,1113", r"line 42 has 4 columns; expected 18"),
    "line too long": (GOOD + "1," * 18 + "1\n", r"line 42 has 19 columns; expected 18"),
    "missing column": (
        "\n".join(",".join(line.split(",")[:-5]) for line in GOOD.splitlines()),
        "lacks the column Lane_ID, Preceding",
    ),
    "renamed column": (renamed("v_Vel", "v_Velo"), "lacks the column v_Vel; .*'v_Velo'"),
    "column twice": (renamed("v_Width", "V LENGTH"), "has column 'v_Length' twice"),
    "not a number": (
        changed(v_Vel="abc"),
        r"line 4, column 'v_Vel' holds 'abc'; expected",
    ),
    "NaN": (changed(Local_Y="NaN"), r"line 4, column 'Local_Y' holds nothing; expected a number"),
    "infinite": (changed(v_Acc="inf"), r"line 4, column 'v_Acc' holds 'inf'"),
    "huge": (changed(Local_Y="1e30"), r"line 4, column 'Local_Y' holds '1e30'"),
    "huge headway": (
        changed(Space_Headway="9" * 40),
        r"line 4, column 'Space_Headway' holds '9999",
    ),
    "blank id": (
        changed(Vehicle_ID=""),
        r"line 4, column 'Vehicle_ID' holds nothing; expected a whole",
    ),
    "half an id": (changed(Vehicle_ID="7.5"), r"column 'Vehicle_ID' holds '7.5'; expected a whole"),
    "id 0": (changed(Vehicle_ID="0"), r"line 4, column 'Vehicle_ID' holds '0'"),
    "negative frame": (changed(Frame_ID="-1"), r"line 4, column 'Frame_ID' holds '-1'"),
    "large lane": (changed(Lane_ID="70000"), r"line 4, column 'Lane_ID' holds '70000'"),
    "class": (changed(v_Class="300"), r"line 4, column 'v_Class' holds '300'"),
    "no thousands": (changed(Vehicle_ID='"1,15"'), r"line 4, column 'Vehicle_ID' holds '1,15'"),
    "word headway": (changed(Space_Headway="far"), "line 4, column 'Space_Headway' holds 'far'"),
    "after blank lines": (
        changed(v_Vel="abc").replace("\n", "\n\n"),
        r"line 7, column 'v_Vel' holds 'abc'",
    ),
    "open quote": (changed(Local_X='"18.0'), r"line 4 .*quote|columns; expected 18"),
    "native 17 columns": (native_text([row[:17] for row in pair()]), "has 17 columns and no head"),
    "native later row": (native_text(pair()) + " 7 21 5\n", "line 41 has 3 columns; expected 18"),
    "native word": (native_text(pair(v_Vel="x")), "line 1, column 'v_Vel' holds 'x'"),
    "portal word": (
        portal_text(pair()).replace(",-1.5,", ",?,", 1),
        r"line 2, column 'v_Acc' holds '\?'",
    ),
    "truncated gzip": (gzip.compress(GOOD.encode())[:-20], "damaged or cut off"),
    "damaged gzip": (
        gzip.compress(GOOD.encode())[:40] + b"junk" * 8 + gzip.compress(GOOD.encode())[72:],
        "damaged or cut off",
    ),
    "zip": (b"PK\x03\x04" + bytes(200), "is not UTF-8 text"),
    "binary": (bytes(range(256)) * 40, "is not UTF-8 text"),
    "UTF-16": (GOOD.encode("utf-16"), "is not UTF-8 text"),
    "Latin-1 row": (
        GOOD.encode() + b"7,1,\xe9" + b",1" * 15 + b"\n",
        "is not text",
    ),
    "web page": ("<!DOCTYPE html>\n<html>Not found</html>\n", "lacks the column Vehicle_ID"),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_malformed_files_give_one_error_that_names_the_place(tmp_path: Path, case: str) -> None:
    text, message = MALFORMED[case]
    with pytest.raises(DataError, match=message) as caught:
        read(tmp_path, text)
    assert str(tmp_path / "file.csv") in str(caught.value)


def test_no_row_of_the_location_lists_those_found(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"'i-880'; .*i-80 \(10 rows\), us-101 \(6 rows\)"):
        read(tmp_path, mixed(), location="i-880")


def test_location_without_such_a_column(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no row has Location 'i-80'"):
        read(tmp_path, GOOD, location="i-80")


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.csv: cannot be read: No such file"):
        read_ngsim(tmp_path / "none.csv")
    with pytest.raises(DataError, match="cannot be read"):
        read_ngsim(tmp_path)
    with pytest.raises(DataError, match="no NGSIM file was named"):
        read_ngsim([])


def test_written_files_read_back_to_the_printed_precision(tmp_path: Path) -> None:
    original = read(tmp_path, mixed().replace("us-101", "peachtree"), location="i-80").samples
    generator = np.random.default_rng(5)
    original["position_m"] += generator.normal(0, 0.1, len(original)).astype(np.float32)
    later = original.assign(recording="stream@2005-01-01T13:00:00Z", vehicle=original["vehicle"])
    both = pd.concat([original.astype({"recording": str}), later], ignore_index=True)
    write_ngsim(both, tmp_path / "out.csv.gz")
    back = read_ngsim(tmp_path / "out.csv.gz").samples
    assert back["recording"].unique().tolist() == ["2005-01-01T13:00:00Z", "2005-04-13T22:58:55Z"]
    expected = both.sort_values(["recording", "vehicle", "frame"], ignore_index=True)
    expected = pd.concat([expected.iloc[10:], expected.iloc[:10]], ignore_index=True)
    for name in ("vehicle", "frame", "lane", "vehicle_class", "preceding", "time_s"):
        assert back[name].tolist() == expected[name].tolist()
    for name in ("position_m", "length_m", "speed_mps", "acceleration_mps2", "space_headway_m"):
        difference = (back[name].astype(float) - expected[name].astype(float)).abs()
        assert difference.max() <= 0.0005 * FOOT + 1e-5, name
        assert (back[name].isna() == expected[name].isna()).all()


def test_written_layout_is_the_official_one(tmp_path: Path) -> None:
    samples = read(tmp_path, csv_text(pair(range(2)))).samples.drop(columns="space_headway_m")
    samples.loc[0, "speed_mps"] = 0
    write_ngsim(samples, tmp_path / "out.csv")
    lines = (tmp_path / "out.csv").read_text().splitlines()
    assert lines[0] == OFFICIAL
    start = 1113433135000  # the name of the recording tells whole seconds
    assert lines[1] == f"7,0,2,{start},18,0,0,0,15,6.4,2,0,-1.5,2,9,0,60,9999.99"
    assert lines[2] == f"7,1,2,{start + 100},18,10,0,0,15,6.4,2,100,-1.5,2,9,0,60,0.6"
    assert lines[3] == f"9,0,2,{start},18,60,0,0,15,6.4,2,100,-1.5,2,0,7,0,0"


def test_what_cannot_be_written(tmp_path: Path) -> None:
    samples = read(tmp_path, csv_text(pair())).samples
    out = tmp_path / "out.csv"
    with pytest.raises(DataError, match=r"lack the column\(s\) lane, preceding"):
        write_ngsim(samples.drop(columns=["lane", "preceding"]), out)
    with pytest.raises(DataError, match="twice in one frame"):
        write_ngsim(pd.concat([samples, samples]), out)
    with pytest.raises(DataError, match=r"'speed_mps' .* not all finite"):
        write_ngsim(samples.assign(speed_mps=np.nan), out)
    close = np.where(samples["vehicle"] == 7, "a@2005-01-01T13:00:00Z", "b@2005-01-01T13:00:01Z")
    with pytest.raises(DataError, match="start at the same time"):
        write_ngsim(samples.assign(recording=close), out)
    with pytest.raises(DataError, match="no samples"):
        write_ngsim(samples.iloc[:0], out)
    assert not out.exists()


def test_real_pairs(shared_data: Path) -> None:
    report = read_ngsim(shared_data / "i80_pairs_ngsim_layout.csv.gz").report
    assert (report.rows_read, report.rows_kept) == (357_050, 357_050)
    assert list(report.recordings.values()) == [108_546, 118_502, 130_002]
    assert (report.vehicles, report.segments) == (528, 528)
    assert (report.headways_given, report.headways_derived) == (178_525, 0)


def test_real_native_file(shared_data: Path) -> None:
    read_back = read_ngsim(shared_data / "i80_coifman_li_2017_native.txt.gz")
    report = read_back.report
    assert (report.rows_kept, report.vehicles) == (215_244, 2_283)
    assert list(report.recordings) == ["i80_coifman_li_2017_native#1"]
    assert (report.headways_given, report.headways_derived) == (0, 156_382)
    assert {"v_Class", "v_Length", "Space_Headway", "Global_Time"} == set(report.empty_columns)
    assert "nothing to filter vehicle classes on" in str(report)


def test_real_rows_with_gaps_and_reused_ids(shared_data: Path) -> None:
    report = read_ngsim(shared_data / "ngsim_raw_rows_feet.csv.gz").report
    assert report.recordings == {
        "i-80@2005-04-13T22:58:54Z": 3102,
        "i-80@2005-04-13T23:59:26Z": 2508,
        "i-80@2005-04-14T00:12:44Z": 500,
        "us-101@2005-06-15T15:04:02Z": 1134,
        "us-101@2005-06-15T15:19:17Z": 1006,
    }
    assert (report.vehicles, report.segments) == (17, 30)


def test_real_portal_file(shared_data: Path) -> None:
    read_back = read_ngsim(shared_data / "ngsim_portal_peachtree_10000.csv.gz")
    assert list(read_back.report.recordings.values()) == [7619, 2381]
    row = read_back.samples.query("vehicle == 1308 and frame == 7261").iloc[0]
    assert row["preceding"] == 1289
    assert row["space_headway_m"] == pytest.approx(30.44 * FOOT)


def test_portal_header_is_the_real_one(shared_data: Path) -> None:
    with gzip.open(shared_data / "ngsim_portal_peachtree_10000.csv.gz", "rt") as file:
        assert file.readline().strip("\ufeff\n") == PORTAL
