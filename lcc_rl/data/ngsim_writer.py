"""Writer of NGSIM files in the official 18-column layout."""

from __future__ import annotations

import gzip
import io
from datetime import datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv as pa_csv
from numpy.typing import NDArray

from lcc_rl.data.trajectories import FOOT
from lcc_rl.io.atomic import atomic_path

KEY = ["recording", "vehicle", "frame"]
AHEAD = ["recording", "preceding", "frame"]
LANE_WIDTH_FT = 12.0
VEHICLE_WIDTH_FT = 6.4
STANDING_HEADWAY = 9999.99  # the published files' time headway of a standing vehicle


def write_ngsim(samples: pd.DataFrame, path: str | Path) -> None:
    """Write samples in the official 18-column NGSIM CSV layout with header.

    Feet, ft/s and ft/s² have three decimals. ``Global_Time`` is the start of the recording plus
    100 ms a frame. Local_X is a lane centre; Global_X and Global_Y are 0 and v_Width 6.4 ft, as
    fillers. Headways are those of the positions.

    Args:
        samples: rows with the columns of :class:`lcc_rl.data.trajectories.Trajectories` but
            ``segment``, ``time_s`` and ``space_headway_m``, in any order, each vehicle once in a
            frame; recordings are named after their start, such as ``2005-04-13T22:58:55Z``.
        path: destination; compressed where it ends in ``.gz``.

    Raises:
        ResultsError: if the file cannot be written.
    """
    table = pa.table(official_columns(samples))
    text = io.BytesIO((",".join(table.column_names) + "\n").encode())
    text.seek(0, io.SEEK_END)
    # Arrow quotes the names of a header it writes itself; the published files do not.
    pa_csv.write_csv(table, text, pa_csv.WriteOptions(include_header=False, quoting_style="none"))
    content = text.getvalue()
    if str(path).endswith(".gz"):
        content = gzip.compress(content, compresslevel=5, mtime=0)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def official_columns(samples: pd.DataFrame) -> dict[str, NDArray]:
    """Return the 18 official columns of samples in their order, see :func:`write_ngsim`."""
    # Plain text orders recordings the same whatever the categories' own order is.
    frame = samples.astype({"recording": str}).sort_values(KEY, ignore_index=True)
    names = frame["recording"].unique()
    start = {name: round(datetime.fromisoformat(name).timestamp() * 1000) for name in names}
    clock = frame["recording"].map(start) + 100 * frame["frame"]
    place = pd.MultiIndex.from_frame(frame[KEY])
    row = place.get_indexer(pd.MultiIndex.from_frame(frame[AHEAD]))
    position, speed, lane = (
        frame[name].to_numpy(dtype=float) for name in ("position_m", "speed_mps", "lane")
    )
    headway = np.where(row >= 0, position[row] - position, 0.0)
    moving = headway / np.where(speed > 0, speed, 1.0)
    time_headway = np.where(headway > 0, np.where(speed > 0, moving, STANDING_HEADWAY), 0.0)
    behind = frame.loc[row >= 0, "vehicle"].to_numpy(dtype=np.int64)
    following = np.zeros(len(frame), dtype=np.int64)
    following[row[row >= 0]] = behind
    zero = np.zeros(len(frame))
    columns = {
        "Vehicle_ID": frame["vehicle"],
        "Frame_ID": frame["frame"],
        "Total_Frames": frame.groupby(["recording", "vehicle"])["frame"].transform("size"),
        "Global_Time": clock,
        "Local_X": _printed((lane - 0.5) * LANE_WIDTH_FT),
        "Local_Y": _printed(position / FOOT),
        "Global_X": zero,
        "Global_Y": zero,
        "v_Length": _printed(frame["length_m"].to_numpy(dtype=float) / FOOT),
        "v_Width": zero + VEHICLE_WIDTH_FT,
        "v_Class": frame["vehicle_class"],
        "v_Vel": _printed(speed / FOOT),
        "v_Acc": _printed(frame["acceleration_mps2"].to_numpy(dtype=float) / FOOT),
        "Lane_ID": frame["lane"],
        "Preceding": frame["preceding"],
        "Following": following,
        "Space_Headway": _printed(headway / FOOT),
        "Time_Headway": _printed(np.minimum(time_headway, STANDING_HEADWAY)),
    }
    return {name: np.asarray(values) for name, values in columns.items()}


def _printed(values: NDArray) -> NDArray:
    """Values with three decimals; adding 0 removes negative zeros."""
    return np.round(values, 3) + 0.0
