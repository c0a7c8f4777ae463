"""Car-following episodes from native OpenACC files: every car behind the car before it.

OpenACC (European Commission, Joint Research Centre; CC BY 4.0) has a row per time: ``Time``, and
for car i ``Speed<i>`` [m/s], ``IVS<i>``, the gap from car i + 1 to car i [m], and in some campaigns
``Driver<i>``. Cells are blank or columns absent for cars that were not measured.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lcc_rl.data.columns import Column
from lcc_rl.data.grid import BRIDGE_S, LongestHole, places
from lcc_rl.data.sources import LoadedEpisodes, TrajectorySource, find_files
from lcc_rl.data.table_source import to_trajectories
from lcc_rl.data.tables import TableFile
from lcc_rl.data.text import labels
from lcc_rl.data.trajectories import ReadReport
from lcc_rl.errors import DataError


class OpenAccSource(TrajectorySource):
    """Episodes of native OpenACC files; each is a recording in which car i follows car i − 1.

    A blank cell divides the trajectory of its car. Positions are derived from speeds and gaps,
    because those in the files are positions of antennas in the plane.
    """

    path: str | Sequence[str]  # a file, several files, or a pattern
    driver: Literal["human", "acc"] | None = None  # only followers with this Driver<i>
    bridge_s: LongestHole = BRIDGE_S  # longer holes divide records [s]

    def load(self) -> LoadedEpisodes:
        """Read and extract.

        Raises:
            DataError: naming the file, row and column, if a file is missing, damaged or no native
                OpenACC file, no episode is left, or more are implausible than allowed.
        """
        files = find_files(self.path)
        report = ReadReport(files=files)
        cars = [
            _cars(TableFile(name), self.driver, report).assign(recording=label, file=number)
            for number, (name, label) in enumerate(zip(files, labels(files), strict=True))
        ]
        place = partial(places, files=files)
        rows = pd.concat(cars, ignore_index=True)
        if self.driver is not None and not (rows["leader"] > 0).any():
            lines = [line for line in report.notes if "followers by driver" in line]
            raise DataError(f"data.driver={self.driver} keeps no follower: {'; '.join(lines)}")
        trajectories = to_trajectories(rows, place, report, self.bridge_s)
        return self.extracted(trajectories, place=place)


def _cars(table: TableFile, driver: str | None, report: ReadReport) -> pd.DataFrame:
    """Return the rows of all cars of a file; see :func:`to_trajectories`."""
    numbers, followers, columns = _columns(table)
    read = table.read(columns, {column.key: column.key for column in columns})
    rows = len(read["Time"])
    blank = np.full(rows, np.nan)
    cars = pd.DataFrame(
        {
            "vehicle": np.repeat(numbers, rows),
            "time_s": np.tile(read["Time"], len(numbers)),
            "speed": np.concatenate([read[f"Speed{n}"] for n in numbers]),
            "row": np.tile(read["row"], len(numbers)),
            "gap": np.concatenate([read.get(f"IVS{n - 1}", blank) for n in numbers]),
        }
    )
    seen = cars.speed.notna()
    unknown = int((cars.gap.isna() & seen & (cars.vehicle > min(numbers))).sum())
    report.rows_read += len(cars)
    report.drop("blank speed", int((~seen).sum()))
    report.notes += table.notes
    order = table.preamble.get("Vehicle_order", "").strip(", ").split(",")
    named = ", ".join(order[n - 1] for n in numbers if n <= len(order) and order[n - 1])
    report.notes.append(f"{table.path}: {len(numbers)} cars{': ' if named else ''}{named}")
    report.notes.append(f"{table.path}: {_marked(table, followers, read)}")
    if unknown:
        report.notes.append(f"{table.path}: {unknown:,} samples have a blank gap")
    cars["leader"] = (cars.vehicle - 1).where(cars.gap.notna(), 0)
    if driver is not None:
        none = np.full(rows, "")
        drivers = np.concatenate([read.get(f"Driver{n}", none) for n in numbers]).astype(str)
        other = cars.gap.notna() & (np.char.lower(drivers) != driver)
        cars["gap"] = cars.gap.mask(other)
        cars["leader"] = np.where(other, -1, cars.leader)
        note = f"{int(cars.gap.notna().sum()):,} samples of followers driven by {driver}"
        report.notes.append(f"{table.path}: {note}, {int(other.sum()):,} of others")
    return cars[seen]


def _columns(table: TableFile) -> tuple[list[int], list[int], list[Column]]:
    """Return the numbers of the cars and of cars with a gap, and the columns to read."""
    numbers = [int(name[5:]) for name in table.header if re.fullmatch(r"Speed[1-9]\d?", name)]
    if len(numbers) < 2:
        raise DataError(f"{table.path}: lacks Speed1 and Speed2; expected a native OpenACC file")
    followers = [n for n in numbers if n - 1 in numbers and f"IVS{n - 1}" in table.header]
    if not followers:
        raise DataError(f"{table.path}: lacks IVS1, IVS2 …; expected a native OpenACC file")
    columns = [
        Column("Time", "time"),
        *(Column(f"Speed{n}", "speed", blank=True) for n in numbers),
        *(Column(f"IVS{n - 1}", "length", blank=True) for n in followers),
        *(Column(f"Driver{n}", "text", blank=True) for n in numbers),
    ]
    return numbers, followers, [x for x in columns if x.key == "Time" or x.key in table.header]


def _marked(table: TableFile, followers: Iterable[int], read: Mapping[str, NDArray]) -> str:
    """Describe the drivers of the followers by the columns ``Driver`` and the header."""
    marks = [
        " and ".join(sorted({*np.unique(read.get(f"Driver{n}", [""]))} - {""})) or "unmarked"
        for n in followers
    ]
    counts = ", ".join(f"{marks.count(mark)} {mark}" for mark in sorted({*marks}))
    header = table.preamble.get("ACC")
    extra = f" (header: ACC,{header})" if header else ""
    return f"followers by driver: {counts}{extra}; data.driver=human keeps those marked Human"
