"""Where vehicles are follows from stored speeds and gaps, on roads, rings and in platoons."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from lcc_rl.errors import ResultsError
from lcc_rl.results.motion import motion_of, sample_episodes, visited

OPEN = {"string": "automated human", "road": "open", "circumference": None, "vehicle_length": 5.0}
RING = {**OPEN, "road": "ring", "circumference": 40.0}
TIME = 0.5 * np.arange(1, 5)


def rows(**more) -> pd.DataFrame:
    table = {"strategy": "alcc", "training_seed": pd.NA, "profile": "p", "driver_id": 0}
    table |= {"time_s": TIME, "leader_speed": 10.0}
    table |= {"cav_speed": 8.0, "cav_gap": 7.0, "hdv_speed": 6.0, "hdv_gap": 9.0}
    return pd.DataFrame({**table, **more})


def test_vehicles_stand_behind_the_leader_by_gaps_and_lengths() -> None:
    motion = motion_of(rows(), OPEN)
    assert motion.roles == ("automated", "human")
    assert motion.front.tolist() == [0.0, 5.0, 10.0, 15.0]
    assert motion.position[0].tolist() == [-12.0, -26.0]
    assert motion.ahead[0].tolist() == [10.0, 8.0]
    assert visited(motion)[0].tolist() == [8.0, 7.0, 2.0]


def test_on_a_ring_the_first_follows_the_last() -> None:
    # 40 m hold both vehicles and both gaps.
    motion = motion_of(rows(leader_speed=np.nan, hdv_gap=23.0), RING)
    assert motion.leader is None
    assert motion.position[:, 0].tolist() == [0.0, 4.0, 8.0, 12.0]
    around = motion.position[:, 0] + 12.0 - motion.position[:, 1]
    assert around == pytest.approx(40.0)
    assert motion.ahead[0].tolist() == [6.0, 8.0]


def test_a_baseline_without_automated_vehicles_has_fewer() -> None:
    motion = motion_of(rows(cav_speed=np.nan, cav_gap=np.nan), OPEN)
    assert motion.roles == ("human",)
    assert motion.speed.tolist() == [[6.0]] * 4


def test_drawn_places_are_read_and_missed() -> None:
    drawn = {**OPEN, "string": {"size": 2, "penetration": 0.5}}
    assert motion_of(rows(cav_place=1), drawn).roles == ("human", "automated")
    with pytest.raises(ResultsError, match="places"):
        motion_of(rows(), drawn)


def test_a_platoon_has_a_row_per_vehicle() -> None:
    table = pd.DataFrame(
        {
            "strategy": "hcfs",
            "case": "case 1",
            "time_s": np.repeat(TIME, 3),
            "follower": np.tile([0, 1, 2], 4),
            "speed_mps": np.tile([4.0, 3.0, 2.0], 4),
            "gap_m": np.tile([np.nan, 5.0, 6.0], 4),
        }
    )
    episodes = sample_episodes(table, "hcfs")
    motion = motion_of(episodes["case 1"], {**OPEN, "string": "automated*6"})
    assert motion.roles == ("automated", "automated")
    assert motion.position[0].tolist() == [-10.0, -21.0]
    assert motion.ahead[0].tolist() == [4.0, 3.0]


def test_sample_episodes_are_of_one_seed_and_missing_ones_are_said() -> None:
    both = pd.concat([rows(training_seed=seed, profile=name) for seed in (3, 1) for name in "ab"])
    found = sample_episodes(both, "alcc")
    assert list(found) == ["profile a, driver 0", "profile b, driver 0"]
    assert all((part["training_seed"] == 1).all() for part in found.values())
    with pytest.raises(ResultsError, match="no sample episode of idm"):
        sample_episodes(both, "idm")
    with pytest.raises(ResultsError, match="no sample episode"):
        sample_episodes(pd.DataFrame(), "alcc")


def test_rows_that_lack_vehicles_are_refused() -> None:
    with pytest.raises(ResultsError, match="lacks vehicles"):
        motion_of(rows(), {**OPEN, "string": "automated*3 human"})
