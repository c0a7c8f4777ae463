"""Identification of the recordings of NGSIM rows, because vehicle ids are reused.

Within a recording the clock advances by 100 ms a frame, so Global_Time − 100·Frame_ID, the time of
frame 0, is constant. It differs between recordings by minutes. Published clocks have errors; those
of one file and location are processed in three steps:

1. A clock that is blank, zero or not a plausible epoch is unusable. The site Peachtree publishes
   its epoch in seconds (and 100 a frame), which is usable.
2. Times of frame 0 within ``JITTER`` of the next one form a cluster, so that jitter, truncation and
   rounding do not split a recording.
3. Clusters that spread over more than ``CLUSTER_SPREAD``, such as a constant clock, are unusable.

Rows with a usable clock are identified by location and time, over all files. Rows without one
belong to the recording of their file and location if there is exactly one; otherwise they form a
recording per file and location.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import NamedTuple

from lcc_rl.data.text import stem

JITTER = 5_000  # ms; recordings of one site start at least 11,700 clock units apart
CLUSTER_SPREAD = 300_000  # ms; periods last 15 min, and a float32 clock is off by up to 66 s
SECONDS_BELOW = 10**11  # a smaller epoch is in seconds; in ms it would be in 1973


class Group(NamedTuple):
    """Rows of one file and location with the same time of frame 0.

    Args:
        file: path of the file.
        location: Location in lower case, '' if there is none.
        start: Global_Time − 100·Frame_ID as published; 0 if the clock is unusable.
    """

    file: str
    location: str
    start: int


def name_recordings(rows: Counter[Group]) -> tuple[dict[Group, str], list[str]]:
    """Name the recording of every group.

    Args:
        rows: number of rows of each group.

    Returns:
        The name of each group, such as ``i-80@2005-04-13T22:58:55Z`` (UTC, the most frequent time
        of frame 0) or, without a usable clock, ``<file stem>#1``; and notes for the report.
    """
    by_place: dict[tuple[str, str], list[Group]] = defaultdict(list)
    by_location: dict[str, list[Group]] = defaultdict(list)
    for group in rows:
        if group.start > 0:
            by_place[group[:2]].append(group)
    for (_, location), groups in by_place.items():
        for cluster in _clusters(groups):
            if cluster[-1].start - cluster[0].start <= CLUSTER_SPREAD:
                by_location[location] += cluster
    named: dict[Group, str] = {}
    for location, groups in by_location.items():
        for cluster in _clusters(groups):
            counts: Counter[int] = Counter()
            for group in cluster:
                counts[group.start] += rows[group]
            start = min(counts, key=lambda start: (-counts[start], start))
            seconds = start if start < SECONDS_BELOW else start // 1000
            time = f"{datetime.fromtimestamp(seconds, tz=UTC):%Y-%m-%dT%H:%M:%SZ}"
            named.update(dict.fromkeys(cluster, f"{location}@{time}" if location else time))
    return named, _name_by_file(named, rows)


def _clusters(groups: Iterable[Group]) -> list[list[Group]]:
    """Return groups sorted by start, divided where the next one is more than JITTER away."""
    clusters: list[list[Group]] = []
    for group in sorted(groups, key=lambda group: group.start):
        if clusters and group.start - clusters[-1][-1].start <= JITTER:
            clusters[-1].append(group)
        else:
            clusters.append([group])
    return clusters


def _name_by_file(named: dict[Group, str], rows: Counter[Group]) -> list[str]:
    """Name the groups with an unusable clock, in place; return notes."""
    recordings: dict[tuple[str, str], set[str]] = defaultdict(set)
    for group, name in named.items():
        recordings[group[:2]].add(name)
    unclocked: Counter[tuple[str, str]] = Counter()
    assigned: dict[tuple[str, str], str] = {}
    for group in sorted(rows.keys() - named.keys()):
        source = group[:2]
        unclocked[source] += rows[group]
        if source not in assigned:
            alone = len(recordings[source]) == 1
            assigned[source] = min(recordings[source]) if alone else _file_name(source[0], assigned)
        named[group] = assigned[source]
    return [
        f"Global_Time does not identify the recording of {count:,} rows of {file}"
        f"{f' at {location}' if location else ''}: read as {assigned[file, location]}"
        for (file, location), count in unclocked.items()
    ]


def _file_name(file: str, assigned: dict[tuple[str, str], str]) -> str:
    """Return ``<stem>#k`` with the smallest free k."""
    number = 1
    while (name := f"{stem(file)}#{number}") in assigned.values():
        number += 1
    return name
