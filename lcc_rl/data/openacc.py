"""Car-following episodes from native OpenACC files: every car behind the car before it.

OpenACC (European Commission, Joint Research Centre; CC BY 4.0) has a row per moment: ``Time``, and
for car i ``Speed<i>`` [m/s] and ``IVS<i>``, the gap from car i + 1 to car i [m]. Cells are blank
where a car was not measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lcc_rl.data.car_following import Criteria
from lcc_rl.data.delimited import stem
from lcc_rl.data.plausible import Plausible
from lcc_rl.data.sources import LoadedEpisodes, find_files
from lcc_rl.data.table_rows import Rows, to_trajectories
from lcc_rl.data.table_source import episodes_of, not_negative
from lcc_rl.data.tables import Table, read_table
from lcc_rl.data.trajectories import ReadReport
from lcc_rl.errors import DataError

OPTION = "data=table data.columns"
NO_SPEED, NO_GAP = "blank speed", "blank gap"


@dataclass(frozen=True)
class OpenAccSource:
    """Episodes of native OpenACC files.

    Car i follows car i − 1. A blank cell divides the trajectory of its car. Positions are derived
    from speeds and gaps: those in the files are antennas', in the plane.

    Args:
        path: a file, several files, or a pattern; each is a recording.
        criteria: what counts as an episode; None for the defaults.
        plausible: thresholds of what is left out; None for the defaults.
    """

    path: str | Sequence[str]
    criteria: Criteria | None = None
    plausible: Plausible | None = None

    def load(self) -> LoadedEpisodes:
        """Read and extract.

        Raises:
            DataError: naming the file, row and column, if a file is missing, damaged or no native
                OpenACC file, no episode is left, or more are implausible than allowed.
        """
        files = find_files(self.path)
        report, parts = ReadReport(files=files), []
        for number, name in enumerate(files):
            parts.append(_cars(read_table(name, {"time": "Time"}, OPTION, False), number, report))
        names = [stem(name) for name in files]
        if len(set(names)) < len(names):
            names = files
        columns = [dict(part.columns()) for part in parts]
        rows = Rows(**{key: np.concatenate([x[key] for x in columns]) for key in columns[0]})
        return episodes_of(to_trajectories(rows, names, report), self.criteria, self.plausible)


def _cars(table: Table, recording: int, report: ReadReport) -> Rows:
    """All cars of a file, one below the other."""
    count = sum(f"Speed{car}" in table.header for car in range(1, len(table.header) + 1))
    lacking = [f"Speed{car}" for car in range(1, count + 1) if f"Speed{car}" not in table.header]
    lacking += [f"IVS{car}" for car in range(1, count) if f"IVS{car}" not in table.header]
    if count < 2 or lacking:
        raise DataError(
            f"{table.file}: lacks {', '.join(lacking) or 'Speed1 and Speed2'}; expected a native "
            f"OpenACC file: Time, Speed1, Speed2 … and the gaps IVS1 …; for others see data=table"
        )
    time = table.numbers("time")
    cars = range(1, count + 1)
    speed = np.stack([not_negative(table, f"Speed{car}", blank=True) for car in cars])
    gaps = [not_negative(table, f"IVS{car}", blank=True) for car in cars[:-1]]
    gap = np.stack([np.full(len(time), np.nan), *gaps])
    seen = ~np.isnan(speed)
    leader = np.broadcast_to(np.arange(count)[:, None], speed.shape)
    unknown = int((np.isnan(gap[1:]) & seen[1:]).sum())
    report.rows_read += speed.size
    if not seen.all():
        report.dropped[NO_SPEED] = report.dropped.get(NO_SPEED, 0) + int((~seen).sum())
    report.notes += table.notes
    order = table.preamble.get("Vehicle_order", "").strip(", ").replace(",", ", ")
    report.notes.append(f"{table.file}: {count} cars{': ' if order else ''}{order}")
    if unknown:
        report.notes.append(f"{table.file}: {unknown:,} samples with a {NO_GAP} follow nobody")
    return Rows(
        recording=np.full(int(seen.sum()), recording),
        vehicle=(leader + 1)[seen],
        time=np.broadcast_to(time, speed.shape)[seen],
        speed=speed[seen],
        row=np.broadcast_to(np.arange(len(time)), speed.shape)[seen],
        leader=np.where(np.isnan(gap), 0, leader)[seen],
        gap=gap[seen],
    )
