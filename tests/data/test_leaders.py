"""Leaders: drive cycles, stretches, tables of drives, recorded traffic and mixtures."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from helpers import check_refused, wavy_profiles
from ngsim_text import cells, csv_text, pair
from table_text import openacc_text, speed

from lcc_rl.config import load
from lcc_rl.data.leaders import DriveLeaders, Mixture, RecordLeaders, apart, hashed, stretch
from lcc_rl.data.profiles import Split, at_step, joined, leader_profiles
from lcc_rl.data.sources import SHIPPED_FILES, NgsimSource
from lcc_rl.data.speed_records import read_speed_record
from lcc_rl.envs import load_inputs
from lcc_rl.errors import Concern, ConfigError, DataError
from lcc_rl.functional.random import choose, stream_id
from lcc_rl.pieces.leader import NGSIMLeader
from lcc_rl.pieces.world import World

NAMES = [f"drive {number}" for number in range(12)]
FOOT = 0.3048


def drives(names: list[str] = NAMES, seconds: float = 60.0, step: float = 0.1) -> pd.DataFrame:
    """A wavy record for each name, the same whatever else is in the table."""
    time = np.arange(0.0, seconds, step)
    parts = [
        pd.DataFrame({"time_s": time, "speed_mps": 20 + 5 * np.sin(time / 4 + 9 * hashed(name))})
        for name in names
    ]
    return pd.concat([part.assign(drive=name) for part, name in zip(parts, names, strict=True)])


@pytest.fixture
def table(tmp_path) -> str:
    drives().to_parquet(tmp_path / "drives.parquet")
    return str(tmp_path / "drives.parquet")


def names_of(profiles) -> set[str]:
    return {name.split("+")[0] for name in profiles.names}


# -- speed records ---------------------------------------------------------------------------------


def test_shipped_cycles_are_the_published_ones() -> None:
    # Duration [s] and distance [km] as the regulations print them.
    published = {"udds": (1369, 11.99), "us06": (600, 12.89), "hwfet": (765, 16.51)}
    published["wltc_3b"] = (1800, 23.27)
    assert sorted(SHIPPED_FILES) == sorted([*published, "drives", "platoons", "stop_and_go"])
    for name, (duration, kilometres) in published.items():
        time, own = read_speed_record(name)
        assert time[-1] == duration
        assert np.trapezoid(own, time) / 1e3 == pytest.approx(kilometres, rel=0.01)


def test_a_stretch_of_any_rate_and_format(tmp_path) -> None:
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


def test_cases_and_windows_of_the_platoon_study() -> None:
    inputs = load_inputs(load("train", ["variant=cacc"]))
    first, second, third = (case.profile.record(0) for case in inputs.cases)
    torch.testing.assert_close(first[[0, -1]], torch.tensor([0.47, 10.73]), atol=0.01, rtol=0)
    assert (second[0], second.max()) == (0.0, pytest.approx(11.5, abs=0.1))
    assert (third[0], third.min()) == (pytest.approx(9.46, abs=0.01), pytest.approx(1.97, abs=0.01))
    assert [(c.followers, c.horizon) for c in inputs.cases] == [(8, 100), (6, 100), (4, 100)]
    # Nothing of the training range is among the windows.
    starts = [name for name in inputs.evaluation.names if name.startswith("udds")]
    assert starts
    assert all(float(name.split("+")[1][:-1]) + 20 <= 600 for name in starts)


def test_the_papers_own_protocol(tmp_path) -> None:
    time, path = np.arange(0.0, 1401.0), tmp_path / "record.csv"
    frame = pd.DataFrame({"time_s": time, "speed_mps": 14.0 + 6.0 * np.sin(time / 9.0)})
    frame.to_csv(path, index=False)
    inputs = load_inputs(load("train", ["variant=cacc", "leader=paper", f"leader.path='{path}'"]))
    names = [case.profile.names[0] for case in inputs.cases]
    assert names == ["record@200s", "record@620s", "record@1020s"]
    first = float(inputs.cases[0].profile.record(0)[0])
    assert first == pytest.approx(7.0 + 3.0 * np.sin(200 / 9.0), abs=1e-3)


def test_impossible_leaders() -> None:
    cases = [
        ({"training": {"a": {}}}, "path is required"),
        ({"training": {"a": {"path": "uds"}}}, "none of the package .*us06"),
        (
            {"cases": {"case_1": {"path": "us06", "start_s": 595.0}}},
            "covers 0–600 s, not the stretch",
        ),
        ({"cases": {"case_1": {"path": "us06", "followers": 0}}}, r"case_1\.followers"),
        ({"training": {"a": {"path": "us06", "scale": 0.0}}}, "scale must be greater"),
        ({"training": {"a": {"path": "us06", "from_s": 600.0}}}, "is empty"),
        ({"training": {"a": {"path": "us06", "scale": 9.0}}}, "drives up to .*max_speed"),
        ({"training": {}}, r"leader\.training names no record"),
        ({"held_out": {"b": {"path": "nycc"}}}, r"leader\.held_out\.b: nycc: no such file"),
        ({"least_variation": 1e6}, "least_variation, raise scenario.horizon"),
    ]
    usual = {"training": {"a": {"path": "us06"}}, "held_out": {"b": {"path": "hwfet"}}}
    check_refused(lambda own: RecordLeaders(**{**usual, **own}).load(0.1, 300, 3), cases)


# -- tables of drives ------------------------------------------------------------------------------


def test_a_drive_is_on_the_same_side_in_every_file(table, tmp_path) -> None:
    whole = DriveLeaders(path=table).load(0.1, 300)
    assert names_of(whole.windows) == {name for name in NAMES if hashed(name) < 1 / 3}
    assert names_of(whole.training) == set(NAMES) - names_of(whole.windows)
    drives(["another", *NAMES[1::2]]).to_csv(tmp_path / "fewer.csv", index=False)
    part = DriveLeaders(path=str(tmp_path / "fewer.csv")).load(0.1, 300)
    for side in ("training", "windows"):
        both = set(NAMES[1::2])
        assert names_of(getattr(part, side)) & both == names_of(getattr(whole, side)) & both
    # These must never change: a policy trained before would meet its training drives.
    assert [round(hashed(name), 4) for name in ("a", "b")] == [0.5319, 0.5969]


def test_fast_windows_are_left_out(table) -> None:
    every, slow = (DriveLeaders(path=table, fastest=x).load(0.1, 100) for x in (None, 20.0))
    means = [float(every.windows.record(i).mean()) for i in range(len(every.windows))]
    kept = [name for name, mean in zip(every.windows.names, means, strict=True) if mean <= 20]
    assert 0 < len(kept) < len(means)
    assert list(slow.windows.names) == kept


def test_calm_windows_are_counted_and_a_record_without_a_window_is_not_listed(tmp_path) -> None:
    frame = drives(["a", "b", "c"])
    frame.loc[frame["drive"] == "c", "speed_mps"] = 0.0
    frame.to_csv(tmp_path / "x.csv", index=False)
    words = ["leader=drives", f"leader.path='{tmp_path}/x.csv'", "leader.evaluation_share=1"]
    lines = load_inputs(load("evaluate", ["variant=rule", "scenario.horizon=100", *words])).report
    left_out, used = lines[-4:-2]
    assert left_out.startswith("left out 5 of 15 held-out windows")
    assert left_out.endswith("leader.least_variation=2 m/s; no window is left of 1 record(s): c")
    assert "2 of 3 record(s) for evaluation" in used
    assert used.endswith(": a, b")
    assert "only 10 are available and 5 are left out" in lines[-1]
    words = ["task=ring-22", "evaluation.drivers=5000"]
    line = load_inputs(load("evaluate", words)).report[-1]
    assert re.match(r"evaluation.drivers=5000: only \d+ are available; taking all", line)
    assert all(isinstance(x, Concern) for x in (line, lines[-1]))  # lcc_rl.compare logs them, too


def test_a_file_of_esmini_is_read(tmp_path) -> None:
    time, speed = "TimeStamp [s]", "#1 Current_Speed [m/s]"
    first = "Version: 2, OpenDRIVE: a.xodr, OpenSCENARIO: b.xosc, vehicles: 1"
    rows = [f"{k}, {k / 100:.3f}, Ego, {15 + abs(k % 800 - 400) / 200:.3f}, " for k in range(6000)]
    text = "\n".join([first, f"Index [-] , {time} , #1 Entitity_Name [-] , {speed} , ", *rows, ""])
    (tmp_path / "esmini.csv").write_text(text)
    leaders = DriveLeaders(
        path=str(tmp_path / "esmini.csv"), columns={"drive": None, "time": time, "speed": speed}
    ).load(0.1, 100)
    assert len(leaders.training.record(0)) + 200 == pytest.approx(600, abs=2)
    assert leaders.training.record(0).mean() == pytest.approx(16.0, abs=0.2)


def test_a_single_record_that_is_cut_is_divided_in_time(tmp_path) -> None:
    time = np.arange(0.0, 600.0, 0.1)
    frame = pd.DataFrame({"time_s": time, "speed_mps": 14.0 + 6.0 * np.sin(time / 9.0)})
    holes = [(50.0, 70.0), (130.0, 150.0), (500.0, 520.0)]
    whole = np.logical_and.reduce([(time < a) | (time >= b) for a, b in holes])
    path = str(tmp_path / "cut.csv")
    frame[whole].to_csv(path, index=False)
    for tuning, lengths, first, last in (
        (False, [500, 600, 2500], "cut+150s+250s", "cut+520s"),
        (True, [500, 600, 1300], "cut+150s+130s", "cut+150s+130s"),
    ):
        leaders = DriveLeaders(path=path, columns={"drive": None}, tuning=tuning).load(0.1, 100)
        assert leaders.training.lengths.tolist() == lengths, tuning
        names = leaders.windows.names
        assert names[0].startswith(first), (tuning, names)
        assert names[-1].startswith(last), (tuning, names)
        begins = [sum(float(x[:-1]) for x in name.split("+")[1:]) for name in names]
        assert leaders.windows.starts == pytest.approx(begins)
    begins = 14.0 + 6.0 * np.sin((150.0 + 130.0) / 9.0)
    assert float(leaders.windows.record(0)[0]) == pytest.approx(begins, abs=0.1)


def test_impossible_drives() -> None:
    cases = [
        ({"columns": {"sped": "v"}}, "'sped'.*Did you mean 'speed'"),
        ({"columns": {"time": None}}, r"leader\.columns\.time must name a column"),
        ({"columns": {"time": "t", "speed": "t"}}, "names the column 't' twice"),
        ({"units": {"speed": "kmh"}}, r"leader\.units\.speed: 'kmh'.*Did you mean 'km/h'"),
        ({"units": {"drive": "m"}}, r"key of leader\.units 'drive'"),
        ({"evaluation_share": 1.1}, r"evaluation_share must be"),
        ({"evaluation_share": 1.0, "tuning": True}, "leaves nothing to tune on"),
        ({"columns": {"drive": None}, "together": "x"}, "the table holds one record"),
        ({"together": "("}, r"leader\.together=\("),
    ]
    check_refused(lambda own: DriveLeaders(path="x.csv", **own), cases, ConfigError)


def test_the_first_car_of_native_openacc_files_leads(tmp_path) -> None:
    for number in range(12):
        text = openacc_text(blank={"Speed1": [200]} if number == 3 else None)
        (tmp_path / f"file{number}.csv").write_text(text)
    time, own = read_speed_record(str(tmp_path / "file0.csv"))
    np.testing.assert_allclose(own, speed(time - 430, 1))
    found = DriveLeaders(path=f"{tmp_path}/file*.csv").load(0.1, 100)
    every = (*found.training.names, *found.windows.names)
    assert {name.split("+")[0] for name in every} == {f"file{number}" for number in range(12)}
    assert any("left out 1 rows with a blank cell" in line for line in found.report)


# -- recorded traffic and mixtures -----------------------------------------------------------------


@pytest.mark.parametrize("step", [0.1, 0.25])
def test_leaders_of_a_trajectory_file_at_any_step(tmp_path: Path, step: float) -> None:
    leader = [cells(9, k, Local_Y=10.0 * k + 60, v_Vel=round(20 + 0.2 * k, 1)) for k in range(201)]
    (tmp_path / "file.txt").write_text(csv_text(pair(range(201), v_Vel=40)[:201] + leader))
    episodes = NgsimSource(path=tmp_path / "file.txt").load().episodes
    profiles = at_step(leader_profiles(episodes, 0.1), step)
    assert profiles.names == ("2005-04-13T22:58:55Z/9@0.0s",)
    time = step * np.arange(round(20 / step) + 1)
    expected = torch.tensor((20 + 2 * time) * FOOT, dtype=torch.float32)
    torch.testing.assert_close(profiles.record(0), expected, atol=1e-4, rtol=0)


def test_training_and_evaluation_share_no_recording_or_vehicle() -> None:
    profiles = wavy_profiles(12, 450)
    names = tuple(f"r{i % 3}/{i // 2}@{i}.0s" for i in range(12))
    profiles = replace(profiles, names=names, recordings=tuple(n[:2] for n in names))
    training, held_out = Split()(profiles)
    assert not set(training.recordings) & set(held_out.recordings)
    training, held_out = Split(by="vehicle")(profiles)
    vehicles = [{name.split("@")[0] for name in side.names} for side in (training, held_out)]
    assert not vehicles[0] & vehicles[1]
    assert len(training) + len(held_out) == 12
    nothing, everything = Split(evaluation_share=1.0)(profiles)
    assert (len(nothing), everything) == (0, profiles)
    with pytest.raises(DataError, match=r"cannot split 1 profiles by recording: .*split=single"):
        Split()(profiles.select([0]))


def test_windows_do_not_overlap_and_keep_what_follows_them() -> None:
    profiles = wavy_profiles(3, 450)
    one, two = profiles.select([0]).windows(100), profiles.select([1, 2]).windows(150)
    torch.testing.assert_close(one.record(1), profiles.record(0)[101:202])
    both = joined([one, two])
    for place in range(len(both)):
        source, at = (one, place) if place < len(one) else (two, place - len(one))
        first, begin, reach = int(both.offsets[place]), int(source.offsets[at]), source.reach[at]
        assert both.reach[place] == reach
        assert torch.equal(both.speeds[first : first + reach], source.speeds[begin : begin + reach])
    assert torch.equal(both.select([4]).reach, both.reach[[4]])


def test_records_are_drawn_by_their_weights() -> None:
    weights = torch.tensor([1.0, 2.0, 0.5, 4.0], dtype=torch.float64)
    profiles, seed = wavy_profiles(4), torch.arange(40_000).unsqueeze(-1)
    even = NGSIMLeader().bind(World(horizon=100, profiles=profiles))._drawn(seed)
    assert torch.equal(even, choose(seed, 4, stream_id("leader.profile")))
    leader = NGSIMLeader().bind(World(horizon=100, profiles=replace(profiles, weights=weights)))
    drawn = leader._drawn(seed)
    found = drawn.flatten().bincount(minlength=4).double() / len(seed)
    torch.testing.assert_close(found, weights / weights.sum(), atol=0.008, rtol=0)
    assert torch.equal(leader._drawn(seed[7:9]), drawn[7:9])  # each depends on its own seed only


def test_a_mixture_holds_every_source(table) -> None:
    cycles = {"training": {"udds": {"path": "udds"}}, "held_out": {"us06": {"path": "us06"}}}
    sources = {"cycles": RecordLeaders(**cycles), "highway": DriveLeaders(path=table)}
    mixture = Mixture(weights={"highway": 3}, **sources).load(0.1, 100)
    training, held_out = mixture.training, mixture.windows
    of_cycles = torch.tensor([name == "udds" for name in training.recordings])
    share = training.weights / training.weights.sum()
    assert float(share[of_cycles].sum()) == pytest.approx(0.25)
    assert set(held_out.sources) == {"cycles", "highway"}
    spread = held_out.spread(2)
    assert [spread.sources.count(name) for name in sources] == [2, 2]
    assert not set(training.names) & names_of(held_out)
    assert (held_out.reach > held_out.lengths).any()
    assert len(held_out.starts) == len(held_out)


def test_impossible_mixtures() -> None:
    source = RecordLeaders(training={}, held_out={})
    nothing = {"cycles": source, "weights": {"cycles": 0}}
    cases = [
        ({}, "names no source"),
        ({"more": 3}, r"leader\.more must be a source of leaders"),
        ({"cycles": source, "weights": {"cycle": 1}}, "'cycle'.*Did you mean 'cycles'"),
        (nothing, r"weights\.cycles must be a positive.*got 0"),
    ]
    check_refused(lambda settings: Mixture(**settings), cases, ConfigError)


# -- real files ------------------------------------------------------------------------------------


def test_real_drives_and_leaders(shared_data) -> None:
    found = DriveLeaders(path=str(shared_data / "i24_leaders.parquet")).load(0.1, 300)
    assert (len(found.training), len(names_of(found.windows))) == (30, 14)
    path = str(shared_data / "leader_openacc_platoon3_10hz.csv")
    inputs = load_inputs(load("train", ["variant=cacc", "leader=openacc", f"leader.path='{path}'"]))
    assert len(inputs.evaluation) > 5
    assert [case.name for case in inputs.full_length] == ["full length record"]


def test_real_pairs_give_a_leader_each(shared_data) -> None:
    loaded = NgsimSource(path=str(shared_data / "i80_pairs_ngsim_layout.csv.gz")).load()
    profiles = leader_profiles(loaded.episodes, 0.1)
    assert len(profiles) == 264
    assert len(set(profiles.recordings)) == 3


def test_the_report_names_what_is_held_out() -> None:
    held = {"recording": "held out: recordings rec1", "vehicle": "held out: vehicles rec1/3"}
    for by, said in held.items():
        training, held_out = Split(by=by, evaluation_share=0.25)(wavy_profiles())
        assert apart(training, held_out) == [said]
        assert apart(held_out, held_out) == []  # one profile for both
    named = apart(training, held_out, {3: "red van"})  # by the names of their file
    assert named == ["held out: vehicles rec1/red van"]


def test_one_recording_cannot_be_divided_and_the_remedies_say_where_they_hold() -> None:
    words = r"use split.by=vehicle; evaluations also take split.evaluation_share=1$"
    with pytest.raises(DataError, match=words):
        Split()(wavy_profiles().select([0, 2]))
