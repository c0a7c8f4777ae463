"""Row lookup by recording, vehicle and frame in sorted tables of millions of rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class Places:
    """One number per (recording, vehicle, frame), ascending in that order.

    Args:
        recording: recording code of every row.
        vehicle: vehicle id of every row, positive.
        frame: frame of every row, from 0.
    """

    def __init__(self, recording: NDArray, vehicle: NDArray, frame: NDArray) -> None:
        self.frames = int(frame.max()) + 1
        self.ids: NDArray | None = None
        self.vehicles = int(vehicle.max()) + 1
        if (int(recording.max()) + 1) * self.vehicles * self.frames >= 2**62:
            self.ids = np.unique(vehicle)  # ids too far apart to pack: use their ranks
            self.vehicles = len(self.ids)

    def keys(self, recording: NDArray, vehicle: NDArray, frame: NDArray) -> NDArray[np.int64]:
        """Keys of places; −1 for a vehicle or frame that no row has."""
        rank, known = vehicle, (vehicle > 0) & (vehicle < self.vehicles)
        if self.ids is not None:
            rank = np.minimum(np.searchsorted(self.ids, vehicle), len(self.ids) - 1)
            known = self.ids[rank] == vehicle
        known &= frame < self.frames
        key = (recording.astype(np.int64) * self.vehicles + rank) * self.frames + frame
        return np.where(known, key, -1)


def find(wanted: NDArray[np.int64], ascending: NDArray[np.int64]) -> NDArray[np.int64]:
    """Row of each wanted key among ascending keys; −1 where it is not there."""
    row = np.minimum(np.searchsorted(ascending, wanted), len(ascending) - 1)
    return np.where(ascending[row] == wanted, row, -1)


def find_leaders(
    recording: NDArray, vehicle: NDArray, frame: NDArray, preceding: NDArray
) -> NDArray[np.int64]:
    """Row of each row's preceding vehicle in the same frame.

    Args:
        recording, vehicle, frame: the rows, sorted by them.
        preceding: id of the vehicle ahead of every row; 0 where there is none.

    Returns:
        Row numbers; −1 where there is no vehicle ahead or it has no row in that frame.
    """
    places = Places(recording, vehicle, frame)
    return find(places.keys(recording, preceding, frame), places.keys(recording, vehicle, frame))
