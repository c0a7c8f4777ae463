"""Tables of car-following episodes: schema and reader."""

from __future__ import annotations

from collections.abc import Sequence, Set
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lcc_rl.arrays import Mask
from lcc_rl.data.columns import Column, Names, Units
from lcc_rl.data.grid import Places, continuous, cut_by_files, on_grid, places, stretches
from lcc_rl.data.tables import (
    LARGEST_ID,
    TableFile,
    chosen,
    joined,
    same_text,
    tables_of,
    whole_numbers,
)
from lcc_rl.data.text import alike, lacking
from lcc_rl.data.trajectories import ReadReport
from lcc_rl.errors import DataError

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
# Columns of a table of pairs; a configuration names them by these keys.
PAIR_FIELDS = (
    Column("episode", "text", required=False),
    Column("recording", "text", required=False),
    Column("follower_id", least=-LARGEST_ID, most=LARGEST_ID, whole=True, required=False),
    Column("leader_id", least=-LARGEST_ID, most=LARGEST_ID, whole=True, required=False),
    Column("time", "time", blank=True),
    Column("follower_position", "length", blank=True, required=False),
    Column("follower_speed", "speed", blank=True),
    Column("leader_position", "length", blank=True, required=False),
    Column("leader_speed", "speed", blank=True, required=False),
    Column("leader_length", "length", least=0.0, required=False),
    Column("gap", "length", blank=True),
    # Of the log of a car, instead of the leader's speed: leader minus follower.
    Column("relative_speed", "speed", blank=True, required=False),
    Column("target", "text", blank=True, required=False),  # id of the leader; blank or 0: none
    Column("valid", "text", blank=True, required=False),  # whether the leader is measured
)
NO_LEADER = ("", "0", "-1", "0.0", "-1.0")  # in columns of leaders and targets
VALID, NOT_VALID = ("1", "1.0", "true", "yes"), ("", "0", "0.0", "false", "no", "nan")
# Rows with a blank cell in one of these are left out.
PAIR_MEASURED = [x.key for x in PAIR_FIELDS if x.blank and x.quantity != "text"]
# Default names.
EPISODE_NAMES = dict(zip((column.key for column in PAIR_FIELDS), SCHEMA, strict=False))
EPISODE_ALIASES = {"event": "episode", "period": "recording"}
DERIVED_POSITIONS = "no positions given: those of leaders are the integral of their speeds"
TEXTS = ("recording", "label")  # categorical columns
MOTION_COLUMNS = [name for name in SCHEMA if name.endswith(("_position_m", "_speed_mps", "gap_m"))]


def read_episodes(
    paths: Sequence[str], columns: Names, units: Units, bridge: float
) -> tuple[pd.DataFrame, list[str]]:
    """Read tables of pairs: a row per pair and time, at any rate, possibly with holes.

    Args:
        paths: .csv or .parquet files, see :class:`lcc_rl.data.tables.TableFile`. Columns that
            ``PAIR_FIELDS`` does not require may be missing; ``event`` and ``period`` may stand for
            ``episode`` and ``recording``.
        columns: names of the columns by the keys of ``PAIR_FIELDS``, where they are not those of
            ``SCHEMA``.
        units: units by key, where they are not SI.
        bridge: longest hole that does not divide an episode [s].

    Returns:
        The columns ``SCHEMA``, samples 0.1 s apart, ``file`` and its ``row``, from 0, and
        ``label``, the file's name of the episode; and lines on the tables. Speeds and gaps
        may be negative.

    Raises:
        DataError: naming file, row and column, if a cell is missing or no number, or rows
            contradict each other.
    """
    parts: list[pd.DataFrame] = []
    notes: list[str] = []
    place, seen, count = partial(places, columns=columns), set[str](), 0
    for number, file in enumerate(tables_of(paths)):
        table, lines = _table(file, columns, units, place, seen, count, bridge)
        episode = table["episode"]
        if parts:
            table["episode"] = episode + parts[-1]["episode"].max() + 1 - episode.min()
        seen, count = seen | {*table["recording"].cat.categories}, count + episode.nunique()
        parts.append(table.assign(file=np.int32(number)))
        notes += lines
    texts = {name: joined([frame.pop(name).array for frame in parts]) for name in TEXTS}
    rows = parts[0] if len(parts) == 1 else pd.concat(parts, ignore_index=True)
    parts.clear()
    rows = rows.assign(label=texts["label"])
    rows.insert(1, "recording", texts["recording"].astype(str))
    notes += cut_by_files(rows, "label", paths)
    return rows, alike(notes, paths)


def _table(
    file: TableFile,
    columns: Names,
    units: Units,
    place: Places,
    seen: Set[str],
    count: int,
    bridge: float,
) -> tuple[pd.DataFrame, list[str]]:
    """Read a file after ``count`` episodes of the recordings ``seen``, and resample it."""
    names = _names(file, columns)
    table, numbers = _rows(file, names, units, seen, count)
    notes = list(file.notes)
    for name, note in (
        ("recording", "no column recording: each file is one recording"),
        ("leader_length", "no column leader_length_m: lengths are not known"),
    ):
        if names.get(name) is None:
            notes.append(note)
    report = ReadReport([str(file.path)])
    table = continuous(table, "episode", place, report, "data", bridge)
    first, lengths = stretches(table["episode"].to_numpy())
    start = np.repeat(table["time_s"].to_numpy()[first], lengths)
    table, _ = on_grid(table, start, MOTION_COLUMNS, place, report)
    table["time_s"] = table["time_s"].round(6)
    # Parts after holes have numbers beyond the file's own.
    further = np.arange(table["episode"].max() + 1 - len(numbers)) + numbers.max() + 1
    table["episode"] = np.append(numbers, further)[table["episode"]]
    table = table[[*SCHEMA, "row", "label"]]
    for name in (name for name in SCHEMA if name not in TEXTS):  # one by one, to spare memory
        table[name] = table[name].astype(np.dtype(SCHEMA[name]))
    if not {"leader_position", "follower_position"} <= {key for key in names if names[key]}:
        derive_positions(table)
        notes.append(DERIVED_POSITIONS)
    return table, [
        *notes,
        *(f"{file.path}: {line}" for line in (*report.left_out(), *report.notes)),
    ]


def _rows(
    file: TableFile, names: Names, units: Units, seen: Set[str], count: int
) -> tuple[pd.DataFrame, NDArray[np.int64]]:
    """Return rows of a file with episodes numbered from 0, and the file's own numbers."""
    read = file.read(PAIR_FIELDS, names, units, "data.columns", PAIR_MEASURED)
    read, cars = _targets(read, file)
    if not len(read["time"]):
        message = f"{file.path}: has no episodes; expected at least one row"
        raise DataError("; ".join([message, *file.notes]))
    row, turn = read.pop("row"), read.pop("turn", None)
    rows = len(row)
    labels = read.pop("episode", same_text("", rows))
    codes, distinct = pd.factorize(labels)
    codes, numbers = codes.astype(np.int32), whole_numbers(np.asarray(distinct))
    if numbers is None or (np.abs(numbers) >= 2**31).any():
        numbers = np.arange(len(distinct))
    recording = read.get("recording", same_text(file.label, rows))
    before = count * (turn is not None or bool(seen & {*recording.categories}))
    values = {
        **dict.fromkeys(SCHEMA, np.zeros(rows)),
        **{EPISODE_NAMES[key]: cells for key, cells in read.items()},
        "recording": recording,
    }
    if "follower_id" not in read:  # unknown vehicles of several files are different ones
        values["follower_id"] = 2 * (pd.factorize(cars)[0] + before) + 2
    if "leader_id" not in read:
        values["leader_id"] = 2 * (codes + before) + 1
    values |= {"time_s": read["time"].round(6), "row": row, "label": labels, "episode": codes}
    if turn is not None:
        values["turn"] = turn
    table = pd.DataFrame(values, copy=False)  # times have a resolution of 1 µs
    _check_pairs(table, file)
    return table, numbers


def _targets(read: dict[str, Any], file: TableFile) -> tuple[dict[str, Any], pd.Categorical]:
    """Return the columns with an episode per target, and the file's episode of each row.

    Rows without a valid target are left out. A relative speed becomes the leader's.
    """
    rows, valid = len(read["time"]), read.pop("valid", None)
    target, relative = read.pop("target", None), read.pop("relative_speed", None)
    mask, cars = np.ones(rows, dtype=bool), read.get("episode", same_text("", rows))
    if relative is not None:
        read["leader_speed"] = read["follower_speed"] + relative
    if valid is not None:
        folded = np.char.lower(np.asarray(valid).astype(str))
        if (odd := ~np.isin(folded, (*VALID, *NOT_VALID))).any():
            message = f"is {str(folded[odd][0])!r}; expected 1 or 0, true or false"
            raise file.fault(int(read["row"][odd][0]), "valid", message)
        mask &= np.isin(folded, VALID)
    if target is not None:
        mask &= ~target.isin(NO_LEADER)
        runs = np.asarray(cars).astype(str)
        names = np.where(runs == "", "target ", np.char.add(runs, " target "))
        read["episode"] = pd.Categorical(np.char.add(names, np.asarray(target).astype(str)))
        read["turn"] = _turns(read, cars, ~target.isin(NO_LEADER))
    if mask.all():
        return read, cars
    first = f"data row {int(read['row'][np.argmin(mask)]) + 1}"
    file.notes.append(f"left out {int((~mask).sum()):,} rows without a valid target, {first} …")
    return chosen(read, mask), cars[mask]


def _turns(read: dict[str, Any], cars: pd.Categorical, named: Mask) -> NDArray[np.int32]:
    """Return numbers that differ if another target is ``named`` between two rows of a car."""
    codes, turn = read["episode"].codes, np.zeros(len(named), dtype=np.int32)
    order = np.lexsort((read["time"], cars.codes))
    order = order[named[order]]
    turn[order] = np.cumsum(np.diff(codes[order], prepend=0) != 0)
    return turn


def _names(file: TableFile, columns: Names) -> dict[str, str | None]:
    """Return the file's names of columns by the keys of ``FIELDS``."""
    names: dict[str, str | None] = {
        key: name for key, name in EPISODE_NAMES.items() if name in file.header
    }
    names |= {
        new: old for old, new in EPISODE_ALIASES.items() if old in file.header and new not in names
    }
    names |= columns
    missing = [EPISODE_NAMES[x.key] for x in PAIR_FIELDS if x.required and x.key not in names]
    if names.get("relative_speed") is not None:
        names.pop("leader_speed", None)
    elif names.get("leader_speed") is None:
        missing.append(EPISODE_NAMES["leader_speed"])
    if missing:
        raise lacking(str(file.path), missing, file.header, "data.columns")
    return names


def _check_pairs(table: pd.DataFrame, file: TableFile) -> None:
    """Check that each episode has one pair."""
    episode, rows = table["episode"].to_numpy(), np.arange(len(table))
    first = np.zeros(int(episode.max()) + 1, dtype=np.int64)
    first[episode[::-1]] = rows[::-1]
    for name in ("recording", "follower_id", "leader_id"):
        values = (table[name].cat.codes if name in TEXTS else table[name]).to_numpy()
        wrong = values != values[first[episode]]
        if wrong.any():
            row = int(table["row"].to_numpy()[wrong].min())
            raise file.fault(row, name, "changes within an episode; expected one pair")


def derive_positions(episodes: pd.DataFrame) -> None:
    """Derive positions from speeds and gaps; the leader's is 0 m at an episode's start.

    Args:
        episodes: the table in SI; it is changed in place.
    """
    speed = episodes["leader_speed_mps"].to_numpy(np.float64)
    time = episodes["time_s"].to_numpy(np.float64)
    starts, lengths = stretches(episodes["episode"].to_numpy())
    total = np.cumsum(np.append(0.0, (speed[1:] + speed[:-1]) / 2 * np.diff(time)))
    position = total - np.repeat(total[starts], lengths)
    behind = episodes["gap_m"].to_numpy() + episodes["leader_length_m"].to_numpy()
    episodes["leader_position_m"] = position.astype(np.float32)
    episodes["follower_position_m"] = (position - behind).astype(np.float32)
