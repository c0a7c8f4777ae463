"""Leaders that drive the records of one table: many drives, or a single one."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lcc_rl.data.cycles import Leaders, varying
from lcc_rl.data.plausible import Plausible
from lcc_rl.data.profiles import Profiles, from_records, nothing
from lcc_rl.data.speed_records import LEADER, SPEED, TIME, resample
from lcc_rl.errors import ConfigError, DataError, require_in, unknown_name

# What a table of drives has, and how the columns are called by default.
COLUMNS = {"drive": "drive", "time": TIME, "speed": SPEED}
UNEVEN = 0.1  # of the median step, by which a step may differ from it


@dataclass(frozen=True)
class DriveLeaders:
    """Leaders that drive the speed records of a table.

    Several drives are divided by name: whether a drive is held out depends on a SHA-256 hash of
    its name alone, or of the part that drives of one day share, so that it is on the same side in
    every file. Of a single record the end is held out.

    Args:
        path: a .csv or .parquet file.
        columns: what its columns are called: ``drive``, the name of the record, null for a table
            that holds one record; ``time`` [s], even in a record; ``speed`` [m/s].
        evaluation_share: share of the names, or of the single record, that is held out, 0…1; 1
            evaluates on everything and leaves nothing to train on.
        together: regular expression; drives whose names begin with the same match are on the same
            side. None: every name by itself.
        tuning: for choosing settings: leave the evaluation's part out and divide the rest again.
        least_variation: see :class:`lcc_rl.data.cycles.RecordLeaders`.
        fastest: held-out windows in which the leader's mean speed is higher are left out [m/s];
            None for none.
        plausible: thresholds of every sample; None for the defaults.

    Raises:
        ConfigError: if a column is unknown, a number out of range or the expression is none.
    """

    path: str
    columns: Mapping[str, str | None] = field(default_factory=lambda: dict(COLUMNS))
    evaluation_share: float = 1 / 3
    together: str | None = None
    tuning: bool = False
    least_variation: float = 2.0
    fastest: float | None = None
    plausible: Plausible | None = None

    def __post_init__(self) -> None:
        require_in("leader", "(0, 1]", evaluation_share=self.evaluation_share)
        require_in("leader", "[0, inf)", least_variation=self.least_variation)
        if self.fastest is not None:
            require_in("leader", "(0, inf)", fastest=self.fastest)
        if self.tuning and self.evaluation_share == 1:
            raise ConfigError("leader.tuning=true leaves nothing to tune on: evaluation_share is 1")
        try:
            re.compile(self.together or "")
        except re.error as error:
            raise ConfigError(f"leader.together={self.together}: {error}") from error
        if self.together and self.columns.get("drive", "") is None:
            raise ConfigError("leader.together divides drives by name; the table holds one record")
        for key, name in self.columns.items():
            if key not in COLUMNS:
                raise unknown_name("key of leader.columns", str(key), COLUMNS)
            if not (isinstance(name, str) or (key == "drive" and name is None)):
                raise ConfigError(f"leader.columns.{key} must name a column, got {name!r}")

    def load(self, time_step: float, horizon: int, followers: int | None = None) -> Leaders:
        """Read everything; see :meth:`lcc_rl.data.cycles.RecordLeaders.load`."""
        columns = {**COLUMNS, **self.columns}
        profiles, report = read_drives(self.path, columns, time_step, self.plausible)
        divide = self._by_time if columns["drive"] is None else self._by_name
        training, held_out = divide(profiles)
        if self.tuning:
            training, held_out = divide(training, again=True)
        windows = varying(held_out.at_least(horizon).windows(horizon), self.least_variation)
        windows = slow(windows, self.fastest)
        if len(training):
            training = training.at_least(horizon)
        by = "at the end" if columns["drive"] is None else "by name"
        count = f"{len(held_out)} of {len(profiles)} record(s) for evaluation, {by}: "
        line = f"{self.path}: {count}{', '.join(held_out.names)}"
        return Leaders(training, windows, report=(*report, line))

    def _by_name(self, profiles: Profiles, again: bool = False) -> tuple[Profiles, Profiles]:
        """Divide drives by a hash of their names; once more for tuning."""
        share = self.evaluation_share
        place = np.array([hashed(self._family(name)) for name in profiles.names])
        if again:  # what is left lies in share…1
            place = (place - share) / (1 - share)
        held = place < share
        if held.all() and share == 1:
            return nothing(profiles.time_step), profiles
        if held.all() or not held.any():
            side = "evaluation" if held.any() else "training"
            raise DataError(
                f"{self.path}: the names of all {len(held)} drives fall on the side of {side}; "
                "change leader.evaluation_share (1: all for evaluation) or give more drives"
            )
        return profiles.select(np.flatnonzero(~held)), profiles.select(np.flatnonzero(held))

    def _family(self, name: str) -> str:
        """Return the part of a name that says on which side its drive is.

        Raises:
            DataError: if the name has no such part.
        """
        if self.together is None:
            return name
        found = re.match(self.together, name)
        if not found or not found.group():
            raise DataError(f"{self.path}: drive {name!r} does not begin with {self.together!r}")
        return found.group()

    def _by_time(self, profiles: Profiles, again: bool = False) -> tuple[Profiles, Profiles]:
        """Divide the one record, whose end is held out."""
        if self.evaluation_share == 1:
            return nothing(profiles.time_step), profiles
        record, name = profiles.record(0), profiles.names[0]
        cut = len(record) - round(self.evaluation_share * len(record))
        if not 1 < cut < len(record) - 1:
            raise DataError(f"{self.path}: {len(record)} samples cannot be divided")
        at = f"{name}+{cut * profiles.time_step:g}s"
        parts = ((record[:cut], name), (record[cut:], at))
        first, last = (
            from_records([part], [label], profiles.recordings, profiles.time_step)
            for part, label in parts
        )
        return first, last


def slow(profiles: Profiles, fastest: float | None) -> Profiles:
    """Return the records whose mean speed is at most ``fastest`` [m/s]; all for None.

    Raises:
        DataError: if there is none.
    """
    if fastest is None:
        return profiles
    kept = [i for i in range(len(profiles)) if float(profiles.record(i).mean()) <= fastest]
    if not kept:
        raise DataError(
            f"no held-out window in which the leader's mean speed is at most {fastest:g} m/s; "
            "raise leader.fastest or give another record"
        )
    return profiles.select(kept)


def hashed(name: str) -> float:
    """Return a number in [0, 1) that depends on a name alone, the same on every machine.

    The prefix keeps it apart from other divisions by the plain hash of the same names.
    """
    digest = hashlib.sha256(f"lcc_rl held out: {name}".encode()).digest()
    return int.from_bytes(digest[:6], "big") / 2**48


def read_drives(
    path: str,
    columns: Mapping[str, str | None],
    time_step: float,
    plausible: Plausible | None = None,
) -> tuple[Profiles, list[str]]:
    """Read the speed records of a table.

    Args:
        path, columns, plausible: see :class:`DriveLeaders`.
        time_step: step of the profiles [s]; the records are interpolated to it.

    Returns:
        A profile for each record, in the order of their names, and lines on what was read.

    Raises:
        DataError: naming file, row and column, if a value is missing, no number or negative, a
            time is there twice, the steps of a record are uneven, or too much is implausible.
    """
    file = Path(path).expanduser()
    table = _sound(_table(file, columns), columns, str(file))
    names, row = table["name"], table["row"].to_numpy()

    def place(number: int, column: str) -> str:
        own = {TIME: columns["time"], SPEED: columns["speed"]}.get(column, column)
        return f"data row {row[number] + 1} ({names.iloc[number]}), column {own!r}"

    kept, lines = (plausible or Plausible()).select(table, str(file), place, LEADER)
    groups = list(kept.groupby("name", sort=True))
    records = [
        resample(part[TIME].to_numpy(), part[SPEED].to_numpy(), time_step) for _, part in groups
    ]
    labels = [str(name) for name, _ in groups]
    line = f"read {len(groups):,} speed record(s), {len(kept):,} rows, {file}"
    return from_records(records, labels, labels, time_step), [line, *lines]


def _table(file: Path, columns: Mapping[str, str | None]) -> pd.DataFrame:
    """Columns of a file as they stand there, all names as text."""
    if not file.is_file():
        raise DataError(f"{file}: no such file; expected a .csv or .parquet of speed records")
    drive = columns["drive"]
    try:
        if file.suffix == ".parquet":
            frame = pd.read_parquet(file)
        else:  # as text, or the drive "01" would be the number 1
            frame = pd.read_csv(file, dtype={drive: str} if drive else None)
    except (ValueError, OSError) as error:
        raise DataError(f"{file}: not a readable table: {error}") from error
    missing = [name for name in columns.values() if name is not None and name not in frame]
    if missing:
        raise DataError(
            f"{file}: lacks the column {', '.join(missing)}; it has {', '.join(map(str, frame))}; "
            "say which is which by leader.columns.drive, .time and .speed"
        )
    return frame


def _sound(frame: pd.DataFrame, columns: Mapping[str, str | None], file: str) -> pd.DataFrame:
    """Name, time, speed and row of every sample, record by record, or a DataError."""
    drive, time, speed = (columns[key] for key in COLUMNS)
    names = frame[drive] if drive else pd.Series(Path(file).stem, index=frame.index)
    _refuse(names.isna().to_numpy(), np.arange(len(frame)), file, drive, "is empty")
    table = pd.DataFrame({"name": names.astype(str).to_numpy(), "row": np.arange(len(frame))})
    for column, own in ((TIME, time), (SPEED, speed)):
        values = pd.to_numeric(frame[own], errors="coerce").to_numpy(np.float64)
        _refuse(~np.isfinite(values), table["row"], file, own, "is not a number")
        table[column] = values
    _refuse(table[SPEED] < 0, table["row"], file, speed, "is negative")
    if len(table) < 2:
        raise DataError(f"{file}: holds {len(table)} samples, at least 2 are needed")
    table = table.sort_values("name", kind="stable", ignore_index=True)
    table["episode"] = table["name"].ne(table["name"].shift()).cumsum()
    step = table.groupby("episode")[TIME].diff()
    _refuse(step <= 0, table["row"], file, time, "does not follow the time before it in its record")
    usual = step.groupby(table["episode"]).transform("median")
    _refuse(usual.isna(), table["row"], file, time, "is the only sample of its record")
    uneven = (step - usual).abs() > UNEVEN * usual
    _refuse(uneven, table["row"], file, time, "is not evenly spaced in its record")
    return table


def _refuse(
    wrong: NDArray[np.bool_] | pd.Series,
    row: NDArray | pd.Series,
    file: str,
    column: object,
    words: str,
) -> None:
    """Raise a DataError that names the first row at fault, if there is one."""
    if np.any(wrong):
        first = int(np.asarray(row)[np.asarray(wrong)].min())
        raise DataError(f"{file}: data row {first + 1}, column {column!r} {words}")
