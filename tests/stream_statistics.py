"""Statistics of speed, acceleration and energy of car-following episodes.

The same definitions hold for real and synthetic episodes. Speed: every sample of every episode.
Acceleration: forward difference of speed within an episode. Energy: the sum of P·T by A2 over
consecutive 30 s windows from the start of each episode; what remains of an episode is left out.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from lcc_rl.errors import DataError
from lcc_rl.functional.power import motor_power

QUANTILES = {"q05": 0.05, "q25": 0.25, "q50": 0.5, "q75": 0.75, "q95": 0.95}
WINDOW_S = 30.0
UNITS = {"speed": "m/s", "acceleration": "m/s²", "energy": "kJ"}
# Compared beside the quantiles; the mean of acceleration is close to zero.
LEVEL = {"speed": "mean", "acceleration": "std", "energy": "mean"}


def motion(episodes: pd.DataFrame, role: str = "leader") -> dict[str, NDArray[np.float64]]:
    """Collect speed, acceleration and 30 s energy over all episodes.

    Args:
        episodes: one row per sample: episode (or event), time_s, leader_speed_mps,
            follower_speed_mps.
        role: whose motion, ``leader`` or ``follower``.

    Returns:
        ``speed`` [m/s], ``acceleration`` [m/s²] and ``energy`` [kJ], each a flat array.

    Raises:
        DataError: if there is no episode of two samples.
    """
    frame = episodes.rename(columns={"event": "episode"}).sort_values(["episode", "time_s"])
    episode = frame["episode"].to_numpy()
    time, speed = (frame[x].to_numpy(np.float64) for x in ("time_s", f"{role}_speed_mps"))
    same = episode[1:] == episode[:-1]
    if not same.any():
        raise DataError("episode table: no episode has two samples")
    step = round(float(np.median(np.diff(time)[same])), 6)
    acceleration = (np.diff(speed) / step)[same]
    energy = _window_energy(episode[:-1][same], speed[:-1][same], acceleration, step)
    return {"speed": speed, "acceleration": acceleration, "energy": energy}


def leader_statistics(episodes: pd.DataFrame, role: str = "leader") -> pd.DataFrame:
    """Summarise the motion of all leaders or followers.

    Args:
        episodes, role: see :func:`motion`.

    Returns:
        One row per quantity (index ``speed`` [m/s], ``acceleration`` [m/s²], ``energy`` [kJ]);
        columns count, mean, std and the quantiles q05, q25, q50, q75, q95; NaN where an episode
        set has no window of 30 s.
    """
    rows = {name: _summary(values) for name, values in motion(episodes, role).items()}
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("quantity")


def compare_statistics(reference: pd.DataFrame, other: pd.DataFrame) -> pd.DataFrame:
    """Compare two tables of :func:`leader_statistics`.

    Args:
        reference: usually of real episodes.
        other: usually of synthetic ones.

    Returns:
        One row per compared number: quantity, statistic, unit, reference, other and deviation.
        The deviation of the mean speed, the standard deviation of acceleration and the mean
        energy is a share of the reference value; that of a quantile is a share of the 5–95 %
        span of the reference. NaN where the reference has no such scale, or no value.
    """
    rows = []
    for quantity, unit in UNITS.items():
        first, second = (table.loc[quantity].to_dict() for table in (reference, other))
        for statistic in (LEVEL[quantity], *QUANTILES):
            one, two = first[statistic], second[statistic]
            scale = one if statistic == LEVEL[quantity] else first["q95"] - first["q05"]
            deviation = (two - one) / scale if scale else np.nan
            rows.append((quantity, statistic, unit, one, two, deviation))
    columns = ["quantity", "statistic", "unit", "reference", "other", "deviation"]
    return pd.DataFrame(rows, columns=columns)


def _window_energy(
    episode: NDArray, speed: NDArray, acceleration: NDArray, step: float
) -> NDArray[np.float64]:
    """Energy of every complete window [kJ]."""
    power = motor_power(torch.from_numpy(speed), torch.from_numpy(acceleration)).numpy()
    table = pd.DataFrame({"episode": episode, "energy": power * step / 1000.0})
    length = round(WINDOW_S / step)
    window = table.groupby("episode", sort=False).cumcount() // length
    sums = table.groupby(["episode", window], sort=False)["energy"].agg(["sum", "size"])
    return sums.loc[sums["size"] == length, "sum"].to_numpy(dtype=np.float64)


def _summary(values: NDArray[np.float64]) -> dict[str, float]:
    if not len(values):
        return {"count": 0, **dict.fromkeys(("mean", "std", *QUANTILES), np.nan)}
    quantiles = zip(QUANTILES, np.quantile(values, [*QUANTILES.values()]), strict=True)
    return {"count": len(values), "mean": values.mean(), "std": values.std(), **dict(quantiles)}
