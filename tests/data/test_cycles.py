"""Speed records: reading, interpolation, stretches, cases and what is wrong with a file."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import torch

from lcc_rl.config import load
from lcc_rl.data.leaders import RecordLeaders, stretch, varying
from lcc_rl.data.profiles import from_records, resample
from lcc_rl.data.speed_records import read_speed_record, shipped_cycles
from lcc_rl.envs.factory import load_inputs
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.nodes import build


def test_shipped_cycles_are_the_published_ones() -> None:
    # Duration [s] and distance [km] as the regulations print them.
    published = {
        "udds": (1369, 11.99),
        "us06": (600, 12.89),
        "hwfet": (765, 16.51),
        "wltc_3b": (1800, 23.27),
    }
    assert shipped_cycles() == sorted(published)
    for name, (duration, kilometres) in published.items():
        time, speed = read_speed_record(name)
        assert time[-1] == duration
        assert np.trapezoid(speed, time) / 1e3 == pytest.approx(kilometres, rel=0.01)


def test_the_cases_are_the_stated_ones() -> None:
    inputs = load_inputs(load("train", ["variant=cacc"]))
    ends = {c.name: (c.profile.record(0)[[0, -1]], c.followers, c.horizon) for c in inputs.cases}
    torch.testing.assert_close(ends["case 1"][0], torch.tensor([0.47, 10.73]), atol=0.01, rtol=0)
    assert ends["case 2"][0][0] == 0.0
    assert inputs.cases[1].profile.record(0).max() == pytest.approx(11.5, abs=0.1)
    third = inputs.cases[2].profile.record(0)
    assert (third[0], third.min()) == (pytest.approx(9.46, abs=0.01), pytest.approx(1.97, abs=0.01))
    assert [(f, h) for _, f, h in ends.values()] == [(8, 100), (6, 100), (4, 100)]
    assert len(inputs.evaluation) >= 20
    # Nothing of the training range is among the windows.
    starts = [n for n in inputs.evaluation.names if n.startswith("udds")]
    assert starts
    assert all(float(n.split("+")[1][:-1]) + 20 <= 600 for n in starts)


def test_interpolation_is_monotone_and_keeps_the_samples() -> None:
    time, speed = np.array([0.0, 1.0, 2.0, 3.0, 4.0]), np.array([0.0, 0.0, 3.0, 3.0, 1.0])
    got = resample(time, speed, 0.2).numpy()
    np.testing.assert_allclose(got[::5], speed, atol=1e-6)
    assert got.min() >= 0.0
    assert got.max() <= 3.0 + 1e-6
    assert (np.diff(got[5:11]) >= 0).all()
    assert (got[:6] == 0).all()


def test_any_rate_and_format(tmp_path) -> None:
    fine = np.arange(0.0, 30.0, 0.1)
    frame = pd.DataFrame({"time_s": fine + 5.0, "speed_mps": 8.0 + np.sin(fine / 2)})
    frame.to_parquet(tmp_path / "a.parquet")
    frame.to_csv(tmp_path / "a.csv", index=False)
    one, two = (stretch(str(tmp_path / f"a.{kind}"), 0.2, 0.5) for kind in ("parquet", "csv"))
    torch.testing.assert_close(one.record(0), two.record(0))
    expected = torch.tensor(0.5 * (8.0 + np.sin(0.2 * np.arange(150) / 2)), dtype=torch.float32)
    torch.testing.assert_close(one.record(0), expected, atol=1e-3, rtol=0)
    part = stretch(str(tmp_path / "a.csv"), 0.2, 0.5, 10.0, 20.0).record(0)
    torch.testing.assert_close(part, one.record(0)[25:76], atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("time_s,speed_mps\n0,1\n1,-1\n", "row 2, column 'speed_mps' holds '-1'"),
        ("time_s,speed_mps\n0,1\n0,1\n", "row 2, column 'time_s' does not follow"),
        ("time_s,speed_mps\n0,1\n1,\n", "row 2, column 'speed_mps' holds nothing"),
        ("time_s,speed_mps\n0,1\n1,fast\n", "row 2, column 'speed_mps' holds 'fast'"),
        ("time_s,speed_mps\n0,1\n", "at least 2"),
        ("time,speed\n0,1\n1,1\n", "lacks the column time_s, speed_mps; .*leader.columns"),
        ("", "not a readable table"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path, rows, words) -> None:
    path = tmp_path / "record.csv"
    path.write_text(rows)
    with pytest.raises(DataError, match=words) as caught:
        read_speed_record(str(path))
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("overrides", "error", "words"),
    [
        (["leader=paper"], ConfigError, "path is required"),
        (["leader=paper", "leader.path=nowhere.csv"], DataError, r"nowhere\.csv: no such file"),
        (["leader.cases.case_1.path=uds"], DataError, "no shipped cycle"),
        (["leader.cases.case_1.start_s=595"], DataError, "covers 0–600 s, not the stretch"),
        (["leader.cases.case_1.followers=0"], ConfigError, r"case_1\.followers"),
        (["leader.training.udds.scale=0"], ConfigError, "scale must be greater"),
        (["leader.training.udds.from_s=1369"], ConfigError, "is empty"),
        (["+leader.training.udds.start_s=3"], ConfigError, "start_s"),
        (["leader.least_variation=1e6"], DataError, "least_variation"),
        (["scenario.horizon=5000"], DataError, "shorter than the horizon|covers"),
    ],
)
def test_impossible_leaders(overrides, error, words) -> None:
    with pytest.raises(error, match=words):
        load_inputs(load("train", ["variant=cacc", *overrides]))


def test_the_papers_own_protocol(tmp_path) -> None:
    time = np.arange(0.0, 1401.0)
    path = tmp_path / "record.csv"
    frame = pd.DataFrame({"time_s": time, "speed_mps": 14.0 + 6.0 * np.sin(time / 9.0)})
    frame.to_csv(path, index=False)
    inputs = load_inputs(load("train", ["variant=cacc", "leader=paper", f"leader.path='{path}'"]))
    assert [case.profile.names[0] for case in inputs.cases] == [
        "record@200s",
        "record@620s",
        "record@1020s",
    ]
    first = inputs.cases[0].profile.record(0)[0]
    assert float(first) == pytest.approx(7.0 + 3.0 * np.sin(200 / 9.0), abs=1e-3)
    assert float(inputs.training.lengths[0]) == pytest.approx(4001, abs=1)


def test_measured_leaders(shared_data) -> None:
    path = shared_data / "leader_openacc_platoon3_10hz.csv"
    if not path.is_file():
        pytest.skip(f"no OpenACC leader in {shared_data}")
    cfg = load("train", ["variant=cacc", "leader=openacc", f"leader.path='{path}'"])
    inputs = load_inputs(cfg)
    assert len(inputs.evaluation) > 5
    assert [case.name for case in inputs.full_length] == ["full length record"]


def test_leaders_of_recorded_trajectories() -> None:
    overrides = ["variant=cacc", "leader=trajectories", "data.platoons=4", "data.recordings=2"]
    inputs = load_inputs(load("train", overrides))
    assert inputs.training.time_step == 0.2
    assert not set(inputs.training.recordings) & set(inputs.evaluation.recordings)


def test_records_without_variation_are_left_out() -> None:
    still, moving = torch.full((9,), 5.0), torch.tensor([5.0, 6.0, 5.0, 6.5])
    profiles = from_records([still, moving], ["a", "b"], ["a", "b"], 0.2)
    assert varying(profiles, 2.0).names == ("b",)


def test_a_node_builds_its_own_leaders() -> None:
    node = {
        "_target_": "lcc_rl.data.leaders.RecordLeaders",
        "training": {"a": {"path": "us06"}},
        "held_out": {"b": {"path": "hwfet"}},
    }
    built = build(node, "leader")
    assert isinstance(built, RecordLeaders)
    assert not built.load(0.2, 100, 3).full_length
