"""The episode table: reading, writing, and every way in which it can be wrong."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lcc_rl.data.episodes import (
    COLUMNS,
    SCHEMA,
    read_episodes,
    validate_episodes,
    write_episodes,
)
from lcc_rl.errors import DataError

Frame = pd.DataFrame


def table() -> Frame:
    """Episodes 4 and 2, of five and three rows."""
    rows = 8
    first = np.arange(rows) < 5
    return Frame(
        {
            "episode": np.where(first, 4, 2),
            "recording": np.where(first, "a", "b"),
            "follower_id": np.where(first, 7, 17),
            "leader_id": np.where(first, 9, 19),
            "time_s": np.where(first, 0.1 * np.arange(rows), 50 + 0.1 * np.arange(rows)),
            "follower_position_m": 2.0 * np.arange(rows),
            "follower_speed_mps": np.full(rows, 20.0),
            "leader_position_m": 2.0 * np.arange(rows) + 15.0,
            "leader_speed_mps": np.full(rows, 20.0),
            "leader_length_m": np.full(rows, 5.0),
            "gap_m": np.full(rows, 10.0),
        }
    )


def test_a_written_table_reads_back(tmp_path: Path) -> None:
    write_episodes(table(), tmp_path / "pairs.parquet")
    back = read_episodes(tmp_path / "pairs.parquet")
    assert {str(name): str(kind) for name, kind in back.dtypes.items()} == SCHEMA
    pd.testing.assert_frame_equal(back, table(), check_dtype=False)


def test_other_names_order_and_further_columns(tmp_path: Path) -> None:
    shuffled = table()[[*COLUMNS[::-1]]].assign(comment="x")
    shuffled = shuffled.rename(columns={"episode": "event", "recording": "period"})
    shuffled.to_parquet(tmp_path / "pairs.parquet")
    pd.testing.assert_frame_equal(
        read_episodes(tmp_path / "pairs.parquet"), validate_episodes(table(), "x")
    )


def change(row: int, name: str, value: object) -> Callable[[Frame], Frame]:
    def apply(frame: Frame) -> Frame:
        frame = frame.astype({name: object})
        frame.loc[row, name] = value
        return frame

    return apply


WRONG: dict[str, tuple[Callable[[Frame], Frame], str]] = {
    "empty": (lambda frame: frame.iloc[:0], "has no episodes"),
    "no column": (lambda frame: frame.drop(columns="leader_id"), "lacks the column leader_id"),
    "renamed": (
        lambda frame: frame.rename(columns={"gap_m": "gap"}),
        "lacks the column gap_m",
    ),
    "column twice": (
        lambda frame: pd.concat([frame, frame[["gap_m"]]], axis=1),
        "has column 'gap_m' twice",
    ),
    "NaN": (change(6, "gap_m", np.nan), "row 7, column 'gap_m' holds nothing"),
    "infinite": (change(2, "leader_position_m", np.inf), "row 3, column 'leader_position_m'"),
    "text": (change(3, "follower_speed_mps", "fast"), "column 'follower_speed_mps'.*'fast'"),
    "dates": (
        lambda frame: frame.assign(time_s=pd.Timestamp("2005-04-13")),
        "column 'time_s' is of type timestamp",
    ),
    "half an episode": (change(1, "episode", 4.5), "row 2, column 'episode' holds 4.5"),
    "large episode": (change(1, "episode", 2.0**40), "row 2, column 'episode'"),
    "blank recording": (change(1, "recording", None), "row 2, column 'recording' is blank"),
    "negative speed": (
        change(7, "leader_speed_mps", -0.1),
        "row 8, .*leader_speed_mps' holds -",
    ),
    "negative length": (change(0, "leader_length_m", -5.0), "row 1, column 'leader_length_m'"),
    "backwards": (change(2, "time_s", 0.05), "row 3, column 'time_s' is -0.05 s after"),
    "gap in time": (change(7, "time_s", 51.7), "row 8, column 'time_s' is .* expected a constant"),
    "repeated row": (
        lambda frame: frame.iloc[[0, 1, 1, 2, 3, 4, 5, 6, 7]],
        r"row 3, column 'time_s' is \+0 s after",
    ),
    "episode twice": (
        lambda frame: pd.concat([frame, frame]),
        "row 9, column 'episode' begins again",
    ),
    "one row": (lambda frame: frame.iloc[:6], "row 6, column 'episode' is of one row"),
    "another leader": (change(3, "leader_id", 8), "row 4, column 'leader_id' changes within"),
    "another recording": (change(3, "recording", "b"), "row 4, column 'recording' changes within"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_table_gives_one_error_that_names_the_place(case: str) -> None:
    make, message = WRONG[case]
    with pytest.raises(DataError, match=message) as caught:
        validate_episodes(make(table()), "pairs.parquet")
    assert str(caught.value).startswith("pairs.parquet: ")


def test_nothing_wrong_is_written(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="gap_m"):
        write_episodes(table().drop(columns="gap_m"), tmp_path / "pairs.parquet")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [b"", b"PAR1 not really PAR1", None])
def test_unreadable_files(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "pairs.parquet"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=r"pairs\.parquet: (not a readable table|no such file)"):
        read_episodes(path)


def test_damaged_text_is_noticed_on_reading(tmp_path: Path) -> None:
    path = tmp_path / "pairs.parquet"
    table().assign(recording="recording-a").to_parquet(path, compression=None)
    content = path.read_bytes()
    assert b"recording-a" in content
    path.write_bytes(content.replace(b"recording-a", b"recording-\xff"))
    with pytest.raises(DataError, match=r"pairs\.parquet: (not a readable table|no such file)"):
        read_episodes(path)


def test_real_pairs(shared_data: Path) -> None:
    frame = read_episodes(shared_data / "i80_pairs.parquet")
    assert (len(frame), frame["episode"].nunique(), frame["recording"].nunique()) == (
        178525,
        264,
        3,
    )
