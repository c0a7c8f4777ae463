"""Writer of NGSIM files in the official 18-column layout."""

from __future__ import annotations

import gzip
import io
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv as pa_csv
from numpy.typing import NDArray

from lcc_rl.data.trajectories import FOOT
from lcc_rl.errors import DataError
from lcc_rl.io.atomic import atomic_path

# Columns of the samples beside the recording.
NUMBERS = ["vehicle", "frame", "position_m", "lane", "length_m", "vehicle_class"]
NUMBERS += ["speed_mps", "acceleration_mps2", "preceding"]
KEY = ["recording", "vehicle", "frame"]
AHEAD = ["recording", "preceding", "frame"]
# Start of recordings whose name holds no time, one hour apart.
FIRST_START_MS = int(datetime(2005, 4, 13, 23, tzinfo=UTC).timestamp() * 1000)
HOUR_MS = 3_600_000
LANE_WIDTH_FT = 12.0
VEHICLE_WIDTH_FT = 6.4
STANDING_HEADWAY = 9999.99  # the published files' time headway of a standing vehicle


def write_ngsim(samples: pd.DataFrame, path: str | Path) -> None:
    """Write samples in the official 18-column NGSIM CSV layout with header.

    Feet, ft/s and ft/s² have three decimals. ``Global_Time`` is the start of the recording plus
    100 ms a frame; the start is read from a name such as ``i-80@2005-04-13T22:58:55Z`` and
    otherwise a distinct hour per recording, so that vehicle ids may repeat between recordings.
    Local_X is a lane centre; Global_X and Global_Y are 0 and v_Width 6.4 ft, as fillers.

    Args:
        samples: rows with the columns of :class:`lcc_rl.data.trajectories.Trajectories`, in any
            order; ``segment`` and ``time_s`` are not needed, and ``space_headway_m`` is derived
            from the positions where the column is absent.
        path: destination; compressed where it ends in ``.gz``.

    Raises:
        DataError: if a column is missing, a value is not finite, a vehicle appears twice in a
            frame, or two recordings start within five seconds of each other.
        ResultsError: if the file cannot be written.
    """
    frame = _checked(samples, str(path))
    table = pa.table(_columns(frame, _start_times(frame, str(path))))
    text = io.BytesIO((",".join(table.column_names) + "\n").encode())
    text.seek(0, io.SEEK_END)
    # Arrow quotes the names of a header it writes itself; the published files do not.
    pa_csv.write_csv(table, text, pa_csv.WriteOptions(include_header=False, quoting_style="none"))
    content = text.getvalue()
    if str(path).endswith(".gz"):
        content = gzip.compress(content, compresslevel=5, mtime=0)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def _checked(samples: pd.DataFrame, path: str) -> pd.DataFrame:
    """Sorted copy of the samples, or a DataError."""
    missing = [name for name in ["recording", *NUMBERS] if name not in samples.columns]
    if missing:
        raise DataError(f"{path}: the samples to write lack the column(s) {', '.join(missing)}")
    if samples.empty:
        raise DataError(f"{path}: there are no samples to write")
    for name in NUMBERS:
        if not np.isfinite(samples[name].to_numpy(dtype=float)).all():
            raise DataError(f"{path}: column {name!r} of the samples to write is not all finite")
    # Plain text orders recordings the same whatever the categories' own order is.
    frame = samples.assign(recording=samples["recording"].astype(str))
    frame = frame.sort_values(KEY, ignore_index=True)
    if frame.duplicated(KEY).any():
        raise DataError(f"{path}: a vehicle to write appears twice in one frame")
    return frame


def _start_times(frame: pd.DataFrame, path: str) -> dict[str, int]:
    """Epoch of frame 0 of every recording [ms]."""
    starts: dict[str, int] = {}
    unnamed = 0
    for name in map(str, frame["recording"].unique()):
        start = start_in_name(name)
        starts[name] = FIRST_START_MS + unnamed * HOUR_MS if start is None else start
        unnamed += start is None
    ordered = sorted(starts.values())
    if any(later - earlier <= 5000 for earlier, later in pairwise(ordered)):
        raise DataError(
            f"{path}: two recordings start at the same time, and the 18-column layout holds "
            f"nothing else to distinguish them; write one file each. Recordings: "
            f"{', '.join(starts)}"
        )
    return starts


def start_in_name(name: str) -> int | None:
    """Epoch [ms] in a recording name such as ``i-80@2005-04-13T22:58:55Z``, if any."""
    try:
        start = datetime.fromisoformat(name.rpartition("@")[2].replace("Z", "+00:00"))
    except ValueError:
        return None
    if start.tzinfo is None:
        start = start.replace(tzinfo=UTC)
    return round(start.timestamp() * 1000)


def _columns(frame: pd.DataFrame, starts: dict[str, int]) -> dict[str, NDArray]:
    """The 18 official columns in their order."""
    headway = _space_headway(frame)
    speed = frame["speed_mps"].to_numpy(dtype=float)
    moving = headway / np.where(speed > 0, speed, 1.0)
    time_headway = np.where(headway > 0, np.where(speed > 0, moving, STANDING_HEADWAY), 0.0)
    frames = frame["frame"].to_numpy(dtype=np.int64)
    per_vehicle = frame.groupby(["recording", "vehicle"])["frame"].transform("size")
    zero = np.zeros(len(frame))
    return {
        "Vehicle_ID": frame["vehicle"].to_numpy(dtype=np.int64),
        "Frame_ID": frames,
        "Total_Frames": per_vehicle.to_numpy(),
        "Global_Time": frame["recording"].map(starts).to_numpy(dtype=np.int64) + 100 * frames,
        "Local_X": _printed((frame["lane"].to_numpy(dtype=float) - 0.5) * LANE_WIDTH_FT),
        "Local_Y": _feet(frame["position_m"]),
        "Global_X": zero,
        "Global_Y": zero,
        "v_Length": _feet(frame["length_m"]),
        "v_Width": zero + VEHICLE_WIDTH_FT,
        "v_Class": frame["vehicle_class"].to_numpy(dtype=np.int64),
        "v_Vel": _feet(frame["speed_mps"]),
        "v_Acc": _feet(frame["acceleration_mps2"]),
        "Lane_ID": frame["lane"].to_numpy(dtype=np.int64),
        "Preceding": frame["preceding"].to_numpy(dtype=np.int64),
        "Following": _following(frame),
        "Space_Headway": _printed(headway / FOOT),
        "Time_Headway": _printed(np.minimum(time_headway, STANDING_HEADWAY)),
    }


def _space_headway(frame: pd.DataFrame) -> NDArray:
    """Front-to-front distance to the vehicle ahead, 0 where there is none [m]."""
    if "space_headway_m" in frame.columns:
        given = frame["space_headway_m"].to_numpy(dtype=float)
    else:
        place = pd.MultiIndex.from_frame(frame[KEY])
        row = place.get_indexer(pd.MultiIndex.from_frame(frame[AHEAD]))
        position = frame["position_m"].to_numpy(dtype=float)
        given = np.where(row >= 0, position[row] - position, 0.0)
    return np.where(np.isfinite(given) & (frame["preceding"].to_numpy() > 0), given, 0.0)


def _following(frame: pd.DataFrame) -> NDArray:
    """Id of the vehicle behind in the same frame, 0 where there is none."""
    behind = frame.loc[frame["preceding"] > 0, [*AHEAD, "vehicle"]].drop_duplicates(AHEAD)
    place = pd.MultiIndex.from_frame(frame[KEY])
    row = pd.MultiIndex.from_frame(behind[AHEAD]).get_indexer(place)
    followers = np.append(behind["vehicle"].to_numpy(dtype=np.int64), 0)  # row −1 is the last: 0
    return followers[row]


def _feet(values: pd.Series) -> NDArray:
    return _printed(values.to_numpy(dtype=float) / FOOT)


def _printed(values: NDArray) -> NDArray:
    """Values with three decimals; adding 0 removes negative zeros."""
    return np.round(values, 3) + 0.0
