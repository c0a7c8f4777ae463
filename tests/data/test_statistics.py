"""Leader statistics by hand-computed values."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from lcc_rl.data.statistics import compare_statistics, leader_statistics, motion
from lcc_rl.errors import DataError


def table(speeds: list[np.ndarray], step: float = 0.1) -> pd.DataFrame:
    parts = [
        pd.DataFrame(
            {
                "episode": number,
                "time_s": 7.0 + step * np.arange(len(speed)),
                "leader_speed_mps": speed,
                "follower_speed_mps": speed / 2,
            }
        )
        for number, speed in enumerate(speeds)
    ]
    return pd.concat(parts, ignore_index=True)


def test_energy_of_constant_speed_is_power_times_time() -> None:
    found = motion(table([np.full(750, 10.0)]))
    power = 110.3 + 422.9 * 10 - 0.0279 * 100 + 0.3557 * 1000
    assert found["energy"] == pytest.approx([power * 30 / 1000] * 2)  # 74.9 s hold two windows


def test_neither_acceleration_nor_window_crosses_an_episode() -> None:
    found = motion(table([np.full(200, 1.0), np.full(301, 9.0), np.full(300, 3.0)]))
    assert not found["acceleration"].any()
    assert [len(found[x]) for x in ("acceleration", "speed", "energy")] == [798, 801, 1]
    found = motion(table([np.array([1.0, 1.4, 1.2])], step=0.2))
    assert found["acceleration"] == pytest.approx([2.0, -1.0])
    with pytest.raises(DataError, match="no episode"):
        motion(table([np.ones(1)]))


def test_order_and_names_of_the_rows_do_not_matter() -> None:
    episodes = table([np.linspace(0, 9, 400), np.linspace(5, 1, 350)])
    shuffled = episodes.sample(frac=1.0, random_state=1).rename(columns={"episode": "event"})
    pd.testing.assert_frame_equal(leader_statistics(episodes), leader_statistics(shuffled))
    leader, follower = leader_statistics(episodes), leader_statistics(episodes, "follower")
    assert follower.loc["speed", "q75"] == pytest.approx(leader.loc["speed", "q75"] / 2)


def test_deviation_is_relative_to_the_level_or_to_the_span() -> None:
    one = leader_statistics(table([np.linspace(0, 10, 401)]))
    two = leader_statistics(table([np.linspace(1, 11, 401)]))
    deviation = compare_statistics(one, two).set_index(["quantity", "statistic"])["deviation"]
    assert deviation["speed", "mean"] == pytest.approx(1 / 5)
    assert deviation["speed", "q25"] == pytest.approx(1 / 9)
    assert len(deviation) == 18
    short = leader_statistics(table([np.full(50, 3.0)])).loc["energy"]
    assert (short["count"], np.isnan(short["mean"])) == (0, True)
