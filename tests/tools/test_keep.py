"""What is kept behind a page: sums per window and means per window and driver, by hand."""

from __future__ import annotations

import keep
import pandas as pd
import pytest
from study_frames import episodes

from lcc_rl.commands.evaluation import task_of
from lcc_rl.config import load
from lcc_rl.errors import ConfigError
from lcc_rl.io.files import write_parquet
from lcc_rl.results.fronts import NET
from lcc_rl.studies.hcfs.tables import LARGEST, SUMS, sources


def test_the_length_of_the_training_stands_beside_the_windows(tmp_path) -> None:
    for number in (400, 800):
        rows = pd.DataFrame(
            {
                "strategy": ["ddpg", "ddpg", "hcfs", "deadbeat", "ddpg"],
                "training_seed": pd.Series([0, 0, 0, None, 0], dtype="Int64"),
                "case": ["windows"] * 4 + ["case 1"],
                "profile": ["a", "a", "a", "a", "x"],
                "reward": [-1.0, -2.0, -number / 800, -9.0, -9.0],
            }
        )
        write_parquet(rows, tmp_path / str(number) / "episodes.parquet")
        table = pd.DataFrame({"episodes": [40, number]})
        write_parquet(table, tmp_path / str(number) / "training.parquet")
    words = ["lengths", *(str(tmp_path / name) for name in ("400", "800"))]
    assert keep.main([*words, "--out", str(tmp_path / "lengths.parquet")]) == 0
    kept = pd.read_parquet(tmp_path / "lengths.parquet")
    found = kept.set_index(["training_episodes", "strategy"])["reward"].to_dict()
    assert found == {
        (400, "ddpg"): -3.0,
        (400, "hcfs"): -0.5,
        (800, "ddpg"): -3.0,
        (800, "hcfs"): -1.0,
    }


def test_runs_behind_other_leaders_are_named_by_the_choice(tmp_path) -> None:
    strategies = ["cacc tuned", "ddpg", "hcfs", "hcfs oracle"]
    for choice, reward in (("better", -4.0), ("first", -2.0)):
        rows = pd.DataFrame({"strategy": strategies, "reward": [-8.0, -6.0, reward, -1.0]})
        rows["training_seed"] = pd.Series([None, 0, 0, 0], dtype="Int64")
        rows = rows.assign(**dict.fromkeys([*SUMS[:4], *SUMS[5:], *LARGEST], 0.5), case="windows")
        rows = rows.assign(profile="a", drive="a", run_id=0, min_gap_m=4.0, learned_share=0.0)
        rows = rows.assign(energy_kj_per_km=600.0 + rows["reward"])
        both = pd.concat([rows.assign(follower=1), rows.assign(follower=2, min_gap_m=3.0)])
        write_parquet(both.assign(source="cycles"), tmp_path / choice / "episodes.parquet")
        (tmp_path / choice / "config.yaml").write_text(f"deployed: {{choice: {choice}}}")
    path = tmp_path / "sources.parquet"
    assert keep.main(["sources", str(tmp_path), "--out", str(path)]) == 0
    kept = pd.read_parquet(path).set_index("strategy")
    sums = {"cacc tuned": -16.0, "ddpg": -12.0, "hcfs": -8.0, "hcfs first": -4.0}
    assert kept["reward"].to_dict() == sums
    assert set(kept["source"]) == {"cycles"}
    assert set(kept["min_gap_m"]) == {3.0}
    table = sources(kept.reset_index()).set_index("strategy")
    first = table.loc["HCFS, the first decides"]
    assert first["string ratio, above 1"] == "0.50, 0 of 1"
    # 598 against CACC's 592 kJ/km.
    assert first["energy saved_pct"] == pytest.approx(100 * (1 - 598 / 592))


def test_scores_by_source_and_speed_of_the_leader(tmp_path, monkeypatch) -> None:
    cfg = load("evaluate", ["task=i24-follow5", "compare=[idm]"])
    # Leader's mean speed, gap and energy of the network behind it; humans need 100 kJ.
    found = [(20.0, 110.0, 96.0), (29.1, 119.0, 99.0), (40.0, 121.0, 95.0)]
    rows = pd.DataFrame(
        [
            {
                "profile_id": number,
                "strategy": strategy,
                "leader_speed_mps": speed,
                "max_gap_m": gap,
            }
            | {"total_net_energy_kj": energy if strategy == "alcc" else 100.0, "driver_id": 0}
            for number, (speed, gap, energy) in enumerate(found)
            for strategy in ("human", "alcc")
        ]
    ).assign(source="i24", drive="a", training_seed=0, min_time_gap_s=1.2, collided=False)
    rows = rows.assign(cav_distance_m=1e3, hdv_distance_m=4e3)
    task = task_of(cfg)
    monkeypatch.setattr(keep.leaderboard, "task_scores", lambda folder: (cfg, task, rows, None))
    keep.classes([tmp_path], tmp_path / "classes.parquet")
    table = pd.read_parquet(tmp_path / "classes.parquet").set_index(["strategy", keep.FASTER])
    own = table.loc["alcc"]
    assert own["saving"].to_dict() == pytest.approx({15.0: 0.04, 29.0: 0.03})
    assert own["outside_max_gap_m"].to_dict() == {15.0: 0, 29.0: 1}
    assert own["windows"].to_dict() == {15.0: 1, 29.0: 2}


def test_fleets_by_setting_and_share(tmp_path, monkeypatch) -> None:
    cfg = load("evaluate", ["task=i24-mixed", "scenario.string={size: 4, penetration: 0.25}"])
    drivers = [(0, 100.0, 50.0), (1, 110.0, 70.0)]  # energy and gap
    rows = pd.DataFrame(
        [
            {"strategy": strategy, "driver_id": driver, NET: energy, "max_gap_m": gap}
            for strategy in ("human", "T_1.2", "alcc")
            for driver, energy, gap in drivers
        ]
    ).assign(profile_id=3, drive="a", min_time_gap_s=1.2, collided=False, flow_vph=2e3)
    rows = rows.assign(cav_distance_m=1e3, hdv_distance_m=3e3, training_seed=pd.NA)
    found = (cfg, task_of(cfg), rows, None)
    monkeypatch.setattr(keep.leaderboard, "task_scores", lambda folder: found)
    keep.fleets([tmp_path / "free_0.25"], tmp_path / "fleets.parquet")
    table = pd.read_parquet(tmp_path / "fleets.parquet").set_index("variant")
    assert table["limit"].to_dict() == pytest.approx({"human": 0.0, "idm_acc": 1.2, "learned": 0.0})
    assert set(table["setting"]) == {"free"}
    own = table.loc["learned", ["penetration", NET, "distance_m", "max_gap_m"]]
    assert own.tolist() == [0.25, 105.0, 4e3, 70.0]


def test_means_per_window_and_per_driver(tmp_path) -> None:
    rows = episodes(drivers=3, profiles=2)
    write_parquet(rows.assign(min_gap_m=rows["driver_id"] + 1.0), tmp_path / "episodes.parquet")
    assert keep.main(["means", str(tmp_path), "--out", str(tmp_path / "kept")]) == 0
    windows, drivers = (
        pd.read_parquet(tmp_path / "kept" / f"{name}.parquet") for name in ("windows", "drivers")
    )
    own = windows[(windows["strategy"] == "reference") & (windows["training_seed"] == 1)]
    # A human of 50 kJ, 2 more for each driver's number, 10 more on the second profile.
    assert own["hdv_energy_kj"].tolist() == [52.0, 62.0]
    assert own["min_gap_m"].tolist() == [1.0, 1.0]  # the least of the drivers, not their mean
    several = ["means", str(tmp_path), str(tmp_path), "--out", str(tmp_path / "other")]
    with pytest.raises(ConfigError, match="expected one folder, got 2"):
        keep.main(several)
    assert not (tmp_path / "other").exists()
    own = drivers[drivers["strategy"] == "reference"]
    assert own["hdv_energy_kj"].tolist() == [55.0, 57.0, 59.0]
    assert own["cav_energy_kj"].tolist() == [85.0] * 3
