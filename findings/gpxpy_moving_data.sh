#!/usr/bin/env bash
# gpxpy: top speed and standing time of a drive, from a track of 1 Hz (gpxpy 1.6.2).
# Guess before: the top speed a few percent low (extremes are left out), the times right.
# Seen: a minute at 25 m/s in a quarter of an hour of city is no speed at all: the top is 13 m/s.
# Seconds at one place are neither moving nor stopped: a quarter of the drive is missing.
# Hurt: who describes GPS drives by these before pricing idling and air drag.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        gpxpy==1.6.2 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import math
import sys
from datetime import UTC, datetime, timedelta

import gpxpy
from gpxpy.gpx import GPX, GPXTrack, GPXTrackPoint, GPXTrackSegment


def trip(top: int, seconds: int) -> list[int]:
    """Start, drive at a speed [m/s], brake and stand for 20 s."""
    up = list(range(top))
    return [*up, *[top] * seconds, *reversed(up), *[0] * 20]


speeds = trip(13, 40) * 5 + trip(25, 60) + trip(13, 40) * 5
segment, place = GPXTrackSegment(), 0.0
for second, (before, speed) in enumerate(zip([0, *speeds], speeds, strict=False)):
    place += (before + speed) / 2
    north, time = math.degrees(place / 6_378_137), datetime(2026, 1, 1, tzinfo=UTC)
    segment.points.append(GPXTrackPoint(46 + north, 7, time=time + timedelta(seconds=second)))
track = GPX()
track.tracks.append(GPXTrack())
track.tracks[0].segments.append(segment)
found = gpxpy.parse(track.to_xml()).get_moving_data()
print(f"driven: {len(speeds)} s, at most {max(speeds)} m/s, standing for {speeds.count(0)} s")
print(f"gpxpy: moving {found.moving_time:.0f} s, stopped {found.stopped_time:.0f} s,")
print(f"  at most {found.max_speed:.1f} m/s")
lost = found.stopped_time < 0.1 * speeds.count(0)
sys.exit(0 if lost and found.max_speed < 14 else 1)
EOF
