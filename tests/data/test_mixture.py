"""Leaders from several sources, what training draws of them, and the one path to all leaders."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd
import pytest
import torch
from commands import DATA, QUICK, jobs_in_threads, tiny
from helpers import wavy_profiles

import lcc_rl
from lcc_rl.commands import evaluation, pipeline, training
from lcc_rl.config import load
from lcc_rl.data.leaders import Mixture
from lcc_rl.data.profiles import Split, join, leader_profiles
from lcc_rl.envs import load_inputs
from lcc_rl.envs.inputs import build_source
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.functional.random import choose, stream_id
from lcc_rl.pieces.leader import NGSIMLeader
from lcc_rl.pieces.world import World
from lcc_rl.results.savings import stratified
from lcc_rl.results.tables import summary

MIXTURE = ("leader=mixture", *DATA)
LONG = "data.duration_s=[62,70]"  # for episodes of 30 s


@pytest.fixture
def drives(tmp_path) -> str:
    """A table of twelve drives at 2 Hz."""
    profiles = wavy_profiles(12, 1200)
    parts = [
        pd.DataFrame({"drive": f"d{i}", "speed_mps": profiles.record(i)[::5].numpy()})
        for i in range(12)
    ]
    table = pd.concat([part.assign(time_s=0.5 * part.index) for part in parts])
    table.to_csv(tmp_path / "drives.csv", index=False)
    return str(tmp_path / "drives.csv")


def test_the_leaders_of_data_are_what_they_were() -> None:
    cfg = load("train", ["variant=alcc", *DATA, LONG, "evaluation.profiles=5"])
    inputs = load_inputs(cfg)
    profiles = leader_profiles(build_source(cfg.data).load().episodes, 0.1).at_least(300)
    training, held_out = Split()(profiles)
    windows = held_out.windows(300, 5)
    for got, expected in ((inputs.training, training), (inputs.evaluation, windows)):
        assert got.names == expected.names
        for name in ("speeds", "offsets", "lengths", "reach"):
            one, other = getattr(got, name), getattr(expected, name)
            assert one is other is None or torch.equal(one, other)
    assert inputs.training.weights is None
    assert not inputs.evaluation.sources


def test_without_weights_the_draw_is_what_it_was() -> None:
    leader = NGSIMLeader().bind(World(horizon=100, profiles=wavy_profiles(7)))
    seed = torch.arange(500).unsqueeze(-1)
    assert torch.equal(leader._drawn(seed), choose(seed, 7, stream_id("leader.profile")))


def test_records_are_drawn_by_their_weights() -> None:
    weights = torch.tensor([1.0, 2.0, 0.5, 4.0], dtype=torch.float64)
    profiles = replace(wavy_profiles(4), weights=weights)
    leader = NGSIMLeader().bind(World(horizon=100, profiles=profiles))
    seed = torch.arange(40_000).unsqueeze(-1)
    drawn = leader._drawn(seed)
    found = drawn.flatten().bincount(minlength=4).double() / len(seed)
    torch.testing.assert_close(found, weights / weights.sum(), atol=0.008, rtol=0)
    assert torch.equal(drawn, leader._drawn(seed))
    part = leader._drawn(seed[7:9])  # a draw depends on its own seed only
    assert torch.equal(part, drawn[7:9])


def test_a_mixture_holds_every_source(drives) -> None:
    said = ["+leader@leader.highway=drives", f"leader.highway.path={drives}"]
    weights = ["leader.weights={highway: 3}", "evaluation.profiles=4"]
    inputs = load_inputs(load("train", ["variant=alcc", *MIXTURE, LONG, *said, *weights]))
    training, held_out = inputs.training, inputs.evaluation
    assert training.time_step == held_out.time_step == 0.1
    of_drives = torch.tensor([name.startswith("d") for name in training.recordings])
    of_cycles = torch.tensor([name == "udds" for name in training.recordings])
    share = training.weights / training.weights.sum()
    assert float(share[of_drives].sum()) == pytest.approx(0.6)
    assert float(share[of_cycles].sum()) == pytest.approx(0.2)
    assert {name: held_out.sources.count(name) for name in ("traffic", "cycles", "highway")} == {
        "traffic": 4,
        "cycles": 4,
        "highway": 4,
    }
    assert not set(training.names) & {
        name.split("+")[0] for name in held_out.names if name[0] == "d"
    }
    assert held_out.reach is not None
    assert (held_out.reach > held_out.lengths).any()
    # Where a source has fewer windows than asked for, that is said by name.
    more = load_inputs(load("train", ["variant=alcc", *MIXTURE, LONG, "evaluation.profiles=60"]))
    assert any("evaluation.profiles=60: only" in x and "of traffic" in x for x in more.report)


def test_joined_windows_keep_what_follows_them() -> None:
    profiles = wavy_profiles(3, 450)
    one, two = profiles.select([0]).windows(100), profiles.select([1, 2]).windows(150)
    both = join([one, two])
    for place in range(len(both)):
        source = one if place < len(one) else two
        at = place if place < len(one) else place - len(one)
        first, begin = int(both.offsets[place]), int(source.offsets[at])
        reach = int(source.reach[at])
        assert int(both.reach[place]) == reach
        assert torch.equal(both.speeds[first : first + reach], source.speeds[begin : begin + reach])
    assert torch.equal(both.select([4]).reach, both.reach[[4]])


@pytest.mark.parametrize(
    ("overrides", "error", "words"),
    [
        (
            ["leader.weights={traffic: 0}"],
            ConfigError,
            r"leader\.weights\.traffic must be positive",
        ),
        (["leader.weights={cycles: -1}"], ConfigError, r"leader\.weights\.cycles must be positive"),
        (["leader.weights={cycle: 1}"], ConfigError, "'cycle'.*Did you mean 'cycles'"),
        (["+leader.more=3"], ConfigError, r"leader\.more must be a source of leaders"),
        (["leader.cycles.least_variation=1e6"], DataError, r"leader\.cycles: no held-out window"),
    ],
)
def test_impossible_mixtures(overrides, error, words) -> None:
    with pytest.raises(error, match=words):
        load_inputs(load("train", ["variant=alcc", *MIXTURE, LONG, *overrides]))


def test_a_mixture_of_nothing() -> None:
    with pytest.raises(ConfigError, match="names no source"):
        Mixture()


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["leader=udds", "data.seed=3"], "data.seed=3 has no effect: the leader drives"),
        (["leader=udds", "split.by=vehicle"], "split.by=vehicle has no effect"),
        (["leader=udds", "leader.full_length=null"], "leader.full_length=null has no effect"),
        (["leader=udds", "leader.cases={}"], "leader.cases={} has no effect"),
    ],
)
def test_options_that_the_leader_ignores(overrides, words) -> None:
    with pytest.raises(ConfigError, match=words):
        load("train", ["variant=alcc", *overrides])
    load("train", ["variant=alcc", *MIXTURE, "split.by=vehicle"])


@pytest.mark.slow
def test_nothing_is_learned_from_what_is_all_for_evaluation(tmp_path) -> None:
    cfg = tiny("train", "variant=alcc", "split.evaluation_share=1")
    with pytest.raises(ConfigError, match="no profile is left to train on: evaluation_share=1"):
        training.run(cfg, tmp_path / "t", quiet=True)
    with pytest.raises(ConfigError, match="no profile is left"):
        lcc_rl.make_env("alcc", 2, ["split.evaluation_share=1", *DATA])
    rows = evaluation.run(
        tiny("evaluate", "variant=idm", "split.evaluation_share=1", agent=False), tmp_path / "e"
    )
    assert rows["collided"].sum() == 0
    everything = load_inputs(
        tiny("train", "variant=alcc", "split.evaluation_share=1", "evaluation.profiles=null")
    )
    usual = load_inputs(tiny("train", "variant=alcc", "evaluation.profiles=null"))
    assert len(everything.training) == 0
    assert len(everything.evaluation) > len(usual.evaluation)
    assert set(everything.evaluation.recordings) > set(usual.evaluation.recordings)


@pytest.mark.slow
def test_a_mixture_is_trained_and_evaluated_by_source(tmp_path, capsys) -> None:
    said = ("variant=alcc", "leader=mixture")
    once, again = (training.run(tiny("train", *said), tmp_path / x) for x in "ab")
    pd.testing.assert_frame_equal(once, again, check_exact=True)
    assert dict(once.groupby("source")["profile_id"].nunique()) == {"traffic": 2, "cycles": 2}
    printed = capsys.readouterr().out
    assert "traffic: 2 held-out" in " ".join(printed.split())
    assert "cycles: 2 held-out" in " ".join(printed.split())


@pytest.mark.slow
def test_savings_by_source(tmp_path) -> None:
    cfg = tiny("evaluate", "variant=idm", "leader=mixture", "evaluation.profiles=6", agent=False)
    rows = evaluation.run(cfg, tmp_path, quiet=True)
    table = stratified(rows, "hdv_path_energy_kj", "idm", "human").set_index(["by", "tercile"])
    for source, part in rows.groupby("source"):
        own = summary(part)
        assert len(own) == len(summary(rows))
        energy = part.groupby("strategy")["hdv_path_energy_kj"].mean()
        saved = 100 * (1 - energy["idm"] / energy["human"])
        assert table.loc[("source", source), "saving_pct"] == pytest.approx(saved, rel=1e-4)
        assert table.loc[("source", source), "windows"] == part["profile_id"].nunique()


def test_a_platoon_is_evaluated_by_source(tmp_path) -> None:
    cfg = tiny(
        "evaluate", "variant=deadbeat", "leader=mixture", "evaluation.baselines=[]", agent=False
    )
    rows = evaluation.run(cfg, tmp_path, quiet=True)
    assert set(rows.loc[rows["case"] == "windows", "source"]) == {"traffic", "cycles"}
    assert set(rows.loc[rows["case"] == "case 1", "source"]) == {""}


@pytest.mark.slow
def test_a_pipeline_calibrates_on_data_and_trains_behind_other_leaders(
    tmp_path, monkeypatch
) -> None:
    jobs_in_threads(monkeypatch)
    overrides = ["experiment=smoke", *DATA, QUICK, "variants=[reference]", "leader=udds"]
    overrides += ["scenario.horizon=40", "agent.batch_size=64", "agent.hidden=[16,16]"]
    rows = pipeline.run(load("pipeline", overrides), tmp_path, overrides)
    assert rows["profile"].str.match("us06|wltc|hwfet|udds").all()
    assert (tmp_path / "calibration" / "drivers.parquet").exists()


def test_drivers_that_keep_up() -> None:
    usual, fast = (
        load_inputs(load("train", ["variant=alcc", *DATA, LONG, f"drivers={name}"])).population
        for name in ("i80", "highway")
    )
    assert float(fast.desired_speed.min()) == 45.0
    assert torch.equal(fast.time_gap, usual.time_gap)
    assert fast.ids == usual.ids
    with pytest.raises(ConfigError, match=r"drivers\.least_speed must lie in"):
        load_inputs(load("train", ["variant=alcc", "drivers=highway", "drivers.least_speed=200"]))
