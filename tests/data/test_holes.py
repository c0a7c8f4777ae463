"""Holes and dropouts of a log at 50 Hz: what is interpolated, and what divides a record."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from table_text import openacc_text, written

from lcc_rl.data.leaders import DriveLeaders
from lcc_rl.data.openacc import OpenAccSource
from lcc_rl.data.sources import EpisodesSource, LoadedEpisodes
from lcc_rl.data.table_source import TableSource
from lcc_rl.errors import ConfigError

ROWS, STEP = 45_000, 0.02
NAMES = {"time": "t", "follower_speed": "v", "gap": "range", "relative_speed": "rate"}
TARGET = {**NAMES, "target": "id", "valid": "ok"}
CARS = {"vehicle": "car", "time": "t", "speed": "v", "leader": "ahead", "gap": "range"}
SIGNALS = ("follower_speed_mps", "leader_speed_mps", "gap_m")


def truth(time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Speeds of the car and of its leader [m/s], and the gap, whose rate they are [m]."""
    own, ahead = 15.0 + 2.0 * np.sin(time / 3.0), 15.0 + 3.0 * np.sin(time / 4.0)
    return own, ahead, 40.0 - 12.0 * np.cos(time / 4.0) + 6.0 * np.cos(time / 3.0)


def log(rows: int = ROWS) -> pd.DataFrame:
    time = (STEP * np.arange(rows)).round(2)
    own, ahead, gap = truth(time)
    frame = pd.DataFrame({"t": time, "v": own, "range": gap, "rate": ahead - own})
    return frame.assign(id=7, ok=1)


def cars(frame: pd.DataFrame) -> pd.DataFrame:
    """A row per vehicle and time: car 2 with the rows of a log, and all rows of its leader."""
    whole = log(len(frame))
    own = frame.assign(car=2, ahead=1)
    return pd.concat([whole.assign(car=1, ahead=0, range=np.nan, v=truth(whole["t"])[1]), own])


def check(loaded: LoadedEpisodes, parts: int, words: Iterable[str] = (), bound=0.002) -> None:
    """Check number of parts, report, and that no signal is off its true value by more."""
    table, report = loaded.episodes, "\n".join(loaded.report)
    assert table["episode"].nunique() == parts, report
    for text in words:
        assert text in report
    for name, expected in zip(SIGNALS, truth(table["time_s"].to_numpy()), strict=True):
        assert np.abs(table[name] - expected).max() < bound, name


@pytest.fixture
def read(tmp_path):
    def load(frame: pd.DataFrame, columns=NAMES, **settings: object) -> LoadedEpisodes:
        kind = TableSource if "vehicle" in columns else EpisodesSource
        path = written(tmp_path, frame, "log.parquet")
        return kind(path=path, columns=columns, **settings).load()

    return load


def test_single_rows_are_missing(read) -> None:
    missing = np.random.default_rng(0).choice(np.arange(10, ROWS, 20), 100, replace=False)
    words = ["100 holes up to data.bridge_s=0.1 are interpolated"]
    check(read(log().drop(index=missing)), 1, words)
    check(read(cars(log()).reset_index(drop=True).drop(index=ROWS + missing), CARS), 1, words)
    divided = "100 holes longer than data.bridge_s=0 divide 1 episodes into 101; data.bridge_s=0.1"
    check(read(log().drop(index=missing), bridge_s=0.0), 101, [divided])


def test_a_tenth_of_the_rows_is_missing(read) -> None:
    kept = np.random.default_rng(0).random(ROWS) > 0.1
    loaded = read(log()[kept])
    check(loaded, 1)
    found, time = loaded.episodes, log()["t"][kept]
    measured = np.isin((found["time_s"] / STEP).round(), (time / STEP).round())
    assert 0.89 < measured.mean() < 0.91
    for name, expected in zip(SIGNALS, truth(found["time_s"].to_numpy()), strict=True):
        np.testing.assert_allclose(found[name][measured], expected[measured], rtol=3e-5)


def test_longer_holes_divide_unless_the_setting_is_longer(read) -> None:
    frame = log()[~log()["t"].between(400.01, 400.39)]  # 0.4 s
    words = "1 holes longer than data.bridge_s=0.1 divide 1 episodes into 2"
    check(read(frame), 2, [words])
    words = "1 holes up to data.bridge_s=0.5 are interpolated"
    check(read(frame, bridge_s=0.5), 1, [words], 0.02)
    with pytest.raises(ConfigError, match="bridge_s must be"):
        read(frame, bridge_s=-0.1)


def test_irregular_steps_have_no_fixed_hole(read) -> None:
    frame = log()[np.random.default_rng(0).random(ROWS) > 0.15]
    frame = frame[~frame["t"].between(400.0, 401.5)]
    check(read(frame), 2, ["1 holes longer than data.bridge_s=0.1 divide 1 episodes into 2"])


def test_drives_and_their_setting(tmp_path) -> None:
    frame = log(5000).drop(index=[*range(100, 4000, 100), *range(2000, 2020)])
    path = written(tmp_path, frame, "drive.parquet")
    settings = {"path": path, "columns": {"time": "t", "speed": "v"}, "evaluation_share": 1.0}
    for bridge, records in ((0.1, 2), (0.5, 1)):
        found = DriveLeaders(**settings, bridge_s=bridge).load(0.1, 300)
        assert f"{records} speed record(s)" in found.report[0]
        assert any(f"leader.bridge_s={bridge:g}" in line for line in found.report)


def lost(frame: pd.DataFrame, **values: object) -> pd.DataFrame:
    """Set signals from 400.02 to 400.3 s."""
    frame = frame.astype(dict.fromkeys(values, float))
    for name, value in values.items():
        frame.loc[frame["t"].between(400.01, 400.31), name] = value
    return frame


def test_dropouts_of_one_target_are_holes(read) -> None:
    nothing = {"range": np.nan, "rate": np.nan}
    for values in ({"ok": 0}, {"id": 0}, nothing, {**nothing, "ok": 0, "id": np.nan}):
        frame = lost(log(), **values)
        check(read(frame, TARGET), 2, ["1 holes longer than data.bridge_s=0.1"])
        check(read(frame, TARGET, bridge_s=0.4), 1, ["1 holes up to data.bridge_s=0.4"], 0.02)


def test_no_bridge_spans_another_target(read) -> None:
    other = log()
    other.loc[20_005, "id"] = 9  # one row of 20 ms within the dropout
    words = ["1 holes longer than data.bridge_s=2 or with another target divide"]
    for frame in (lost(other, ok=0), lost(log(), id=9, ok=0)):
        frame = frame.sample(frac=1.0, random_state=0)  # in any order
        check(read(frame, TARGET, bridge_s=2.0), 2, words)
    check(read(lost(log(), id=9), TARGET, bridge_s=2.0), 3, words)
    changed = lost(log(), ok=0)
    changed.loc[changed["t"] > 400.2, "id"] = 9
    check(read(changed, TARGET, bridge_s=2.0), 2)
    jump = lost(log(), ok=0)  # without a column of targets, the gap shows it
    jump.loc[jump["t"] > 400.2, "range"] += 12.0
    jump.loc[jump["t"].between(399.5, 400.9), "ok"] = 0
    report = read(jump, {**NAMES, "valid": "ok"}, bridge_s=2.0).report
    assert any("where the gap jumps" in line for line in report)


def test_dropouts_of_leaders_in_trajectories(read) -> None:
    words = "15 samples without a leader, within data.bridge_s=0.4 between two behind the same one"
    for values in ({"range": np.nan}, {"ahead": 0}, {"ahead": 0, "range": np.nan}):
        frame = cars(log())
        frame = frame[frame["car"] == 1], lost(frame[frame["car"] == 2], **values)
        frame = pd.concat(frame).astype({"ahead": int})
        check(read(frame, CARS), 2)
        check(read(frame, CARS, bridge_s=0.4), 1, [words], 0.02)
        frame.loc[(frame["car"] == 2) & (frame["t"] == 400.1), "ahead"] = 9
        check(read(frame, CARS, bridge_s=0.4), 2)


def test_dropouts_and_other_drivers_in_openacc(tmp_path) -> None:
    head, text = openacc_text(cars=2, blank={"IVS1": [200, 201]}).split("Distance_setting,S\n")
    rows = text.splitlines()
    for name, driver in (("blank", ["Human"] * 400), ("acc", ["Human"] * 400)):
        driver[200:202] = ["Human" if name == "blank" else "ACC"] * 2
        marked = [f"{row},{x}" for row, x in zip(rows, ["Driver2", *driver], strict=True)]
        if name == "acc":
            marked[201:203] = [x.replace(",,", ",20.0,") for x in marked[201:203]]
        path = Path(tmp_path / f"{name}.csv")
        path.write_text(head + "Distance_setting,S\n" + "\n".join(marked) + "\n")
        loaded = OpenAccSource(path=str(path), driver="human", bridge_s=0.5).load()
        assert loaded.episodes["episode"].nunique() == (1 if name == "blank" else 2)
