"""Car-following episodes from trajectories in a table of any layout, by a map of its columns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lcc_rl.data.car_following import Criteria, extract
from lcc_rl.data.delimited import stem
from lcc_rl.data.episodes import DERIVED, derive_positions
from lcc_rl.data.plausible import SMOOTHING, Plausible
from lcc_rl.data.sources import LoadedEpisodes, find_files, plausible_episodes
from lcc_rl.data.table_rows import Rows, to_trajectories
from lcc_rl.data.tables import Table, read_table
from lcc_rl.data.trajectories import ReadReport, Trajectories
from lcc_rl.data.units import factors
from lcc_rl.errors import ConfigError, DataError, require_positive, unknown_name

COLUMNS: dict[str, str | None] = {
    "vehicle": "vehicle",
    "time": "time_s",
    "speed": "speed_mps",
    **dict.fromkeys(("position", "lane", "leader", "gap", "length", "recording")),
}
UNITS = {"time": "s", "speed": "m/s", "position": "m", "gap": "m", "length": "m"}
NEEDED = ("vehicle", "time", "speed")
LARGEST_ID = 2**53  # that a number of a table holds exactly


@dataclass(frozen=True)
class TableSource:
    """Episodes extracted from trajectories in CSV or parquet tables.

    The vehicle ahead is named by a column, or is the nearest one on the lane. The gap is that of
    a column, or the difference of positions less the leader's length. Samples are brought to 0.1 s.

    Args:
        path: a file, several files, or a pattern; each is a recording.
        columns: what the table calls ``vehicle``, ``time``, ``speed``, ``position`` (front bumper
            along the road), ``lane``, ``leader`` (the vehicle ahead; blank or 0 for none), ``gap``
            (bumper to bumper), ``length`` and ``recording``; null for what it does not have.
        units: of time, speed, position, gap and length, such as ``{"speed": "km/h"}``.
        vehicle_length: of vehicles whose length no column gives [m]; None: not known.
        smoothing: applied to the trajectories, see :mod:`lcc_rl.data.smoothing`; None for none.
        criteria: what counts as an episode; None for the defaults.
        plausible: thresholds of what is left out; None for the defaults.

    Raises:
        ConfigError: if a column or unit is unknown, or the columns do not say who follows whom and
            how far behind.
    """

    path: str | Sequence[str]
    columns: Mapping[str, str | None] = field(default_factory=lambda: dict(COLUMNS))
    units: Mapping[str, str] = field(default_factory=lambda: dict(UNITS))
    vehicle_length: float | None = None
    smoothing: Callable[[Trajectories], Trajectories] | None = None
    criteria: Criteria | None = None
    plausible: Plausible | None = None

    def __post_init__(self) -> None:
        for key, name in self.columns.items():
            if key not in COLUMNS:
                raise unknown_name("key of data.columns", str(key), COLUMNS)
            if not (isinstance(name, str) or (name is None and key not in NEEDED)):
                raise ConfigError(f"data.columns.{key} must name a column, got {name!r}")
        factors(self.units, COLUMNS, "data.units")
        if self.vehicle_length is not None:
            require_positive("data", vehicle_length=self.vehicle_length)
        if self.smoothing is not None and not callable(self.smoothing):
            raise ConfigError(
                f"data.smoothing must be null or a node with _target_, got {self.smoothing!r}"
            )
        given = {key for key, name in {**COLUMNS, **self.columns}.items() if name is not None}
        if not ("leader" in given or {"lane", "position"} <= given):
            raise ConfigError("data.columns must name leader, or lane and position")
        sized = "length" in given or self.vehicle_length is not None
        if not ("gap" in given or ("position" in given and sized)):
            raise ConfigError(
                "data.columns must name gap, or position and length (or say data.vehicle_length)"
            )
        if self.smoothing is not None and ("gap" in given or "position" not in given):
            raise ConfigError(
                "data.smoothing smooths positions: name data.columns.position, and leave out "
                "data.columns.gap, which would not agree with them; or smooth the file yourself"
            )

    def load(self) -> LoadedEpisodes:
        """Read, smooth where asked, and extract.

        Raises:
            DataError: naming the file, row and column, if a file is missing, damaged or holds what
                it must not, no episode is left, or more are implausible than ``plausible`` allows.
        """
        files = find_files(self.path)
        tables = [read_table(name, {**COLUMNS, **self.columns}, "data.columns") for name in files]
        report = ReadReport(files=files, notes=[note for table in tables for note in table.notes])
        rows, names = self._rows(tables, report)
        trajectories = to_trajectories(rows, names, report)
        if self.smoothing is not None:
            trajectories = self.smoothing(trajectories)
        smooth = f", smooth it ({SMOOTHING})" if rows.position is not None else ""
        remedy = f", name its units (data.units, here {self._units()}){smooth}"
        return episodes_of(trajectories, self.criteria, self.plausible, remedy)

    def _units(self) -> str:
        """The units of the columns that there are, as a line."""
        named = {**COLUMNS, **self.columns}
        units = {**UNITS, **self.units}
        return ", ".join(f"{key} {unit}" for key, unit in units.items() if named[key] is not None)

    def _rows(self, tables: Sequence[Table], report: ReadReport) -> tuple[Rows, list[str]]:
        """Rows of all files in SI, and the names of the recordings."""
        counts = [len(table) for table in tables]
        report.rows_read = sum(counts)
        vehicle, leader = _vehicles(tables, report)
        columns: dict[str, NDArray] = {"vehicle": vehicle}
        if leader is not None:
            columns["leader"] = leader
        scale = factors(self.units, COLUMNS, "data.units")
        for key, factor in scale.items():
            if key in tables[0].columns:
                blank = key in ("gap", "length")
                read = Table.numbers if key in ("time", "position") else not_negative
                parts = [read(table, key, factor, blank) for table in tables]
                columns[key] = np.concatenate(parts)
        if self.vehicle_length is not None:
            length = columns.get("length", np.zeros(sum(counts)))
            columns["length"] = np.where(length > 0, length, self.vehicle_length)
        if "lane" in tables[0].columns:
            lanes = np.concatenate([table.texts("lane") for table in tables])
            columns["lane"] = np.unique(lanes, return_inverse=True)[1].astype(np.int64)
        own = "recording" in tables[0].columns
        named = [
            t.texts("recording") if own else np.full(len(t), _recording(t, tables)) for t in tables
        ]
        names, recording = np.unique(np.concatenate(named).astype(str), return_inverse=True)
        columns["recording"] = recording.astype(np.int64)
        columns["row"] = np.concatenate([np.arange(count) for count in counts])
        if not sum(counts):
            raise DataError(f"{', '.join(report.files)}: has a header but no rows")
        return Rows(**columns), names.tolist()


def not_negative(
    table: Table, key: str, factor: float = 1.0, blank: bool = False
) -> NDArray[np.float64]:
    """Return a column of numbers that are not negative, see :meth:`Table.numbers`.

    Raises:
        DataError: naming the first row at fault.
    """
    values = table.numbers(key, factor, blank)
    table.refuse(values < 0, key, "is negative")
    return values


def episodes_of(
    trajectories: Trajectories,
    criteria: Criteria | None,
    plausible: Plausible | None,
    remedy: str = "",
) -> LoadedEpisodes:
    """Extract episodes; positions that no file gives are derived from speeds and gaps.

    Raises:
        DataError: naming the files, if there is none, or too many are implausible.
    """
    report = trajectories.report
    source = ", ".join(report.files)
    try:
        episodes, extraction = extract(trajectories, criteria or Criteria())
    except DataError as error:
        raise DataError(f"{source}: {error}") from error
    lines = [*report.lines(), *extraction.lines()]
    if not trajectories.samples["position_m"].to_numpy().any():
        derive_positions(episodes)
        lines.append(DERIVED)
    return plausible_episodes(plausible, episodes, source, lines, remedy)


def _recording(table: Table, tables: Sequence[Table]) -> str:
    """The name of a file's recording: without its folder, if that is enough."""
    stems = [stem(other.file) for other in tables]
    own = stem(table.file)
    return own if stems.count(own) == 1 else str(Path(table.file))


def _vehicles(tables: Sequence[Table], report: ReadReport) -> tuple[NDArray, NDArray | None]:
    """Vehicles and leaders as positive whole numbers; 0 for no leader."""
    named = "leader" in tables[0].columns
    vehicle = np.concatenate([table.texts("vehicle") for table in tables])
    leader = (
        np.concatenate([table.texts("leader", blank=True) for table in tables]) if named else None
    )
    numbers = _whole(vehicle)
    if numbers is not None and len(numbers) and numbers.min() > 0:
        if leader is None:
            return numbers, None
        ahead = _whole(np.where(leader == "", "0", leader))
        if ahead is not None:
            return numbers, np.where((ahead < 0) | (ahead == numbers), 0, ahead)
    names, codes = np.unique(vehicle, return_inverse=True)
    report.notes.append(f"vehicles are numbered from 1 in the order of {len(names):,} names")
    if leader is None:
        return codes.astype(np.int64) + 1, None
    known = pd.Index(names).get_indexer(leader) + 1
    none = (leader == "") | (np.isin(leader, ("0", "-1", "0.0", "-1.0")) & (known == 0))
    # A leader without a row is a number that no vehicle has.
    ahead = np.where(none, 0, np.where(known == 0, len(names) + 1, known))
    return codes.astype(np.int64) + 1, np.where(ahead == codes + 1, 0, ahead).astype(np.int64)


def _whole(texts: NDArray) -> NDArray[np.int64] | None:
    """The numbers that texts are, if all are whole numbers."""
    try:
        values = texts.astype(np.float64)
    except ValueError:
        return None
    sound = np.isfinite(values) & (np.abs(values) < LARGEST_ID)
    if not sound.all() or (values != np.rint(values)).any():
        return None
    return values.astype(np.int64)
