"""Rows of NGSIM files as compact columns in SI units, collected block by block."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lcc_rl.data.ngsim_blocks import Block
from lcc_rl.data.ngsim_recordings import Group
from lcc_rl.data.trajectories import ReadReport
from lcc_rl.data.units import factor
from lcc_rl.errors import DataError

LARGEST_ID = 2**53  # beyond this, whole numbers no longer fit a float
INT32, INT16, INT8 = 2**31 - 1, 2**15 - 1, 2**7 - 1
OTHER_LOCATION = "other location"
COLUMN_OF = {
    "v_Length": "length_m",
    "v_Class": "vehicle_class",
    "v_Vel": "speed_mps",
    "v_Acc": "acceleration_mps2",
    "Lane_ID": "lane",
    "Preceding": "preceding",
    "Space_Headway": "space_headway_m",
}

Columns = dict[str, NDArray]


@dataclass
class CollectedRows:
    """Rows read so far.

    Args:
        report: counts, updated with every block.
        units: what lengths, speeds and accelerations are in: ``feet`` or ``metres``.
        chunks: the columns of each block; ``group`` is an index into ``groups``.
        groups: index of every (file, location, time of frame 0).
        rows_of: rows of each group.
        locations: rows of each location met.
        filled: whether a column held anything but blanks and zeros.
        blank_classes: rows without a vehicle class.
    """

    report: ReadReport
    units: str = "feet"
    chunks: list[Columns] = field(default_factory=list)
    groups: dict[Group, int] = field(default_factory=dict)
    rows_of: list[int] = field(default_factory=list)
    locations: dict[str, int] = field(default_factory=dict)
    filled: dict[str, bool] = field(default_factory=dict)
    blank_classes: int = 0

    def add(self, block: Block, wanted: str | None) -> None:
        """Add the rows of a block; with ``wanted``, those of that location only."""
        self.report.rows_read += block.rows_read
        names, places = [""], np.zeros(len(block), dtype=np.int64)
        if block.has("Location"):
            names, places = block.locations()
            for place, rows in enumerate(np.bincount(places, minlength=len(names))):
                if rows:
                    self.locations[names[place]] = self.locations.get(names[place], 0) + int(rows)
        if wanted is not None:
            places = self._filter(block, wanted, names, places)
        if len(block):
            self.chunks.append(self._columns(block, names, places))

    def _filter(
        self, block: Block, wanted: str, names: list[str], places: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        if not block.has("Location"):
            raise DataError(
                f"{block.path}: has no column 'Location' to look for {wanted!r} in; leave the "
                "location unset"
            )
        mask = np.array([name == wanted for name in names])[places]
        dropped = len(mask) - int(mask.sum())
        if dropped:
            reasons = self.report.dropped
            reasons[OTHER_LOCATION] = reasons.get(OTHER_LOCATION, 0) + dropped
            block.keep(mask)
        return places[mask]

    def _columns(self, block: Block, names: list[str], places: NDArray[np.int64]) -> Columns:
        """The needed columns of a block, in SI and compact types."""
        frame = block.integers("Frame_ID", 0, INT32)
        vehicle = block.integers("Vehicle_ID", 1, LARGEST_ID)
        preceding = block.integers("Preceding", -LARGEST_ID, LARGEST_ID, blank=0)
        preceding[(preceding < 0) | (preceding == vehicle)] = 0
        kinds = block.integers("v_Class", -1, INT8, blank=-1)
        self.blank_classes += int((kinds < 0).sum())
        headway = np.zeros(len(block), dtype=np.float32)
        if block.has("Space_Headway"):
            headway = self._metres(block, "Space_Headway", blank=0.0)
        columns: Columns = {
            "group": self._groups(block, frame, names, places),
            "vehicle": vehicle,
            "frame": frame.astype(np.int32),
            "position_m": self._metres(block, "Local_Y"),
            "lane": block.integers("Lane_ID", -INT16, INT16).astype(np.int16),
            "length_m": self._metres(block, "v_Length"),
            "vehicle_class": np.maximum(kinds, 0).astype(np.int8),
            "speed_mps": self._metres(block, "v_Vel", "/s"),
            "acceleration_mps2": self._metres(block, "v_Acc", "/s²"),
            "preceding": preceding,
            "space_headway_m": headway,
        }
        for official, own in COLUMN_OF.items():
            self._note_filled(official, columns[own])
        return columns

    def _groups(
        self, block: Block, frame: NDArray[np.int64], names: list[str], places: NDArray[np.int64]
    ) -> NDArray[np.int32]:
        """Index of each row's (file, location, time of frame 0)."""
        clock = np.zeros(len(block))
        if block.has("Global_Time"):
            clock = block.numbers("Global_Time", "milliseconds", blank=0.0)
        self._note_filled("Global_Time", clock)
        distinct, which = np.unique(_frame_zero(clock, frame), return_inverse=True)
        pairs, inverse = np.unique(which * len(names) + places, return_inverse=True)
        codes = []
        for pair, rows in zip(pairs, np.bincount(inverse), strict=True):
            start, place = divmod(int(pair), len(names))
            group = Group(block.path, names[place], int(distinct[start]))
            codes.append(self.groups.setdefault(group, len(self.groups)))
            if codes[-1] == len(self.rows_of):
                self.rows_of.append(0)
            self.rows_of[codes[-1]] += int(rows)
        return np.array(codes, dtype=np.int32)[inverse]

    def _metres(
        self, block: Block, name: str, per: str = "", blank: float | None = None
    ) -> NDArray[np.float32]:
        """A column in SI; numbers too large to be real would overflow to infinity."""
        unit = f"{self.units}{per}"
        values = block.numbers(name, unit, blank)
        large = np.abs(values) > 1e9
        if large.any():
            block.fail(int(np.argmax(large)), name, f"{unit}, at most 1e9 in size")
        return (values * factor(self.units)).astype(np.float32)

    def _note_filled(self, name: str, values: NDArray) -> None:
        self.filled[name] = self.filled.get(name, False) or bool(values.any())


def _frame_zero(clock: NDArray[np.float64], frame: NDArray[np.int64]) -> NDArray[np.int64]:
    """Time of frame 0 by each row's clock [ms]; 0 where the clock cannot be an epoch."""
    plausible = (clock >= 1e8) & (clock < 1e14)
    starts = np.rint(np.where(plausible, clock, 0.0)).astype(np.int64) - 100 * frame
    return np.where(plausible & (starts > 0), starts, 0)
