"""Table of car-following episodes: schema, reading, writing and validation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from lcc_rl.data.grid import Places, continuous, on_grid, places, stretches
from lcc_rl.data.tables import LARGEST_ID, Column, TableFile, checked, lacking, whole_numbers
from lcc_rl.data.text import stem
from lcc_rl.data.trajectories import ReadReport
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
# What a table of pairs may tell; a configuration names the columns by these keys.
FIELDS = (
    Column("episode", "text", required=False),
    Column("recording", "text", required=False),
    Column("follower_id", least=-LARGEST_ID, most=LARGEST_ID, whole=True, required=False),
    Column("leader_id", least=-LARGEST_ID, most=LARGEST_ID, whole=True, required=False),
    Column("time", "time", blank=True),
    Column("follower_position", "length", blank=True, required=False),
    Column("follower_speed", "speed", blank=True),
    Column("leader_position", "length", blank=True, required=False),
    Column("leader_speed", "speed", blank=True),
    Column("leader_length", "length", least=0.0, required=False),
    Column("gap", "length", blank=True),
)
MEASURED = [column.key for column in FIELDS if column.blank]  # a blank cell costs the row
COLUMNS = tuple(SCHEMA)
OWN = dict(zip((column.key for column in FIELDS), COLUMNS, strict=True))  # names by default
# What a finished table has: every column, episodes are numbers, no speed or gap is negative.
STRICT = (
    Column("episode", least=-(2**31), most=2**31 - 1, whole=True),
    *(
        replace(
            x,
            key=OWN[x.key],
            required=True,
            blank=False,
            least=0.0 if x.quantity == "speed" or x.key == "gap" else x.least,
        )
        for x in FIELDS[1:]
    ),
)
ALIASES = {"event": "episode", "period": "recording"}
DERIVED = "no positions given: those of leaders are the integral of their speeds"
MOTION = [name for name in COLUMNS if name.endswith(("_position_m", "_speed_mps", "gap_m"))]
ONE_ROW = "is of one row; expected at least two"


def load_episodes(
    paths: Sequence[str],
    columns: Mapping[str, str | None] | None = None,
    units: Mapping[str, str] | None = None,
) -> tuple[pd.DataFrame, list[str]]:
    """Read tables of pairs: a row per pair and moment, at any rate and with holes.

    Args:
        paths: .csv or .parquet files, see :class:`lcc_rl.data.tables.TableFile`. Columns that are
            not required in ``FIELDS`` may be missing; ``event`` and ``period`` are taken for
            ``episode`` and ``recording``.
        columns: what they call the columns, by the keys of ``FIELDS``; others as in ``SCHEMA``.
        units: their units by key; SI for those that are not named.

    Returns:
        The columns ``SCHEMA``, samples 0.1 s apart, ``file`` and ``row`` there, from 0, and
        ``label``, the file's name of the episode; and lines on what was read. Holes divide an
        episode. Speeds and gaps may be negative.

    Raises:
        DataError: naming file, row and column, if a cell is missing or no number, or rows
            contradict each other.
    """
    tables: list[pd.DataFrame] = []
    notes: list[str] = []
    place = partial(places, files=paths, columns=columns)
    for number, path in enumerate(paths):
        table, lines = _table(path, number, columns or {}, units or {}, place)
        if tables:
            table["episode"] += tables[-1]["episode"].max() + 1 - table["episode"].min()
        tables.append(table)
        notes += lines
    return pd.concat(tables, ignore_index=True), list(dict.fromkeys(notes))


def _table(
    path: str,
    number: int,
    columns: Mapping[str, str | None],
    units: Mapping[str, str],
    place: Places,
) -> tuple[pd.DataFrame, list[str]]:
    """Read one file, the ``number``-th, and bring it to the grid."""
    file = TableFile(path)
    names = _names(file, columns)
    table, numbers = _rows(file, number, names, units)
    notes = list(file.notes)
    for name, words in (
        ("recording", f"no column recording: all of {path} is one"),
        ("leader_length", "no column leader_length_m: lengths are not known"),
    ):
        if names.get(name) is None:
            notes.append(words)
    report = ReadReport([path])
    table = continuous(table, "episode", place, report)
    start = table.groupby("episode")["time_s"].transform("min").to_numpy()
    table, _ = on_grid(table, start, MOTION, place, report)
    table["time_s"] = table["time_s"].round(6)
    table["episode"] = _numbered(table["episode"].to_numpy(), numbers)
    table = table[[*COLUMNS, "file", "row", "label"]].astype({**SCHEMA, "recording": str})
    if not {"leader_position", "follower_position"} <= {key for key in names if names[key]}:
        derive_positions(table)
        notes.append(DERIVED)
    return table, [*notes, *(f"{path}: {line}" for line in (*report.left_out(), *report.notes))]


def _rows(
    file: TableFile, number: int, names: Mapping[str, str | None], units: Mapping[str, str]
) -> tuple[pd.DataFrame, NDArray[np.int64]]:
    """Rows of a file with episodes counted from 0, and the file's numbers of these."""
    read = file.read(FIELDS, names, units, "data.columns", MEASURED)
    if not len(read["time"]):
        raise DataError(f"{file.path}: has no episodes; expected at least one row")
    kept = read.pop("row")
    rows = len(kept)
    labels = read.get("episode", np.zeros(rows, dtype=str))
    codes, found = pd.factorize(labels)
    numbers = whole_numbers(np.asarray(found))
    if numbers is None or (np.abs(numbers) >= 2**31).any():
        numbers = np.arange(len(found))
    follower = 2 * codes + 2
    values = {
        **dict.fromkeys(COLUMNS, np.zeros(rows)),
        "recording": np.full(rows, stem(str(file.path))),
        **{OWN[key]: cells for key, cells in read.items()},
        "follower_id": read.get("follower_id", follower),
        "leader_id": read.get("leader_id", follower - 1),
    }
    table = pd.DataFrame({**values, "time_s": read["time"].round(6)})  # a moment is a microsecond
    table = table.assign(file=number, row=kept, label=labels, episode=codes)
    _check_pairs(table, file)
    return table, numbers


def _numbered(episode: NDArray, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """The file's numbers of episodes counted from 0; parts after holes have further ones."""
    more = np.arange(episode.max() + 1 - len(numbers)) + numbers.max() + 1
    return np.append(numbers, more)[episode]


def _names(file: TableFile, columns: Mapping[str, str | None]) -> dict[str, str | None]:
    """What a file calls the columns, by the keys of ``FIELDS``."""
    names: dict[str, str | None] = {key: own for key, own in OWN.items() if own in file.header}
    names |= {new: old for old, new in ALIASES.items() if old in file.header and new not in names}
    names |= columns
    missing = [OWN[x.key] for x in FIELDS if x.required and x.key not in names]
    if missing:
        raise lacking(str(file.path), missing, file.header, "data.columns")
    return names


def _check_pairs(table: pd.DataFrame, file: TableFile) -> None:
    """Check that each episode is of one pair."""
    episode, rows = table["episode"].to_numpy(), np.arange(len(table))
    first = np.zeros(int(episode.max()) + 1, dtype=np.int64)
    first[episode[::-1]] = rows[::-1]
    for name in ("recording", "follower_id", "leader_id"):
        values = table[name].to_numpy()
        wrong = values != values[first[episode]]
        if wrong.any():
            row = int(table["row"].to_numpy()[wrong].min())
            raise file.fault(row, name, "changes within an episode; expected one pair")


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
    missing = [name for name in COLUMNS if name not in present]
    if missing:
        raise lacking(source, missing, present, "")
    values = {}
    for column in STRICT:
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
        raise _at(source, row, "episode", ONE_ROW)
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
        remedy = f"({step:g} s here): begin another episode there, with a number of its own"
        raise _at(source, row, "time_s", f"{words} {remedy}")
    frame = pd.DataFrame({name: values[name] for name in COLUMNS})
    return frame.astype({**SCHEMA, "recording": str})
