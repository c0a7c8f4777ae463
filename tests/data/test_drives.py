"""Tables of speed records: reading, what is held out, and what is wrong with a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from helpers import VARIANTS

from lcc_rl.config import load
from lcc_rl.data.leaders import DriveLeaders, hashed
from lcc_rl.data.speed_records import COLUMNS, read_drives
from lcc_rl.envs import load_inputs
from lcc_rl.errors import ConfigError, DataError

NAMES = [f"drive {number}" for number in range(12)]
ROWS = "drive,time_s,speed_mps\n"


def drives(names: list[str] = NAMES, seconds: float = 60.0, step: float = 0.1) -> pd.DataFrame:
    """A wavy record for each name, the same whatever else is in the table."""
    time = np.arange(0.0, seconds, step)
    parts = [
        pd.DataFrame(
            {
                "drive": name,
                "time_s": time,
                "speed_mps": 20 + 5 * np.sin(time / 4 + len(name) + hashed(name)),
            }
        )
        for name in names
    ]
    return pd.concat(parts, ignore_index=True)


@pytest.fixture
def table(tmp_path) -> Path:
    path = tmp_path / "drives.parquet"
    drives().to_parquet(path)
    return path


def names_of(profiles) -> set[str]:
    return {name.split("+")[0] for name in profiles.names}


def test_drives_for_a_single_car(table) -> None:
    inputs = load_inputs(load("train", ["variant=alcc", "leader=drives", f"leader.path={table}"]))
    training, held_out = names_of(inputs.training), names_of(inputs.evaluation)
    assert training | held_out == set(NAMES)
    assert not training & held_out
    assert held_out == {name for name in NAMES if hashed(name) < 1 / 3}
    assert inputs.training.time_step == 0.1
    reported = next(line for line in inputs.report if "for evaluation" in line)
    assert all(name in reported for name in held_out)


def test_a_drive_is_on_the_same_side_in_every_file(table, tmp_path) -> None:
    whole = DriveLeaders(path=str(table)).load(0.1, 300)
    fewer = tmp_path / "fewer.csv"
    drives(["another", *NAMES[1::2]]).to_csv(fewer, index=False)
    part = DriveLeaders(path=str(fewer)).load(0.1, 300)
    for side in ("training", "windows"):
        both = set(NAMES[1::2])
        assert names_of(getattr(part, side)) & both == names_of(getattr(whole, side)) & both
    # These must never change: a policy trained before would meet its training drives.
    assert [round(hashed(name), 4) for name in ("a", "b")] == [0.5319, 0.5969]


def test_tuning_leaves_the_evaluation_out(table) -> None:
    usual, tuning = (DriveLeaders(path=str(table), tuning=x).load(0.1, 300) for x in (False, True))
    evaluation = names_of(usual.windows)
    assert not evaluation & (names_of(tuning.training) | names_of(tuning.windows))
    assert names_of(tuning.training) | names_of(tuning.windows) == names_of(usual.training)
    assert not names_of(tuning.training) & names_of(tuning.windows)


def test_drives_of_one_day_are_on_one_side(tmp_path) -> None:
    names = [f"2021-03-{day:02d}_{car}" for day in range(1, 13) for car in range(3)]
    drives(names).to_parquet(tmp_path / "days.parquet")
    leaders = DriveLeaders(path=str(tmp_path / "days.parquet"), together="[^_]+").load(0.1, 300)
    training, held_out = names_of(leaders.training), names_of(leaders.windows)
    assert training | held_out == set(names)
    days = [{name.split("_")[0] for name in side} for side in (training, held_out)]
    assert not days[0] & days[1]
    assert len(held_out) == 3 * len(days[1]) > 0
    for together, error, words in (
        ("(", ConfigError, r"leader\.together=\(: "),
        ("x", DataError, "drive '2021-03-01_0' does not begin with 'x'"),
    ):
        with pytest.raises(error, match=words):
            DriveLeaders(path=str(tmp_path / "days.parquet"), together=together).load(0.1, 300)
    with pytest.raises(ConfigError, match="leaves nothing to tune on"):
        DriveLeaders(path="x.csv", evaluation_share=1, tuning=True)
    with pytest.raises(ConfigError, match="the table holds one record"):
        DriveLeaders(path="x.csv", columns={"drive": None}, together="x")


def test_everything_for_evaluation(table) -> None:
    found = DriveLeaders(path=str(table), evaluation_share=1.0).load(0.1, 300)
    assert len(found.training) == 0
    assert names_of(found.windows) == set(NAMES)


def test_other_columns_steps_and_formats(table, tmp_path) -> None:
    path = tmp_path / "other.csv"
    renamed = {"drive": "id", "time_s": "t", "speed_mps": "v"}
    # Rows of different records may alternate; ids stay text.
    frame = drives(seconds=30.0, step=0.5).sort_values("time_s", kind="stable")
    frame.assign(drive=frame["drive"].str[6:].str.zfill(2)).rename(columns=renamed).to_csv(
        path, index=False
    )
    columns = {"drive": "id", "time": "t", "speed": "v"}
    found, _ = read_drives(str(path), columns, 0.1)
    assert found.names == tuple(f"{number:02d}" for number in range(12))
    truth, _ = read_drives(str(table), COLUMNS, 0.1)
    at = truth.names.index("drive 7")
    torch.testing.assert_close(
        found.record(7)[::5], truth.record(at)[:300:5][: len(found.record(7)[::5])]
    )
    torch.testing.assert_close(
        found.record(7), truth.record(at)[: len(found.record(7))], atol=0.02, rtol=0
    )


def test_of_a_single_record_the_end_is_held_out(tmp_path) -> None:
    path = tmp_path / "record.csv"
    drives(["x"], 300.0).drop(columns="drive").to_csv(path, index=False)
    said = ["variant=reference", "leader=record", f"leader.path={path}"]
    inputs = load_inputs(load("train", said))
    assert inputs.training.lengths.tolist() == [2000]
    assert inputs.evaluation.names[0] == "record+200s+0s"
    whole, _ = read_drives(str(path), {**COLUMNS, "drive": None}, 0.1)
    torch.testing.assert_close(inputs.training.record(0), whole.record(0)[:2000])
    torch.testing.assert_close(inputs.evaluation.record(0), whole.record(0)[2000:2301])
    tuned = load_inputs(load("train", [*said, "leader.tuning=true"]))
    assert tuned.training.lengths.tolist() == [1333]
    assert {name.split("+")[1] for name in tuned.evaluation.names} == {"133.3s"}


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (ROWS + "a,0,1\na,0.1,\n", "data row 2, column 'speed_mps' holds nothing"),
        (ROWS + "a,0,1\na,x,1\n", "data row 2, column 'time_s' holds 'x'"),
        (ROWS + "a,0,1\na,0.1,-1\n", "data row 2, column 'speed_mps' holds '-1'"),
        (ROWS + "a,0,1\n,0.1,1\n", "data row 2, column 'drive' is blank"),
        (
            ROWS + "a,0,1\nb,0,1\na,0.1,1\nb,0.1,1\na,0.1,1\n",
            "data row 5, column 'time_s' does not",
        ),
        (ROWS + "a,0,1\na,0.1,1\na,0.2,1\na,0.7,1\n", "data row 4, column 'time_s' is not evenly"),
        (ROWS + "a,0,1\nb,0,1\nb,0.1,1\n", "data row 1, column 'time_s' is the only sample"),
        (ROWS + "a,0,1\na,0.1,1\na,0.2,9\n", r"data row 3 \(a\), column 'speed_mps' changes by 80"),
        ("drive,t,v\na,0,1\n", r"lacks the column time_s, speed_mps; it has drive, t, v.*columns"),
        (ROWS, "holds 0 samples"),
        ("", "not a readable table"),
    ],
)
def test_what_is_wrong_with_a_table_is_said(tmp_path, rows, words) -> None:
    path = tmp_path / "drives.csv"
    path.write_text(rows)
    with pytest.raises(DataError, match=words) as caught:
        read_drives(str(path), COLUMNS, 0.1)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("overrides", "error", "words"),
    [
        (["leader.path=nowhere.csv"], DataError, r"nowhere\.csv: no such file"),
        (["+leader.columns.sped=v"], ConfigError, "'sped'.*Did you mean 'speed'"),
        (["leader.columns.time=null"], ConfigError, r"columns\.time must name a column"),
        (["leader.evaluation_share=0"], ConfigError, r"leader\.evaluation_share must be"),
        (["leader.evaluation_share=1.1"], ConfigError, r"leader\.evaluation_share must be"),
        (["leader.least_variation=-1"], ConfigError, r"least_variation must be"),
        (["leader.evaluation_share=0.001"], DataError, "all 12 drives fall on the side of train"),
        (["scenario.horizon=5000"], DataError, "shorter than the horizon"),
        (["leader.least_variation=1e6"], DataError, "least_variation"),
        (["leader.plausible.max_speed=10"], DataError, r"leader\.plausible\.max_speed=10"),
    ],
)
def test_impossible_drives(table, overrides, error, words) -> None:
    said = ["variant=alcc", "leader=drives", f"leader.path={table}", *overrides]
    with pytest.raises(error, match=words):
        load_inputs(load("train", said))


@pytest.mark.parametrize(("separator", "decimal"), [(",", "."), (";", ","), ("\t", ".")])
def test_units_and_separators(tmp_path, separator, decimal) -> None:
    path = tmp_path / "record.csv"
    frame = drives(["x"], 120.0)
    other = pd.DataFrame({"t": 1000 * frame["time_s"], "v": 3.6 * frame["speed_mps"]})
    other.to_csv(path, index=False, sep=separator, decimal=decimal)
    said = ["leader.columns={time: t, speed: v}", "leader.units={time: ms, speed: km/h}"]
    cfg = load("train", ["variant=alcc", "leader=record", f"leader.path={path}", *said])
    inputs = load_inputs(cfg)
    expected = frame["speed_mps"].to_numpy()[: len(inputs.training.record(0))]
    np.testing.assert_allclose(inputs.training.record(0), expected, atol=1e-3)
    assert any("separated by" in line for line in inputs.report) == (separator != ",")
    with pytest.raises(ConfigError, match=r"leader\.units\.speed: 'kmh'.*Did you mean 'km/h'"):
        DriveLeaders(path=str(path), units={"speed": "kmh"})
    with pytest.raises(DataError, match=r"holds 90 m/s .*km/h|leader\.plausible\.max_speed"):
        read_drives(
            str(path), {"drive": None, "time": "t", "speed": "v"}, 0.1, None, {"time": "ms"}
        )


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (20.1, r"record has 200, .* scenario\.horizon to at most 66"),
        (60.1, r"evaluation 400 and 199; .*at most 199, .*leader\.evaluation_share=1"),
    ],
)
def test_a_short_record_says_what_to_set(tmp_path, seconds, words) -> None:
    path = tmp_path / "record.csv"
    drives(["x"], seconds).to_csv(path, index=False)
    said = ["variant=alcc", "leader=record", f"leader.path={path}"]
    with pytest.raises(DataError, match=rf"record\.csv: shorter than the horizon: .*{words}"):
        load_inputs(load("train", said))
    if seconds > 30:
        whole = load_inputs(load("train", [*said, "leader.evaluation_share=1"]))
        assert (len(whole.training), len(whole.evaluation)) == (0, 1)
    shorter = load_inputs(load("train", [*said, f"scenario.horizon={60 if seconds < 30 else 199}"]))
    assert len(shorter.training) == 1


@pytest.mark.parametrize("variant", VARIANTS)
def test_one_record_serves_every_variant(tmp_path, variant) -> None:
    path = tmp_path / "record.csv"
    drives(["x"], 300.0).to_csv(path, index=False)
    said = [f"variant={variant}", "leader=record", f"leader.path={path}"]
    inputs = load_inputs(load("train", said))
    assert len(inputs.training) == 1
    assert len(inputs.evaluation) >= 1


def test_real_drives(shared_data) -> None:
    path = shared_data / "i24_leaders.parquet"
    if not path.is_file():
        pytest.skip(f"no highway drives in {shared_data}")
    found = DriveLeaders(path=str(path)).load(0.1, 300)
    assert len(found.training) == 30
    assert len(names_of(found.windows)) == 14
    assert not names_of(found.training) & names_of(found.windows)
