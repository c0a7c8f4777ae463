"""Table of car-following episodes: schema, reading, writing and validation."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from lcc_rl.data.tables import LARGEST_ID, Column, TableFile, checked, lacking, stem
from lcc_rl.data.trajectories import stretches
from lcc_rl.errors import DataError
from lcc_rl.io.files import write_parquet

SCHEMA: dict[str, str] = {
    "episode": "int32",
    "recording": "str",
    "follower_id": "int64",
    "leader_id": "int64",
    "time_s": "float64",
    "follower_position_m": "float32",
    "follower_speed_mps": "float32",
    "leader_position_m": "float32",
    "leader_speed_mps": "float32",
    "leader_length_m": "float32",
    "gap_m": "float32",
}
FIELDS = (
    Column("episode", least=-(2**31), most=2**31 - 1, whole=True),
    Column("recording", "text", required=False),
    Column("follower_id", least=-LARGEST_ID, most=LARGEST_ID, whole=True),
    Column("leader_id", least=-LARGEST_ID, most=LARGEST_ID, whole=True),
    Column("time_s", "time"),
    Column("follower_position_m", "length", required=False),
    Column("follower_speed_mps", "speed", least=0.0),
    Column("leader_position_m", "length", required=False),
    Column("leader_speed_mps", "speed", least=0.0),
    Column("leader_length_m", "length", least=0.0, required=False),
    Column("gap_m", "length", least=0.0),
)
COLUMNS = tuple(SCHEMA)
ALIASES = {"event": "episode", "period": "recording"}
POSITIONS = ("leader_position_m", "follower_position_m")
DERIVED = "no positions given: those of leaders are the integral of their speeds"


def read_episodes(path: str | Path) -> pd.DataFrame:
    """Read an episode table from a parquet or CSV file and validate it.

    Args:
        path: file with the columns of ``FIELDS``, of which those that are not required may be
            missing; ``event`` and ``period`` are taken for ``episode`` and ``recording``. Further
            columns are left out. CSV may be gzipped, see :class:`lcc_rl.data.tables.TableFile`.

    Returns:
        Columns ``SCHEMA`` in SI: episode, recording, follower_id, leader_id, time_s, follower and
        leader position (front bumper), speed, leader length and gap (bumper to bumper).

    Raises:
        DataError: if the file cannot be read or its content is not a valid episode table.
    """
    return load_episodes(path)[0]


def load_episodes(path: str | Path) -> tuple[pd.DataFrame, list[str]]:
    """Read an episode table, see :func:`read_episodes`, and lines on what it lacks."""
    file = TableFile(path)
    names: dict[str, str | None] = {name: name for name in COLUMNS if name in file.header}
    names |= {new: old for old, new in ALIASES.items() if old in file.header and new not in names}
    _require([column.key for column in FIELDS if column.required], names, str(path), file.header)
    read = file.read(FIELDS, names)
    rows = len(read["episode"])
    blank = {**dict.fromkeys(COLUMNS, np.zeros(rows)), "recording": np.full(rows, stem(path))}
    table = _typed({**blank, **read}, str(path))
    notes = list(file.notes)
    if "recording" not in names:
        notes.append(f"no column recording: all of {path} is one")
    if "leader_length_m" not in names:
        notes.append("no column leader_length_m: lengths are not known")
    if not set(POSITIONS) <= set(names):
        derive_positions(table)
        notes.append(DERIVED)
    return table, notes


def derive_positions(episodes: pd.DataFrame) -> None:
    """Write positions that agree with speeds and gaps: the leader's is 0 m at an episode's start.

    Args:
        episodes: the table in SI; changed in place.
    """
    speed = episodes["leader_speed_mps"].to_numpy(np.float64)
    time = episodes["time_s"].to_numpy(np.float64)
    starts, lengths = stretches(episodes["episode"].to_numpy())
    total = np.cumsum(np.append(0.0, (speed[1:] + speed[:-1]) / 2 * np.diff(time)))
    position = total - np.repeat(total[starts], lengths)
    behind = episodes["gap_m"].to_numpy() + episodes["leader_length_m"].to_numpy()
    episodes["leader_position_m"] = position.astype(np.float32)
    episodes["follower_position_m"] = (position - behind).astype(np.float32)


def write_episodes(frame: pd.DataFrame, path: str | Path) -> None:
    """Validate an episode table and write it atomically as parquet.

    Raises:
        DataError: if the table is not valid.
        ResultsError: if the file cannot be written.
    """
    write_parquet(validate_episodes(frame, str(path)), path)


def validate_episodes(frame: pd.DataFrame, source: str) -> pd.DataFrame:
    """Check an episode table and give it the types of ``SCHEMA``.

    Args:
        frame: the table; rows of one episode must be consecutive and in order of time.
        source: where it comes from, for messages.

    Returns:
        The columns of ``SCHEMA`` in their order and types, with a fresh index.

    Raises:
        DataError: naming the source, the row (from 1) and the column, if a column is missing or
            holds NaN, text or an impossible value, or if an episode is not contiguous, has a
            single row or several pairs, or its time does not advance by one constant step.
    """
    present = [str(name) for name in frame.columns]
    _require(COLUMNS, present, source, present)
    values = {}
    for column in FIELDS:
        if present.count(column.key) > 1:
            raise DataError(f"{source}: has column {column.key!r} twice; expected it once")
        try:
            cells = pa.array(frame[column.key], from_pandas=True)
        except pa.ArrowException as error:
            raise DataError(f"{source}: column {column.key!r}: {error}") from error

        def fault(row: int, words: str, name: str = column.key) -> DataError:
            return _at(source, row, name, words)

        values[column.key] = checked(cells, column, fault)
    return _typed(values, source)


def _require(
    names: Sequence[str], present: Collection[str], source: str, header: Sequence[str]
) -> None:
    missing = [name for name in names if name not in present]
    if missing:
        error = lacking(source, missing, header, "")
        raise DataError(f"{error}. Tables of other columns or units are read by data=table")


def _at(source: str, row: int, name: str, words: str) -> DataError:
    return DataError(f"{source}: data row {row + 1}, column {name!r} {words}")


def _typed(values: dict[str, NDArray], source: str) -> pd.DataFrame:
    """Episodes that are unbroken, of one pair, longer than a row and regular in time."""
    if not len(values["episode"]):
        raise DataError(f"{source}: has no episodes; expected at least one row")
    starts, lengths = stretches(values["episode"])
    again = pd.Series(values["episode"][starts]).duplicated().to_numpy()
    if again.any():
        row = int(starts[int(np.argmax(again))])
        raise _at(source, row, "episode", "begins again; expected the rows of an episode together")
    if (lengths < 2).any():
        row = int(starts[int(np.argmax(lengths < 2))])
        raise _at(source, row, "episode", "is of one row; expected at least two")
    for name in ("recording", "follower_id", "leader_id"):
        wrong = values[name] != values[name][np.repeat(starts, lengths)]
        if wrong.any():
            row = int(np.argmax(wrong))
            raise _at(source, row, name, "changes within an episode; expected one pair")
    steps = np.diff(values["time_s"])
    inner = np.ones(len(steps), dtype=bool)
    inner[starts[1:] - 1] = False
    step = float(np.median(steps[inner]))
    # Times that were kept in float32 are off by some tens of microseconds.
    wrong = np.append(False, inner & ((steps <= 0) | (np.abs(steps - step) > 0.01 * abs(step))))
    if wrong.any():
        row = int(np.argmax(wrong))
        words = f"is {steps[row - 1]:+g} s after the row before; expected a constant step"
        raise _at(source, row, "time_s", f"{words} ({step:g} s here)")
    frame = pd.DataFrame({name: values[name] for name in COLUMNS})
    return frame.astype({**SCHEMA, "recording": str})
