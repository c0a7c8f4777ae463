"""Shared by the tests: small profiles whose motion is known, and composed environments."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from omegaconf import DictConfig
from torchrl.envs import TransformedEnv

from lcc_rl.config import load
from lcc_rl.data.profiles import Profiles, from_records
from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs import build_env

PLATOON = ("cacc", "ddpg", "deadbeat", "hcfs")
VARIANTS = ("alcc", "reference", "own_energy", "cbf", "idm", "direct", *PLATOON)
POPULATION = bootstrap()


def wavy_profiles(count: int = 4, samples: int = 400) -> Profiles:
    """Leaders between 2 and 14 m/s whose acceleration stays below 2 m/s²."""
    time = torch.arange(samples) * 0.1
    records = [
        8.0 + 4.0 * torch.sin(time / (3.0 + i) + i) + 2.0 * torch.sin(time / 5.0 + 2 * i)
        for i in range(count)
    ]
    names = [f"rec{i % 2}/{i}@0.0s" for i in range(count)]
    return from_records(records, names, [f"rec{i % 2}" for i in range(count)], 0.1)


def compose(variant: str = "alcc", *overrides: str) -> DictConfig:
    """Compose the configuration of a training with short episodes."""
    return load("train", [f"variant={variant}", "scenario.horizon=20", *overrides])


def small_env(
    variant: str = "alcc",
    batch_size: Sequence[int] | int = (),
    overrides: Sequence[str] = (),
    seed: int = 0,
) -> TransformedEnv:
    """Build an environment on the wavy profiles and the shipped drivers."""
    cfg = compose(variant, *overrides)
    return build_env(cfg, wavy_profiles(), POPULATION, batch_size, seed)
