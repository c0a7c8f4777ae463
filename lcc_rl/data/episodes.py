"""Table of car-following episodes: schema, reading, writing and validation."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from lcc_rl.data.delimited import Delimited, stem
from lcc_rl.errors import DataError
from lcc_rl.io.files import read_parquet, write_parquet

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
COLUMNS = tuple(SCHEMA)
ALIASES = {"event": "episode", "period": "recording"}
NUMBERS = tuple(name for name, kind in SCHEMA.items() if kind != "str")
SPEEDS = ("follower_speed_mps", "leader_speed_mps")
POSITIONS = ("leader_position_m", "follower_position_m")
OPTIONAL = ("recording", "leader_length_m", *POSITIONS)  # in a file
TEXT = (".csv", ".gz", ".txt", ".tsv")
DERIVED = "no positions given: those of leaders are the integral of their speeds"
LARGEST = 1e12  # beyond any time or place, and within every type


def read_episodes(path: str | Path) -> pd.DataFrame:
    """Read an episode table from a parquet or CSV file and validate it.

    Args:
        path: file with the columns of ``SCHEMA``, of which those in ``OPTIONAL`` may be missing;
            ``event`` and ``period`` are taken for ``episode`` and ``recording``. Further columns
            are left out. CSV may be gzipped, see :class:`lcc_rl.data.delimited.Delimited`.

    Returns:
        Columns ``SCHEMA`` in SI: episode, recording, follower_id, leader_id, time_s, follower and
        leader position (front bumper), speed, leader length and gap (bumper to bumper).

    Raises:
        DataError: if the file cannot be read or its content is not a valid episode table.
    """
    return load_episodes(path)[0]


def load_episodes(path: str | Path) -> tuple[pd.DataFrame, list[str]]:
    """Read an episode table, see :func:`read_episodes`, and lines on what it lacks."""
    text = Path(path).suffix in TEXT
    frame, notes = _from_text(Path(path)) if text else (_from_parquet(path), [])
    names = {old: new for old, new in ALIASES.items() if new not in frame.columns}
    frame = frame.rename(columns=names)
    lacking = [name for name in OPTIONAL if name not in frame.columns]
    needed = [name for name in COLUMNS if name not in (*OPTIONAL, *frame.columns)]
    if needed:
        raise _absent(needed[0], str(path), [str(name) for name in frame.columns])
    placed = not set(POSITIONS) & set(lacking)
    filled = frame.assign(
        **{name: stem(path) if name == "recording" else 0.0 for name in lacking if len(frame)}
    )
    table = validate_episodes(filled, str(path))
    if "recording" in lacking:
        notes.append(f"no column recording: all of {path} is one")
    if "leader_length_m" in lacking:
        notes.append("no column leader_length_m: lengths are not known")
    if not placed:
        derive_positions(table)
        notes.append(DERIVED)
    return table, notes


def _from_parquet(path: str | Path) -> pd.DataFrame:
    try:
        frame = read_parquet(path)
        for name in map(str, frame.select_dtypes("str").columns):
            pa.array(frame[name]).validate(full=True)  # damaged text would fail only when used
    except Exception as error:  # a damaged parquet file raises errors of many kinds
        raise DataError(f"{path}: is not a readable episode table: {error}") from error
    return frame


def _from_text(path: Path) -> tuple[pd.DataFrame, list[str]]:
    """The columns of a text file as text, and lines on how it is laid out."""
    if not path.is_file():
        raise DataError(f"{path}: no such file; expected a table of episodes")
    text = Delimited(path)
    known = [name for name in text.header if name in (*COLUMNS, *ALIASES)]
    twice = [name for name in known if known.count(name) > 1]
    if twice:
        raise DataError(f"{path}: has column {twice[0]!r} twice; expected it once")
    if not known:
        raise _absent(COLUMNS[0], str(path), text.header)
    places = {text.header.index(name): name for name in known}
    frame = text.parse([*places]).to_pandas()
    frame = frame.rename(columns={str(place): name for place, name in places.items()})
    if text.decimal_comma:
        for name in set(NUMBERS) & set(known):
            frame[name] = frame[name].str.replace(",", ".")
    others = {name: None for name in text.header if name not in known}
    return frame.assign(**others), text.notes


def derive_positions(episodes: pd.DataFrame) -> None:
    """Write positions that agree with speeds and gaps: the leader's is 0 m at an episode's start.

    Args:
        episodes: the table in SI; changed in place.
    """
    speed = episodes["leader_speed_mps"].to_numpy(np.float64)
    time = episodes["time_s"].to_numpy(np.float64)
    starts = _starts(episodes["episode"].to_numpy())
    way = np.append(0.0, (speed[1:] + speed[:-1]) / 2 * np.diff(time))
    total = np.cumsum(way)
    position = total - np.repeat(total[starts], np.diff(np.append(starts, len(total))))
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
        DataError: naming the source, the row (from 0) and the column, if a column is missing or
            holds NaN, text or an impossible value, or if an episode is not contiguous, has a
            single row or several pairs, or its time does not advance by one constant step.
    """
    _check_columns(frame, source)
    if frame.empty:
        raise DataError(f"{source}: has no episodes; expected at least one row")
    frame = frame[list(COLUMNS)].reset_index(drop=True)
    for name in NUMBERS:
        frame[name] = _checked_numbers(frame[name], source)
    if frame["recording"].isna().any():
        raise _at(source, frame["recording"].isna(), "recording", "is blank; expected a name")
    for name in (*SPEEDS, "leader_length_m", "gap_m"):
        if (frame[name] < 0).any():
            raise _at(source, frame[name] < 0, name, "is negative; expected at least 0")
    _check_episodes(frame, source)
    return frame.astype({**SCHEMA, "recording": str})


def _check_columns(frame: pd.DataFrame, source: str) -> None:
    present = [str(name) for name in frame.columns]
    for name in COLUMNS:
        if present.count(name) > 1:
            raise DataError(f"{source}: has column {name!r} twice; expected it once")
        if name not in present:
            raise _absent(name, source, present)


def _absent(name: str, source: str, present: Sequence[str]) -> DataError:
    near = get_close_matches(name, present, n=1)
    hint = f"; the nearest is {near[0]!r}" if near else ""
    return DataError(
        f"{source}: has no column {name!r}{hint}. It has: {', '.join(present)}. Tables of other "
        "columns or units are read by data=table"
    )


def _at(source: str, wrong: pd.Series | NDArray[np.bool_], name: str, message: str) -> DataError:
    row = int(np.argmax(np.asarray(wrong)))
    return DataError(f"{source}: row {row}, column {name!r} {message}")


def _checked_numbers(column: pd.Series, source: str) -> pd.Series:
    """The column as finite numbers within its type."""
    name = str(column.name)
    if pd.api.types.is_bool_dtype(column) or pd.api.types.is_datetime64_any_dtype(column):
        raise DataError(f"{source}: column {name!r} holds {column.dtype}; expected numbers")
    try:
        numbers = pd.to_numeric(column, errors="coerce").astype("float64")
    except (TypeError, ValueError) as error:
        raise DataError(f"{source}: column {name!r} does not hold numbers: {error}") from error
    checks: list[tuple[Any, str]] = [(np.isfinite(numbers), "a finite number")]
    if SCHEMA[name].startswith("int"):
        limit = np.iinfo(SCHEMA[name]).max if SCHEMA[name] == "int32" else 2**53
        whole = (numbers == np.rint(numbers)) & (numbers.abs() <= limit)
        checks.append((whole, "a whole number"))
    else:
        checks.append((numbers.abs() <= LARGEST, f"at most {LARGEST:g}"))
    for valid, expected in checks:
        if not valid.all():
            shown = column.iloc[int(np.argmin(valid))]
            raise _at(source, ~valid, name, f"holds {shown!r}; expected {expected}")
    return numbers


def _check_episodes(frame: pd.DataFrame, source: str) -> None:
    """Episodes are unbroken, of one pair, longer than a row and regular in time."""
    episode = frame["episode"].to_numpy()
    starts = _starts(episode)
    seen = pd.Series(episode[starts]).duplicated().to_numpy()
    if seen.any():
        row = int(starts[int(np.argmax(seen))])
        raise DataError(
            f"{source}: row {row}, column 'episode': episode {episode[row]:.0f} appears again "
            "after another; expected its rows together, once"
        )
    lengths = np.diff(np.append(starts, len(frame)))
    if (lengths < 2).any():
        row = int(starts[int(np.argmax(lengths < 2))])
        raise DataError(f"{source}: row {row}: an episode of one row; expected at least two")
    for name in ("recording", "follower_id", "leader_id"):
        first = frame[name].to_numpy()[np.repeat(starts, lengths)]
        wrong = np.asarray(frame[name].to_numpy() != first)
        if wrong.any():
            raise _at(source, wrong, name, "changes within an episode; expected one pair")
    _check_time(frame["time_s"].to_numpy(), starts, source)


def _starts(episode: NDArray) -> NDArray[np.intp]:
    """First row of every episode."""
    return np.flatnonzero(np.concatenate([[True], episode[1:] != episode[:-1]]))


def _check_time(time: NDArray[np.float64], starts: NDArray[np.intp], source: str) -> None:
    """One positive step of time throughout the table."""
    steps = np.diff(time)
    inner = np.ones(len(steps), dtype=bool)
    inner[starts[1:] - 1] = False
    step = float(np.median(steps[inner]))
    # Times that were kept in float32 are off by some tens of microseconds.
    wrong = np.append(False, inner & ((steps <= 0) | (np.abs(steps - step) > 0.01 * abs(step))))
    if wrong.any():
        shown = f"is {steps[int(np.argmax(wrong)) - 1]:+g} s after the row before"
        expected = f"expected a constant step ({step:g} s here)"
        raise _at(source, wrong, "time_s", f"{shown}; {expected}")
