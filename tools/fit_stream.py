"""Fit the stop-and-go leader of the synthetic stream to real car-following pairs.

    python tools/fit_stream.py --real i80_pairs.parquet

Prints the fitted parameters, which are then written into lcc_rl/data/stop_and_go.py by hand. The
search is a Nelder–Mead simplex over the parameters below; the objective is the fourth-power mean
of all deviations of lcc_rl.data.statistics.compare_statistics, averaged over a few seeds, plus
the distance between the autocorrelations of acceleration.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import minimize

from lcc_rl.calibration.population import DriverPopulation, bootstrap
from lcc_rl.data.statistics import compare_statistics, leader_statistics
from lcc_rl.data.stop_and_go import StopAndGo
from lcc_rl.data.stream import Lane

FITTED = (
    "mean_speed_mps",
    "level_spread_mps",
    "wave_spread_mps",
    "wave_s",
    "ripple_spread_mps",
    "ripple_s",
    "response_s",
)
LAGS_S = (0.5, 1.0, 1.5, 2.0, 3.0, 5.0)
RECORDINGS = 3


def episodes_of(lane: Lane, drivers: DriverPopulation, seed: int) -> pd.DataFrame:
    """Pairs of a stream, straight from the simulation."""
    parts = []
    for index in range(RECORDINGS):
        samples = lane.drive(drivers, str(index), np.random.default_rng([seed, index])).samples
        ahead = samples[["vehicle", "frame", "speed_mps"]]
        ahead = ahead.rename(columns={"vehicle": "preceding", "speed_mps": "leader_speed_mps"})
        pairs = samples.merge(ahead, on=["preceding", "frame"])
        parts.append(pairs.assign(episode=pairs["vehicle"] + 10_000 * index))
    return pd.concat(parts).rename(columns={"speed_mps": "follower_speed_mps"})


def autocorrelation(episodes: pd.DataFrame) -> NDArray[np.float64]:
    """Autocorrelation of the leaders' acceleration at ``LAGS_S``, of 10 Hz samples."""
    speed = episodes.groupby("episode")["leader_speed_mps"]
    acceleration = speed.diff().to_numpy(dtype=np.float64)
    number = episodes["episode"].to_numpy()
    found = []
    for lag in (round(10 * value) for value in LAGS_S):
        same = number[lag:] == number[:-lag]
        found.append(np.nanmean((acceleration[lag:] * acceleration[:-lag])[same]))
    return np.array(found) / np.nanmean(acceleration**2)


def main() -> None:
    """Fit and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--real", required=True, help="parquet table of real pairs")
    parser.add_argument("--seeds", type=int, default=3, help="streams per evaluation")
    parser.add_argument("--evaluations", type=int, default=200)
    arguments = parser.parse_args()
    real = pd.read_parquet(arguments.real).rename(columns={"event": "episode"})
    reference, rhythm = leader_statistics(real), autocorrelation(real)
    drivers = bootstrap()

    def distance(values: NDArray[np.float64]) -> float:
        if values.min() <= 0.05:
            return 10.0
        leader = replace(StopAndGo(), **dict(zip(FITTED, map(float, values), strict=True)))
        deviations, rhythms = [], []
        for seed in range(1000, 1000 + arguments.seeds):  # not the seeds that users meet
            episodes = episodes_of(Lane(leader=leader), drivers, seed)
            table = compare_statistics(reference, leader_statistics(episodes))
            deviations.append(table["deviation"].to_numpy(dtype=np.float64))
            rhythms.append(autocorrelation(episodes))
        deviation, beat = np.mean(deviations, axis=0), np.mean(rhythms, axis=0) - rhythm
        result = float(np.mean(deviation**4) ** 0.25 + 0.1 * np.abs(beat).mean())
        print(f"{result:.4f}", np.round(values, 3), np.round(beat, 2), flush=True)
        return result

    start = np.array([getattr(StopAndGo(), name) for name in FITTED])
    steps = np.diag(0.15 * start)
    options = {
        "maxfev": arguments.evaluations,
        "initial_simplex": start + np.vstack([0 * start, steps]),
    }
    best = minimize(distance, start, method="Nelder-Mead", options=options)
    for name, value in zip(FITTED, best.x, strict=True):
        print(f"{name}: {value:.2f}")


if __name__ == "__main__":
    main()
