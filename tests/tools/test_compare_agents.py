"""The comparison tool: tables by hand from fabricated runs, figures, and what it would run."""

from __future__ import annotations

import argparse
from pathlib import Path

import compare_agents as tool
import pandas as pd
import pytest
from agent_results import course
from helpers import compose, slow_but
from limit_results import HUES, MEANS
from matplotlib.colors import to_rgb
from matplotlib.image import imread

from lcc_rl.commands import training
from lcc_rl.config import load
from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.results.runs import save_config


def fabricate(folder: Path, variant: str, energy: float, *overrides: str) -> None:
    cfg = compose(variant, *overrides)
    save_config(cfg, folder)
    episodes = pd.DataFrame(
        {
            "strategy": variant,
            "total_energy_kj": [energy - 1.0, energy + 1.0],
            "total_net_energy_kj": energy,
            "total_acceleration_loss_kj": 0.2 * energy,
            "share_ttc_unsafe": 0.0,
            "share_time_gap_long": [0.0, 0.02],
            "collided": False,
        }
    )
    write_parquet(episodes, folder / "episodes.parquet")
    training = {
        "iteration": [1.0, 2.0],
        "transitions": [40.0, 80.0],
        "episode_reward": [-9.0, -8.0],
    }
    write_parquet(pd.DataFrame(training), folder / "training.parquet")
    timing = {"iteration": [1.0, 2.0], "collect_s": [1.0, 2.0], "learn_s": [3.0, 4.0]}
    write_parquet(pd.DataFrame(timing), folder / "timing.parquet")


def test_table_of_agents(tmp_path) -> None:
    fabricate(tmp_path / "a", "alcc", 120.0, "agent=td3", "seed=2")
    fabricate(tmp_path / "b", "reference", 118.0, "agent=analytic")
    assert tool.main(["agents", "--draw", "--out", str(tmp_path)]) == 0
    table = read_parquet(tmp_path / "agents.parquet").set_index("run")
    assert table.loc["a", ["agent", "seed", "env_steps", "train_s"]].tolist() == ["td3", 2, 80, 10]
    assert table.loc["b", "total_energy_kj"] == 118.0
    assert (tmp_path / "agents.png").stat().st_size > 1000


@pytest.mark.slow
def test_policies_kept_on_the_way_are_evaluated_once(tmp_path) -> None:
    data = ("data.platoons=4", "data.recordings=2", "scenario.horizon=40", "experiment=smoke")
    small = ("agent.batch_size=64", "agent.hidden=[16,16]", "training.keep_every=1")
    folder = tmp_path / "ddpg" / "alcc" / "seed_0"
    training.run(load("train", [*data, *small]), folder, quiet=True)
    options = argparse.Namespace(out=tmp_path, overrides=[*data, *small])
    tool.evaluate_kept(options)
    kept = read_parquet(folder / "kept.parquet")
    assert kept["iteration"].tolist() == [1.0, 2.0, 3.0]
    # The last one is the policy of the run, evaluated on the same episodes.
    last = read_parquet(folder / "episodes.parquet")["total_energy_kj"].mean()
    assert kept["total_energy_kj"].iloc[-1] == pytest.approx(last, rel=1e-6)
    assert kept["total_energy_kj"].nunique() == 3
    (folder / "policies" / "000002.pt").unlink()
    tool.evaluate_kept(options)  # other policies than before
    assert read_parquet(folder / "kept.parquet")["iteration"].tolist() == [1.0, 3.0]
    for path in (folder / "policies").iterdir():
        path.unlink()
    tool.evaluate_kept(options)  # there is nothing to evaluate: what was done stays
    assert course(folder)["total_energy_kj"].notna().tolist() == [True, False, True]
    assert tool.main(["agents", "--draw", "--out", str(tmp_path)]) == 0


def test_what_knowledge_is_worth(tmp_path) -> None:
    fabricate(tmp_path / "none" / "seed_0", "alcc", 100.0, "agent=analytic")
    fabricate(tmp_path / "preview_5s" / "seed_0", "alcc", 90.0, "agent=analytic")
    assert tool.main(["knowledge", "--draw", "--out", str(tmp_path)]) == 0
    table = read_parquet(tmp_path / "knowledge.parquet").set_index("knowledge")
    assert table.loc["preview_5s", "saving_vs_none"] == pytest.approx(0.1)
    assert table["filtered_total_energy_kj"].isna().all()
    assert (tmp_path / "knowledge.png").stat().st_size > 1000


@pytest.mark.slow
def test_policies_are_put_behind_the_filter_once(tmp_path, monkeypatch) -> None:
    data = ["data.platoons=4", "data.recordings=2", "scenario.horizon=40", "experiment=smoke"]
    small = ["agent.batch_size=64", "agent.hidden=[16,16]"]
    folder = tmp_path / "none" / "seed_0"
    training.run(load("train", [*data, *small]), folder, quiet=True)
    fabricate(tmp_path / "idm", "idm", 120.0)
    options = argparse.Namespace(out=tmp_path, overrides=[*data, *small])
    tool.evaluate_filtered(options)
    behind = read_parquet(folder / "filtered.parquet")
    assert behind["share_ttc_unsafe"].tolist() == [0.0]
    assert behind["total_energy_kj"].notna().all()
    assert not (tmp_path / "idm" / "filtered.parquet").exists()
    monkeypatch.setattr(tool, "load_policy", None)  # nothing is read again
    tool.evaluate_filtered(options)
    assert tool.main(["knowledge", "--draw", "--out", str(tmp_path)]) == 0
    table = read_parquet(tmp_path / "knowledge.parquet").set_index("knowledge")
    own = table.loc["none", "filtered_total_energy_kj"]
    assert own == behind["total_energy_kj"].item()
    assert table.loc["none", "filtered_saving_vs_idm"] == pytest.approx(1 - own / 120.0)


@pytest.mark.parametrize("part", slow_but(["agents"], ["agents", "knowledge"]))
def test_every_run_it_would_start_composes(part, tmp_path) -> None:
    words = [part, "--seeds", "1", "--out", str(tmp_path), "experiment=smoke"]
    options, overrides = tool.parser().parse_known_args(words)
    options.overrides = overrides
    runs = [*tool.PARTS[part][0](options), tool.human(options)]
    assert len(runs) == {"agents": 4 * 2 + 1, "knowledge": 7}[part]
    assert len({run.folder for run in runs}) == len(runs)
    for run in runs:
        assert run.compose().scenario.horizon == 60


def test_nothing_finished(tmp_path) -> None:
    with pytest.raises(ResultsError, match="no finished training"):
        tool.main(["agents", "--draw", "--out", str(tmp_path)])


def test_only_a_human_is_finished(tmp_path) -> None:
    fabricate(tmp_path / "idm", "idm", 120.0)
    for name in ("training", "timing"):
        (tmp_path / "idm" / f"{name}.parquet").unlink()
    with pytest.raises(ResultsError, match="learns nothing"):
        tool.main(["agents", "--draw", "--out", str(tmp_path)])


def test_settings_of_filter_and_knowledge_are_not_those_of_a_human() -> None:
    given = ["+filter=cbf", "scenario.filters.automated.rate=2", "scenario.horizon=40", "~x.y"]
    assert tool.data_overrides(given) == ["scenario.horizon=40"]


@pytest.mark.parametrize("option", ["--jobs", "--seeds"])
def test_numbers_of_trainings(option, tmp_path) -> None:
    with pytest.raises(ConfigError, match="at least 1"):
        tool.main(["agents", option, "0", "--out", str(tmp_path)])


def test_a_typing_error_is_no_override(tmp_path) -> None:
    with pytest.raises(ConfigError, match="--sedes"):
        tool.main(["agents", "--sedes=3"])


def fabricate_limit(folder: Path, policy: str, share: float, energy: float, seed: int) -> None:
    place = folder / "alcc" / policy / f"limit_{share}" / f"seed_{seed}"
    save_config(compose("alcc", "agent=analytic", f"seed={seed}"), place)
    rows = pd.DataFrame(
        {
            "profile_id": [0, 0, 1, 1],
            "driver_id": [0, 1, 0, 1],
            "total_path_energy_kj": [energy, energy, energy + 4.0, energy + 4.0],
            "share_time_gap_long_moving": share,
            "leader_speed_mps": 5.0,
            "leader_path_energy_kj": 50.0,
            "strategy": "alcc",
        }
    )
    for name in set(MEANS) - set(rows):
        rows[name] = 0.0
    write_parquet(rows, place / "episodes.parquet")


def test_limits_are_compared_as_fronts_and_drawn_again_from_what_is_kept(tmp_path, capsys) -> None:
    for seed in (0, 1):
        for share, energy in ((0.005, 120.0), (0.02, 110.0)):
            fabricate_limit(tmp_path, "network", share, energy, seed)
            fabricate_limit(tmp_path, "idm", share, energy + 5.0, seed)
    assert tool.main(["limits", "--draw", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    # At 1 %: 116.67 + 2 against 121.67 + 2.
    assert "alcc network against alcc idm: 4.04% (3.98% … 4.11%)" in said
    kept = tmp_path / "kept"
    write_parquet(read_parquet(tmp_path / "windows.parquet"), kept / "windows.parquet")
    assert tool.main(["limits", "--draw", "--out", str(kept)]) == 0
    assert capsys.readouterr().out == said
    image = imread(kept / "limits.png")[..., :3].reshape(-1, 3)
    for hue in HUES["network"], HUES["idm"]:  # both lines are drawn
        assert (abs(image - to_rgb(hue)).max(1) < 0.05).sum() > 100
    with pytest.raises(ResultsError, match="no finished training below it"):
        tool.main(["limits", "--draw", "--out", str(tmp_path / "none")])


def test_what_the_limits_would_run() -> None:
    options = tool.parser().parse_args(["limits", "--seeds", "2", "--shares", "0.01"])
    options.overrides = ["data=stream"]
    runs = tool.runs_of_limits(options)
    assert len(runs) == 6
    configurations = [run.compose() for run in runs]
    learned = {
        (cfg.agent["policy"], cfg.agent["_target_"].split(".")[-1]) for cfg in configurations
    }
    assert learned == {("network", "Analytic"), ("idm", "Tuned"), ("idm", "Analytic")}
    for cfg in configurations:
        assert cfg.agent["limits"] == {"safety": None, "efficiency": 0.01}
        assert cfg.scenario.filters["automated"]["time_gap"] == 2.45
