"""Whether the gaps of car-following episodes change as the speeds say."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

WINDOW = 5.0  # over which changes are compared: noise of single samples averages out [s]
LEAST_WINDOWS, LEAST_CHANGE = 20, 0.5  # fewer, or smaller ones [m], say nothing
NEEDED = {"episode", "time_s", "gap_m", "follower_speed_mps", "leader_speed_mps"}


def gap_rate(episodes: pd.DataFrame) -> float | None:
    """Return by how much gaps change where the speeds say 1.

    The slope of a least-squares fit of changes of the gap over windows of 5 s on the integral of
    the relative speed, both without their mean over the episode, which a calibration error of
    speedometers may be.

    Args:
        episodes: rows of an episode lie together, in order of time: episode, time_s, gap_m,
            follower_speed_mps, leader_speed_mps.

    Returns:
        The slope, 1 for consistent data; None where a column is missing or too little changes.
    """
    if not set(episodes.columns) >= NEEDED or episodes.empty:
        return None
    episode = episodes["episode"].to_numpy()
    first = np.append(True, episode[1:] != episode[:-1])
    time, gap, leader, follower = (
        episodes[name].to_numpy(np.float64)
        for name in ("time_s", "gap_m", "leader_speed_mps", "follower_speed_mps")
    )
    relative = leader - follower
    step = np.where(first, 0.0, np.diff(time, prepend=time[0]))
    way = np.cumsum(step * (relative + np.roll(relative, 1)) / 2)
    number = np.cumsum(first) - 1
    window = np.floor((time - time[first][number]) / WINDOW)
    marks = np.flatnonzero(first | (np.diff(window, prepend=0.0) != 0))
    same = np.diff(number[marks]) == 0
    group = number[marks][1:][same]
    said = _centred(np.diff(way[marks])[same], group)
    seen = _centred(np.diff(gap[marks])[same], group)
    enough = len(said) >= LEAST_WINDOWS and np.sqrt(np.mean(said**2)) >= LEAST_CHANGE
    return float(said @ seen / (said @ said)) if enough else None


def _centred(values: NDArray[np.float64], group: NDArray[np.int64]) -> NDArray[np.float64]:
    """Values without the mean of their group."""
    count = np.maximum(np.bincount(group), 1)
    return values - (np.bincount(group, values) / count)[group]
