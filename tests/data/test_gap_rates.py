"""Gaps that do not change as the speeds say are refused: wrong units, exchanged vehicles."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from lcc_rl.data.plausible import Plausible, gap_rate
from lcc_rl.errors import ConfigError, DataError


def pairs(seconds: float = 60.0) -> pd.DataFrame:
    """Three episodes whose gap is the integral of the relative speed, with other offsets."""
    time = np.arange(0.0, seconds, 0.1)
    parts = []
    for episode in range(3):
        leader = 15 + 2 * np.sin(time / 3 + episode)
        follower = 15 + 2 * np.sin(time / 3 + episode - 0.7)
        relative = leader - follower
        way = np.append(0.0, np.cumsum((relative[1:] + relative[:-1]) * 0.05))
        parts.append(
            pd.DataFrame(
                {
                    "episode": episode,
                    "time_s": 100.0 * episode + time,
                    "leader_speed_mps": leader,
                    "follower_speed_mps": follower,
                    "gap_m": 20.0 + 5 * episode + way,
                }
            )
        )
    return pd.concat(parts, ignore_index=True)


def select(table: pd.DataFrame, limits: Plausible | None = None) -> pd.DataFrame:
    return (limits or Plausible()).select(table, "f.csv", lambda row, column: f"row {row}")[0]


def test_consistent_gaps_have_the_rate_one_also_with_a_biased_speedometer() -> None:
    table = pairs()
    assert gap_rate(table) == pytest.approx(1.0, abs=1e-6)
    table["leader_speed_mps"] += 1.5  # far more than what the relative speed varies by
    assert gap_rate(table) == pytest.approx(1.0, abs=1e-6)
    assert len(select(table)) == len(table)


@pytest.mark.parametrize(
    ("column", "factor", "said"),
    [
        (["leader_speed_mps", "follower_speed_mps"], 3.6, "0.28 m"),
        (["leader_speed_mps", "follower_speed_mps"], 2.23694, "0.45 m"),
        (["gap_m"], 3.28084, "3.28 m"),
    ],
)
def test_wrong_units_are_refused(column: list[str], factor: float, said: str) -> None:
    table = pairs()
    table[column] *= factor
    with pytest.raises(DataError, match=rf"f\.csv: gaps change by {said} where .*max_mismatch=1.5"):
        select(table, Plausible(max_speed=100.0))
    assert len(select(table, Plausible(max_speed=100.0, max_mismatch=4.0))) == len(table)


def test_leader_and_follower_exchanged_are_refused() -> None:
    names = {
        "leader_speed_mps": "follower_speed_mps",
        "follower_speed_mps": "leader_speed_mps",
    }
    with pytest.raises(DataError, match=r"gaps change by -1\.00 m"):
        select(pairs().rename(columns=names))


def test_little_data_or_none_of_the_columns_says_nothing() -> None:
    assert gap_rate(pairs(12.0)) is None
    assert gap_rate(pairs().drop(columns="gap_m")) is None
    assert gap_rate(pairs().iloc[:0]) is None
    with pytest.raises(ConfigError, match=r"max_mismatch"):
        Plausible(max_mismatch=0.5)
