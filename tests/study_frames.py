"""Shared by the tests of a study's results: small tables whose every number is known."""

from __future__ import annotations

import numpy as np
import pandas as pd

from lcc_rl.results.windows import Means

# Mean energies of the controlled car [kJ]: by training seed, the same for every driver.
CARS = {"idm": {None: 100.0}, "reference": {0: 80.0, 1: 90.0}, "alcc": {0: 88.0, 1: 84.0}}
HUMANS = {"direct": 60.0, "idm": 50.0, "reference": 50.0, "alcc": 40.0}


def episodes(drivers: int = 3, profiles: int = 2) -> pd.DataFrame:
    """An evaluation: the driver's number and the profile's shift energies by known amounts.

    The human driver draws 2 kJ more for each number of its own and 10 kJ more on each further
    profile; behind ``alcc`` driver 0 draws 20 kJ more than that.
    """
    rows = [
        row(strategy, seed, profile, driver)
        for strategy in ("direct", "idm", "alcc", "reference")
        for seed in CARS.get(strategy, {None: 0.0})
        for profile in range(profiles)
        for driver in range(drivers)
    ]
    frame = pd.DataFrame(rows)
    return frame.astype({"training_seed": "Int64"})


def windows(profiles: int = 2) -> pd.DataFrame:
    """The means of :func:`episodes` over the drivers."""
    return Means.of(episodes(profiles=profiles)).windows


def row(strategy: str, seed: int | None, profile: int, driver: int) -> dict[str, object]:
    extra = 20.0 if strategy == "alcc" and driver == 0 else 0.0
    human = HUMANS[strategy] + 2.0 * driver + 10.0 * profile + extra
    car = CARS[strategy][seed] if strategy in CARS else np.nan
    unsafe = 0.002 if (strategy, seed) == ("alcc", 1) else 0.0
    return {
        "strategy": strategy,
        "training_seed": seed,
        "profile": f"rec/{profile}@0.0s",
        "profile_id": profile,
        "driver_id": driver,
        "desired_speed_mps": 20.0 + driver,
        "time_gap_s": 1.0,
        "cav_energy_kj": car,
        "cav_path_energy_kj": car - 10.0,
        "hdv_energy_kj": human,
        "hdv_path_energy_kj": human - 10.0,
        "total_energy_kj": car + human,
        "total_path_energy_kj": car + human - 20.0,
        "total_steady_energy_kj": 0.8 * (car + human),
        "total_acceleration_loss_kj": 0.2 * (car + human),
        "cav_distance_m": 150.0 - 10.0 * (strategy == "alcc"),
        "hdv_distance_m": 150.0,
        "rms_jerk_mps3": 1.0 if seed is None else 1.0 + seed,
        "min_ttc_s": 5.0,
        "min_gap_m": 2.0,
        "share_ttc_unsafe": unsafe,
        "share_time_gap_long": 0.005,
        "share_time_gap_long_moving": 0.004,
        "leader_path_energy_kj": 30.0 + 10.0 * profile,
        "leader_speed_mps": 9.0 - profile,
        "collided": False,
    }


def training(iterations: int = 20) -> pd.DataFrame:
    """Learning curves that rise by one per iteration, those of seed 1 one lower."""
    number = np.arange(iterations, dtype=float)
    parts = [
        pd.DataFrame(
            {
                "variant": variant,
                "seed": seed,
                "iteration": number + 1,
                "episodes": 20 * (number + 1),
                "updates": 100 * (number + 1),
                "episode_reward": number - 100.0 - seed,
                "reward_safety": number - 80.0,
                "reward_efficiency": 0.0 * number,
                "reward_cav_energy": -20.0 + 0.0 * number,
                "reward_hdv_energy": -5.0 if variant == "alcc" else np.nan,
                "collisions": 0.0,
            }
        )
        for variant in ("alcc", "reference")
        for seed in (0, 1)
    ]
    return pd.concat(parts, ignore_index=True)
