"""Car-following episodes from native OpenACC files: every car behind the car before it.

OpenACC (European Commission, Joint Research Centre; CC BY 4.0) has a row per moment: ``Time``, and
for car i ``Speed<i>`` [m/s] and ``IVS<i>``, the gap from car i + 1 to car i [m]. Cells are blank
where a car was not measured.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from lcc_rl.data.car_following import Criteria
from lcc_rl.data.plausible import Plausible
from lcc_rl.data.sources import LoadedEpisodes, episodes_of, find_files
from lcc_rl.data.table_source import labels, to_trajectories
from lcc_rl.data.tables import Column, TableFile
from lcc_rl.data.trajectories import ReadReport
from lcc_rl.errors import DataError
from lcc_rl.settings import Settings


class OpenAccSource(Settings):
    """Episodes of native OpenACC files; each is a recording, in which car i follows car i − 1.

    A blank cell divides the trajectory of its car. Positions are derived from speeds and gaps:
    those in the files are antennas', in the plane.
    """

    path: str | Sequence[str]  # a file, several files, or a pattern
    criteria: Criteria | None = None  # None for the defaults
    plausible: Plausible | None = None  # None for the defaults

    def load(self) -> LoadedEpisodes:
        """Read and extract.

        Raises:
            DataError: naming the file, row and column, if a file is missing, damaged or no native
                OpenACC file, no episode is left, or more are implausible than allowed.
        """
        files = find_files(self.path)
        report = ReadReport(files=files)
        cars = [_cars(TableFile(name), number, report) for number, name in enumerate(files)]
        trajectories = to_trajectories(pd.concat(cars), labels(files), report)
        return episodes_of(trajectories, self.criteria, self.plausible)


def _cars(table: TableFile, recording: int, report: ReadReport) -> pd.DataFrame:
    """All cars of a file, one below the other; see :func:`to_trajectories`."""
    count = sum(f"Speed{car}" in table.header for car in range(1, len(table.header) + 1))
    if count < 2:
        raise DataError(f"{table.path}: lacks Speed1 and Speed2; expected a native OpenACC file")
    speeds = [Column(f"Speed{n}", "speed", least=0.0, blank=True) for n in range(1, count + 1)]
    gaps = [Column(f"IVS{n}", "length", least=0.0, blank=True) for n in range(1, count)]
    columns = [Column("Time", "time"), *speeds, *gaps]
    read = table.read(columns, {column.key: column.key for column in columns})
    rows = len(read["Time"])
    cars = pd.DataFrame(
        {
            "recording": recording,
            "vehicle": np.repeat(np.arange(1, count + 1), rows),
            "time": np.tile(read["Time"], count),
            "speed": np.concatenate([read[column.key] for column in speeds]),
            "row": np.tile(np.arange(rows), count),
            "gap": np.concatenate([np.full(rows, np.nan), *(read[c.key] for c in gaps)]),
        }
    )
    cars["leader"] = (cars.vehicle - 1).where(cars.gap.notna(), 0)
    seen = cars.speed.notna()
    unknown = int((cars.gap.isna() & seen & (cars.vehicle > 1)).sum())
    report.rows_read += len(cars)
    report.drop("blank speed", int((~seen).sum()))
    report.notes += table.notes
    order = table.preamble.get("Vehicle_order", "").strip(", ").replace(",", ", ")
    report.notes.append(f"{table.path}: {count} cars{': ' if order else ''}{order}")
    if unknown:
        report.notes.append(f"{table.path}: {unknown:,} samples with a blank gap follow nobody")
    return cars[seen]
