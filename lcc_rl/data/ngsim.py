"""Reader of NGSIM files in any published layout.

Three layouts are read, plain or gzipped, told apart by their first line: the native headerless
18 columns separated by white space, the 18-column CSV with header (19 with Location), and the
25-column export of the public portal. Files are streamed in blocks and only the needed columns
are kept, in compact types, so that the whole portal export fits in a few gigabytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lcc_rl.data.ngsim_blocks import read_blocks
from lcc_rl.data.ngsim_columns import CollectedRows
from lcc_rl.data.ngsim_table import sorted_table
from lcc_rl.data.trajectories import ReadReport, Trajectories
from lcc_rl.data.units import check_units, factor
from lcc_rl.errors import DataError


def read_ngsim(
    path: str | Path | Sequence[str | Path],
    location: str | None = None,
    units: str = "feet",
) -> Trajectories:
    """Read one or several NGSIM files, of any published layout, into SI.

    Header names match whatever their letter case, spaces and underscores. Required are Vehicle_ID,
    Frame_ID, Local_Y, v_Length, v_Class, v_Vel, v_Acc, Lane_ID and Preceding; Global_Time,
    Space_Headway and Location are used where present. Cells may be blank in every other column
    and in Preceding, Space_Headway, Global_Time, v_Class and Location.

    Vehicle ids repeat between recordings. A recording is identified by its location and the time
    of its frame 0 (see :mod:`lcc_rl.data.ngsim_recordings`); several files may hold parts of one.
    Exact duplicate rows are dropped; of rows that disagree on one vehicle and frame the first is
    kept. A Preceding that is blank, negative or the vehicle itself counts as none. A space headway
    that is blank or zero is derived from the positions in the same frame.

    Args:
        path: file or files, plain or gzipped.
        location: keep only rows of this Location (such as ``i-80``), whatever its letter case.
        units: what the files are in: ``feet``, as published, or ``metres``.

    Raises:
        DataError: if a file is missing, damaged, of no known layout, or a needed cell is blank or
            not a valid number; it names the file, the line and the column. Or if the vehicles
            are too short or long for these units.
        ConfigError: if the units are unknown.
    """
    paths = [path] if isinstance(path, (str, Path)) else list(path)
    if not paths:
        raise DataError("no NGSIM file was named; expected at least one path")
    factor(units)
    rows = CollectedRows(ReadReport(files=[str(name) for name in paths]), units)
    wanted = None if location is None else location.strip().lower()
    for name in paths:
        for block in read_blocks(name):
            rows.add(block, wanted)
    if not rows.chunks:
        found = ", ".join(f"{name or 'blank'} ({n:,} rows)" for name, n in rows.locations.items())
        raise DataError(
            f"{', '.join(rows.report.files)}: no row has Location {location!r}; "
            f"the locations found are {found}"
        )
    samples = sorted_table(rows)
    check_units(samples, units, rows.report.files)
    return Trajectories(samples, rows.report)
