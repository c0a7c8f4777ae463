"""Vehicle trajectories in SI units and the report on reading them."""

from __future__ import annotations

from dataclasses import dataclass, field

import pandas as pd


@dataclass
class ReadReport:
    """Counts of what was read and dropped; every dropped row is counted.

    Args:
        files: the files, in the order they were read.
        rows_read: rows in the files; equals ``rows_kept`` plus every ``dropped``.
        rows_kept: rows in the result.
        dropped: rows dropped, by reason.
        recordings: rows kept, by recording.
        vehicles: vehicles, counted per recording.
        segments: stretches without a missing frame.
        headways_given: space headways taken from the file.
        headways_derived: space headways derived from Preceding and Local_Y.
        headways_unknown: rows that name a preceding vehicle which has no row in that frame,
            and give no headway.
        empty_columns: columns that are absent, blank or zero throughout.
        notes: further remarks, one a line.
    """

    files: list[str] = field(default_factory=list)
    rows_read: int = 0
    rows_kept: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    recordings: dict[str, int] = field(default_factory=dict)
    vehicles: int = 0
    segments: int = 0
    headways_given: int = 0
    headways_derived: int = 0
    headways_unknown: int = 0
    empty_columns: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def lines(self) -> list[str]:
        """The report as plain lines."""
        recordings = ", ".join(f"{name} ({rows:,} rows)" for name, rows in self.recordings.items())
        return [
            f"read {self.rows_read:,} rows from {', '.join(self.files)}; kept {self.rows_kept:,}",
            *(f"dropped {count:,} rows: {reason}" for reason, count in self.dropped.items()),
            f"{len(self.recordings)} recording(s): {recordings}",
            f"{self.vehicles:,} vehicles; missing frames cut their trajectories "
            f"{self.segments - self.vehicles:,} times, into {self.segments:,} segments",
            f"space headways: {self.headways_given:,} given, {self.headways_derived:,} derived "
            f"from positions, {self.headways_unknown:,} unknown (preceding vehicle not seen)",
            *self.notes,
        ]


@dataclass
class Trajectories:
    """Trajectories of any layout, in one shape.

    Args:
        samples: one row per vehicle and frame, sorted by recording, vehicle and frame: recording
            (category), vehicle (int64), frame (int32), segment (int32, distinct throughout the
            table, a stretch without a missing frame), time_s (0.1·frame), position_m (front
            bumper, Local_Y), lane (int16), length_m, vehicle_class (int8; 1 motorcycle, 2 car,
            3 truck, 0 unknown), speed_mps, acceleration_mps2, preceding (int64; 0 none) and
            space_headway_m (front to front; NaN where there is none).
        report: what was read and what was dropped.
    """

    samples: pd.DataFrame
    report: ReadReport
