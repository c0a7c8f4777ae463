"""Files as people have them: what each command says of them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from commands import HORIZON, QUICK, run_command

CASES = Path(__file__).parent / "cases"
GERMAN = (
    "data.columns={time: 'Zeit [s]', follower_speed: 'Geschw. Prüfling [m/s]', "
    "leader_speed: 'Geschw. Führung [m/s]', gap: 'Lücke [m]'}"
)
TRIPS = ("leader.columns={time: time, speed: speed}",)
LATE = r"'leader_speed_mps': leader {} s late; are clocks apart\?; {} of 3 pairs"
ONE = r"slope of gaps over speeds 1\.0\d, lag 0\.\d s of 1 pair"
# File, further settings, whether it is read, and what is said of it.
PAIRS = [
    ("exchanged_pair_90s.csv", (), False, "data row 1, .*are leader and follower exchanged"),
    ("one_of_two_exchanged.csv", (), False, "episode 0, .*are leader and .* exchanged.*1 of 2 p"),
    ("one_of_21_exchanged.csv", (), False, "episode 0, .*are leader and .* exchanged.*1 of 21 p"),
    ("gap_feet_90s.csv", (), False, r"is the gap in ft \(data\.units\.gap=ft\)\?"),
    ("gap_feet_90s.csv", ("data.units={gap: ft}",), True, ONE),
    ("speeds_mph_90s.csv", (), False, r"are both speeds in mph \(data\.units\.follower_speed=mph"),
    ("leader_2s_late_one_of_three.csv", (), False, "episode 0, .*" + LATE.format("2.0", 1)),
    ("leader_2s_late_one_of_three.csv", ("data.plausible.max_lag=3",), True, r"leader 2\.0 s late"),
    ("leader_half_second_late_all.csv", (), True, LATE.format("0.[56]", 3)),
    ("one_early_sample.csv", (), True, r"0\.1 s apart, 2 of them irregular, were interpolated"),
    ("irregular_steps.csv", (), True, r"0\.2 s apart, 239 of them irregular, were interpolated"),
    ("iso_time.csv", (), True, ONE),
    ("iso_time.csv", ("data.units={time: iso}",), True, ONE),
    ("unix_nanoseconds.csv", ("data.units={time: ns}",), True, ONE),
    (
        "frames_10_per_second.csv",
        ("data.columns={time: frame}", "data.units={time: frames/10}"),
        True,
        ONE,
    ),
    ("latin1.csv", (GERMAN,), True, "is not UTF-8 and was read as Latin-1"),
    ("utf16.csv", (GERMAN,), True, "is not UTF-8 and was read as UTF-16"),
]
RECORD = ("leader=record", "leader.evaluation_share=1")
DRIVES = ("leader=drives", "leader.columns={time: time, speed: speed}")
LEADERS = [
    (
        "cycle_mph.csv",
        (*RECORD, "leader.columns={time: time, speed: 'Target Speed, mph'}"),
        False,
        "'Target Speed, mph' says mph, and it is read in m/s; set leader.units.speed=mph",
    ),
    (
        "cycle_mph.csv",
        (
            *RECORD,
            "leader.columns={time: time, speed: 'Target Speed, mph'}",
            "leader.units.speed=mph",
        ),
        True,
        r"cycle_mph: 1,369 s, speed 8\.7\d m/s, at most 25\.3 m/s",
    ),
    (
        "trailing_comma.csv",
        (*RECORD, "leader.columns={time: time, speed: speed}"),
        True,
        "trailing_comma: 299 s, speed 12.7 m/s, at most 25.3",
    ),
    ("no_header.csv", RECORD, False, "it has 0, 0.000: is the header missing"),
    ("folder_of_trips", DRIVES, True, "1 of 3 .* for evaluation, .*: trip_0"),
    ("folder_of_trips/*.csv", DRIVES, True, "trip_2: 299 s, speed 6.61 m/s, at most 16.2 m/s"),
    (
        "folder_of_trips",
        ("leader=record",),
        False,
        "3 files; leader=record drives one, see leader=dri",
    ),
]


def names(rows: list[tuple]) -> list[str]:
    return [f"{row[0]}-{number}" for number, row in enumerate(rows)]


def said(command: str, words: tuple[str, ...], reads: bool, tmp_path: Path) -> str:
    """What a command says in one line, after the outcome that is expected."""
    done = run_command(f"lcc_rl.cli.{command}", *words, cwd=tmp_path)
    text = re.sub(r"\s+", " ", done.stdout + done.stderr)
    assert (done.returncode == 0) == reads, text
    assert reads or done.stderr.count("\n") == 1
    return text


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize(("file", "settings", "reads", "words"), PAIRS, ids=names(PAIRS))
def test_pairs(tmp_path: Path, file: str, settings, reads: bool, words: str) -> None:
    path = f"data.path='{CASES / file}'"
    quick = (
        "calibration.local_genetic.population=8",
        QUICK,
        "calibration.local_genetic.founders=1",
    )
    command = ("data=episodes", path, *settings, "calibration=local", *quick)
    assert re.search(words, said("calibrate", command, reads, tmp_path))


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize(("file", "settings", "reads", "words"), LEADERS, ids=names(LEADERS))
def test_leaders(tmp_path: Path, file: str, settings, reads: bool, words: str) -> None:
    small = ("variant=alcc", "agent=none", "scenario.string=human", "drivers=fixed")
    small += ("experiment=smoke", "evaluation.baselines=[]", "evaluation.profiles=1", HORIZON)
    words_of = (*small, *settings, f"leader.path='{CASES / file}'")
    assert re.search(words, said("evaluate", words_of, reads, tmp_path))
