"""Readers and configurations against anything hypothesis can think of.

A longer search: ``FUZZ_EXAMPLES=20000 python -m pytest tests/properties/test_readers.py``.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from helpers import check_episodes
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from table_text import long_table, openacc_text, pairs

from lcc_rl.data.car_following import Criteria
from lcc_rl.data.ngsim import read_ngsim
from lcc_rl.data.openacc import OpenAccSource
from lcc_rl.data.sources import EpisodesSource
from lcc_rl.data.speed_records import DRIVE_COLUMNS as COLUMNS_OF_DRIVES
from lcc_rl.data.speed_records import read_drives
from lcc_rl.data.table_source import TableSource
from lcc_rl.errors import DataError, LccError
from lcc_rl.io.files import read_parquet, write_parquet

EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "60"))
FUZZ = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=EXAMPLES == 60,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
NATIVE = (
    "1 {frame} 3 {time} 10.0 {y} 6042.0 2133.0 14.0 6.0 2 {speed} 0.0 1 0 0 0.0 0.0",
    "2 {frame} 3 {time} 10.0 {y} 6042.0 2133.0 14.0 6.0 2 {speed} 0.0 1 1 0 60.0 2.0",
)


def native_file() -> list[str]:
    """Return the lines of a small native NGSIM file."""
    return [
        line.format(frame=f, time=1113433135300 + 100 * f, y=200 - 60 * k + 3 * f, speed=30.0)
        for k, line in enumerate(NATIVE)
        for f in range(30)
    ]


def refused(read: Callable[[], object]) -> str | None:
    """Return why a reader refuses its input, None where it accepts it; a bug stays a bug."""
    try:
        read()
    except DataError as error:
        return str(error)
    return None


words = st.one_of(
    st.text(max_size=8), st.floats().map(str), st.integers().map(str), st.just(""), st.just("NaN")
)
mutations = st.lists(
    st.tuples(st.integers(0, 59), st.integers(0, 17), words), min_size=1, max_size=6
)


@FUZZ
@given(mutations)
def test_a_mutated_trajectory_file_is_read_or_refused_by_name(tmp_path, changes) -> None:
    lines = [line.split(" ") for line in native_file()]
    for row, column, word in changes:
        lines[row][column] = word
    path = tmp_path / "a.txt"
    path.write_text("\n".join(" ".join(line) for line in lines), errors="surrogatepass")
    error = refused(lambda: read_ngsim([str(path)]))
    assert error is None or "a.txt" in error


@FUZZ
@given(st.binary(max_size=400), st.sampled_from(["a.txt", "a.csv", "a.csv.gz"]))
def test_any_bytes_are_read_or_refused(tmp_path, content, name) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=r"a\."):
        read_ngsim([str(tmp_path / name)])


BY_GAP = {"vehicle": "id", "time": "t", "speed": "v", "leader": "ahead", "gap": "gap"}
BY_LANE = {**BY_GAP, "leader": None, "gap": None, "lane": "lane", "position": "x"}
SHORT = Criteria(min_duration_s=0.1, passenger_cars_only=False)


def rows_of(path: Path, layout: str) -> pd.DataFrame:
    """Read a file as a layout; the rows, and that the report is one line per entry."""
    if layout == "record":
        profiles, report = read_drives(str(path), {**COLUMNS_OF_DRIVES, "drive": None}, 0.1)
        assert not any("\n" in line for line in report)
        return pd.DataFrame({"leader_speed_mps": profiles.speeds.numpy()})
    source = {
        "by gap": TableSource(path=str(path), columns=BY_GAP, criteria=SHORT),
        "by lane": TableSource(path=str(path), columns=BY_LANE, vehicle_length=5.0, criteria=SHORT),
        "openacc": OpenAccSource(path=str(path), criteria=SHORT),
        "episodes": EpisodesSource(path=str(path)),
    }[layout]
    loaded = source.load()
    check_episodes(loaded.episodes)
    return loaded.episodes


def text_of(layout: str) -> str:
    """Return a small file of a layout that is valid."""
    if layout == "openacc":
        return openacc_text(rows=20)
    if layout == "episodes":
        return pairs(1).to_csv(index=False)
    if layout == "record":
        record = pd.DataFrame({"time_s": np.arange(20) / 10, "speed_mps": 5.0})
        return record.to_csv(index=False)
    return long_table(rows=20).to_csv(index=False)


LAYOUTS = ("by gap", "by lane", "openacc", "episodes", "record")


@pytest.mark.parametrize("layout", LAYOUTS)
@FUZZ
@given(
    st.lists(st.tuples(st.integers(0, 99), st.integers(0, 17), words), min_size=1, max_size=6),
    st.sampled_from([",", ";", "\t", " "]),
)
def test_a_mutated_table_is_read_or_refused_by_name(tmp_path, layout, changes, separator) -> None:
    lines = [line.split(",") for line in text_of(layout).splitlines()]
    for row, column, word in changes:
        line = lines[row % len(lines)]
        line[column % len(line)] = word
    text = "\n".join(separator.join(line) for line in lines)
    (tmp_path / "a.csv").write_text(text, errors="surrogatepass")
    found = []
    error = refused(lambda: found.append(rows_of(tmp_path / "a.csv", layout)))
    if error is not None:
        assert "a.csv" in error
        return
    assert np.isfinite(found[0].select_dtypes("number").to_numpy()).all()
    assert (found[0]["leader_speed_mps"] >= 0).all()


@pytest.mark.parametrize("place", [0.2, 0.5, 0.8])
def test_one_wrong_byte_in_a_table_is_noticed(tmp_path, place) -> None:
    path = tmp_path / "a.parquet"
    write_parquet(pd.DataFrame({"x": [float(i) ** 1.5 for i in range(5000)]}), path)
    content = bytearray(path.read_bytes())
    content[int(place * len(content))] ^= 0x10
    path.write_bytes(content)
    with pytest.raises(LccError, match=r"a\.parquet"):
        read_parquet(path)
