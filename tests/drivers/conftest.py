"""Followers with known parameters behind leaders that reach free flow."""

import math

import numpy as np
import pandas as pd
import pytest
import torch

from lcc_rl.functional.driver_models import DriverConstants, simulate_follower
from lcc_rl.functional.laws import LAWS

STEP = 0.1


def build_episodes(
    desired_speed: list[float],
    time_gap: list[float],
    constants: DriverConstants | None = None,
    seconds: list[float] | None = None,
    model: str = "idm",
) -> pd.DataFrame:
    """Episodes of drivers whose leader swings, then speeds away at 38 m/s."""
    constants = constants or LAWS[model]()
    seconds = seconds or [60.0] * len(desired_speed)
    parts = []
    for driver, (v0, gap_s, length) in enumerate(
        zip(desired_speed, time_gap, seconds, strict=True)
    ):
        time = torch.arange(round(length / STEP) + 1, dtype=torch.float64) * STEP
        swing = 10.0 + 3.0 * torch.sin(2.0 * math.pi * time / (9.0 + driver % 5))
        leader = torch.maximum(swing, (10.0 + 1.5 * (time - 0.4 * length)).clamp(max=38.0))
        start = torch.tensor([9.0, 4.0 + 9.0 * gap_s], dtype=torch.float64)
        own = (torch.tensor(v0).double(), torch.tensor(gap_s).double())
        speed, gap, _ = simulate_follower(leader, start[0], start[1], *own, constants, STEP)
        parts.append(
            pd.DataFrame(
                {
                    "episode": driver,
                    "recording": "made",
                    "follower_id": 100 + driver,
                    "leader_id": 200 + driver,
                    "time_s": time.numpy(),
                    "follower_position_m": np.zeros(len(time)),
                    "follower_speed_mps": speed.numpy(),
                    "leader_position_m": gap.numpy() + 4.5,
                    "leader_speed_mps": leader.numpy(),
                    "leader_length_m": 4.5,
                    "gap_m": gap.numpy(),
                }
            )
        )
    return pd.concat(parts, ignore_index=True)


@pytest.fixture(scope="session")
def known_drivers() -> pd.DataFrame:
    """True parameters of 24 drivers."""
    generator = np.random.default_rng(5)
    return pd.DataFrame(
        {
            "desired_speed": generator.uniform(15, 30, 24),
            "time_gap": generator.uniform(0.7, 2.2, 24),
        }
    )


@pytest.fixture(scope="session")
def make_episodes():
    """Function that makes episodes of given (v0, T); see :func:`build_episodes`."""
    return build_episodes


@pytest.fixture(scope="session")
def uneven_lengths() -> pd.DataFrame:
    """Three episodes that end at different times."""
    return build_episodes([20.0, 25.0, 18.0], [1.0, 1.5, 2.0], seconds=[23.7, 40.0, 31.4])
