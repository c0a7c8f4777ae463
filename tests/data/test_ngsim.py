"""The NGSIM reader: every layout, recordings, duplicates, headways, and malformed files."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from ngsim_text import OFFICIAL, START_MS, cells, csv_text, native_text, pair, portal_text

from lcc_rl.data import text
from lcc_rl.data.ngsim import read_ngsim
from lcc_rl.data.trajectories import Trajectories

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


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_gives_the_same_samples(tmp_path: Path, layout: str) -> None:
    text = LAYOUTS[layout].encode()
    samples = read(tmp_path, gzip.compress(text) if layout == "csv" else text).samples
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


def test_files_larger_than_a_block_lose_no_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(text, "BLOCK_BYTES", 10_000)
    rows = [cells(vehicle, k) for vehicle in range(1, 13) for k in range(70)]
    for content in (csv_text(rows), native_text(rows)):
        assert len(content) > 5 * text.BLOCK_BYTES
        read_back = read(tmp_path, content)
        assert read_back.report.rows_kept == 840
        assert read_back.report.segments == read_back.report.vehicles == 12
        assert read_back.samples["position_m"].iloc[-1] == pytest.approx(690 * FOOT)


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


def test_a_missing_frame_splits_a_trajectory(tmp_path: Path) -> None:
    read_back = read(tmp_path, csv_text([cells(7, k) for k in (9, 1, 2, 3, 7, 8)]))
    assert read_back.samples["frame"].tolist() == [1, 2, 3, 7, 8, 9]
    assert read_back.samples["segment"].tolist() == [0, 0, 0, 1, 1, 1]
    assert (read_back.report.vehicles, read_back.report.segments) == (1, 2)


def test_duplicates_are_dropped_and_counted_by_kind(tmp_path: Path) -> None:
    rows = [cells(7, 1), cells(7, 2), cells(7, 1), cells(7, 2, Local_Y=500), cells(7, 2)]
    read_back = read(tmp_path, csv_text(rows))
    assert read_back.report.dropped == {
        "exact duplicate (vehicle, frame)": 2,
        "conflicting duplicate (vehicle, frame)": 1,
    }
    assert (read_back.samples["position_m"] / FOOT).to_numpy() == pytest.approx([10, 20])
    assert "dropped 1 rows: conflicting duplicate" in str(read_back.report)


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


def test_without_a_clock_a_file_is_a_recording(tmp_path: Path) -> None:
    for clock in ("0", "", "1.11343E+12", "12345"):
        text = csv_text([cells(7, k, Global_Time=clock) for k in range(4000)])
        (tmp_path / "other.txt.gz").write_bytes(gzip.compress(text.encode()))
        (tmp_path / "file.csv").write_text(text)
        both = read_ngsim([tmp_path / "file.csv", tmp_path / "other.txt.gz"])
        assert both.report.recordings == {"file#1": 4000, "other#1": 4000}, clock
        assert "Global_Time does not identify the recording of 4,000 rows" in str(both.report)


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
