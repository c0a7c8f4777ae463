"""Files as people have them: what their reader says of them."""

from __future__ import annotations

import re
from pathlib import Path

from lcc_rl.data.leaders import DriveLeaders
from lcc_rl.data.sources import EpisodesSource
from lcc_rl.errors import LccError

CASES = Path(__file__).parent / "cases"
GERMAN = {"time": "Zeit [s]", "follower_speed": "Geschw. Prüfling [m/s]"}
GERMAN |= {"leader_speed": "Geschw. Führung [m/s]", "gap": "Lücke [m]"}
LATE = r"'leader_speed_mps': leader {} s late; are clocks apart\?; {} of 3 pairs"
ONE = r"slope of gaps over speeds 1\.0\d, lag 0\.\d s of 1 pair"
# File, settings of its reader, whether it is read, and what is said of it.
PAIRS = [
    ("exchanged_pair_90s.csv", {}, False, "data row 1, .*are leader and follower exchanged"),
    ("one_of_two_exchanged.csv", {}, False, "episode 0, .*are leader and .* exchanged.*1 of 2 p"),
    ("one_of_21_exchanged.csv", {}, False, "episode 0, .*are leader and .* exchanged.*1 of 21 p"),
    ("gap_feet_90s.csv", {}, False, r"is the gap in ft \(data\.units\.gap=ft\)\?"),
    ("gap_feet_90s.csv", {"units": {"gap": "ft"}}, True, ONE),
    ("speeds_mph_90s.csv", {}, False, r"are both speeds in mph \(data\.units\.follower_speed=mph"),
    ("leader_2s_late_one_of_three.csv", {}, False, "episode 0, .*" + LATE.format("2.0", 1)),
    ("leader_half_second_late_all.csv", {}, True, LATE.format("0.[56]", 3)),
    ("one_early_sample.csv", {}, True, r"0\.1 s apart, 2 of them irregular, were interpolated"),
    ("irregular_steps.csv", {}, True, r"0\.2 s apart, 239 of them irregular, were interpolated"),
    ("iso_time.csv", {}, True, ONE),
    ("iso_time.csv", {"units": {"time": "iso"}}, True, ONE),
    ("unix_nanoseconds.csv", {"units": {"time": "ns"}}, True, ONE),
    (
        "frames_10_per_second.csv",
        {"columns": {"time": "frame"}, "units": {"time": "frames/10"}},
        True,
        ONE,
    ),
    ("latin1.csv", {"columns": GERMAN}, True, "is not UTF-8 and was read as Latin-1"),
    ("utf16.csv", {"columns": GERMAN}, True, "is not UTF-8 and was read as UTF-16"),
]
DRIVES = {"columns": {"time": "time", "speed": "speed"}}
RECORD = {"columns": {"drive": None, "time": "time", "speed": "speed"}, "evaluation_share": 1.0}
MILES = {**RECORD, "columns": {**RECORD["columns"], "speed": "Target Speed, mph"}}
LEADERS = [
    ("cycle_mph.csv", MILES, False, "read in m/s; set leader.units.speed=mph"),
    (
        "cycle_mph.csv",
        {**MILES, "units": {"speed": "mph"}},
        True,
        r"cycle_mph: 1,369 s, speed 8\.7\d m/s, at most 25\.3 m/s",
    ),
    ("trailing_comma.csv", RECORD, True, "trailing_comma: 299 s, speed 12.7 m/s, at most 25.3"),
    ("no_header.csv", RECORD, False, "it has 0, 0.000: is the header missing"),
    ("folder_of_trips", DRIVES, True, "1 of 3 .* for evaluation, .*: trip_0"),
    ("folder_of_trips/*.csv", DRIVES, True, "trip_2: 299 s, speed 6.61 m/s, at most 16.2 m/s"),
    ("folder_of_trips", RECORD, False, "3 files; leader=record drives one, see leader=dri"),
]


def check_cases(cases, read) -> None:
    """Check what a reader reports of each file, or why it refuses it."""
    for file, settings, reads, words in cases:
        try:
            said, done = " ".join(read(str(CASES / file), settings).report), True
        except LccError as error:
            said, done = str(error), False
        assert done == reads, f"{file}: {said}"
        assert re.search(words, said), f"{file}: {said}"


def test_pairs() -> None:
    check_cases(PAIRS, lambda path, settings: EpisodesSource(path=path, **settings).load())


def test_leaders() -> None:
    check_cases(LEADERS, lambda path, settings: DriveLeaders(path=path, **settings).load(0.1, 40))
