"""A ring road: a stop-and-go wave grows by itself, and one vehicle that knows better ends it.

Sugiyama et al. (2008) had 22 drivers on 230 m, Stern et al. (2018) 260 m and one vehicle with a
rule that absorbs the wave.
"""

from __future__ import annotations

import pytest
import torch
from helpers import composed, play, string
from torch import Tensor

from lcc_rl.envs import build_env
from lcc_rl.envs.inputs import constant_profiles

RING = ("variant=reference", "scenario=ring", "agent=none", "drivers=ring")
SPEED = ("vehicles", "speed")
# The one vehicle: a human driver like all others until 300 s.
HANDOVER = (string("automated human*21"), "controller@scenario.controllers.automated=handover")


def speeds(seconds: float, circumference: float, *overrides: str) -> Tensor:
    """Play four episodes; speeds ``[time + 1, 4, 22]`` [m/s]."""
    steps = round(seconds / 0.1)
    sizes = [f"scenario.horizon={steps}", f"scenario.circumference={circumference}"]
    cfg = composed(*RING, string("human*22"), *overrides, *sizes)
    population = cfg.drivers.made()
    env = build_env(cfg, constant_profiles(0.0, steps, 0.1, ["ring"]), population, 4)
    record, alive = play(env, None, None, [SPEED, ("vehicles", "gap")])
    assert alive.all()  # no collision
    # What is gained by one gap another one loses.
    total = record["vehicles", "gap"].squeeze(-1).sum(-1)
    torch.testing.assert_close(
        total, torch.full_like(total, circumference - 110.0), rtol=1e-3, atol=0
    )
    return record[SPEED].squeeze(-1)


def spread(speed: Tensor, first: float, last: float) -> Tensor:
    """Standard deviation over the vehicles, averaged over a time, of each episode [m/s]."""
    return speed[round(10 * first) : round(10 * last)].std(-1).mean(0)


@pytest.mark.slow
@pytest.mark.parametrize("circumference", [230.0, 260.0])
def test_a_wave_grows_by_itself(circumference) -> None:
    speed = speeds(300.0, circumference)
    assert spread(speed, 0.0, 10.0).max() < 0.2
    assert spread(speed, 250.0, 300.0).mean() > 1.5
    # It stops drivers altogether.
    assert speed[2500:].amin() == 0.0


def test_one_vehicle_of_22_ends_a_wave() -> None:
    # More noise, so that the wave is there after 200 s; the noise alone makes 0.12 m/s.
    noisy = "scenario.controllers.human.wiener=0.1"
    early = "scenario.controllers.automated.from_s=200"
    speed = speeds(300.0, 260.0, *HANDOVER, noisy, early)
    assert spread(speed, 190.0, 200.0).mean() > 1.5
    assert spread(speed, 290.0, 300.0).mean() < 0.1 * spread(speed, 190.0, 200.0).mean()
