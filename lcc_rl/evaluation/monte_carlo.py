"""Monte Carlo evaluation: every driver behind every profile, the same noise for every strategy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp

from lcc_rl.config import require
from lcc_rl.data.profiles import Profiles
from lcc_rl.envs.factory import any_leader, build_env
from lcc_rl.evaluation.metrics import energy_measures, safety_measures
from lcc_rl.functional.random import hash_bits
from lcc_rl.pieces.base import SEED
from lcc_rl.pieces.vehicles import Population

# What a strategy's episodes are measured by; those that a scenario lacks are left out.
RECORDED = ("speed", "gap", "acceleration", "power", "ttc", "time_gap", "jerk")
VEHICLES = ("leader", "cav", "hdv")
# What a step of a sample episode says of its episode.
SAMPLED = (
    "strategy",
    "training_seed",
    "profile",
    "driver_id",
    "desired_speed_mps",
    "time_gap_s",
)
Series = dict[tuple[str, str], Tensor]


@dataclass(frozen=True)
class Strategy:
    """A controller to evaluate.

    Args:
        name: how tables call it.
        cfg: configuration of its environment.
        policy: reads and writes a TensorDict; deterministic.
        seed: training seed, for the tables; None where nothing was learned.
    """

    name: str
    cfg: DictConfig
    policy: Any
    seed: int | None = None


def pairs(profiles: int, drivers: int, chosen: int | None) -> tuple[Tensor, Tensor]:
    """Pair every profile with every driver (or ``chosen`` drivers, spread evenly).

    Returns:
        Profile and driver ids, each ``[episodes]``, profiles slowest.
    """
    limit = drivers if chosen is None else min(chosen, drivers)
    ids = torch.from_numpy(np.linspace(0, drivers - 1, limit).round().astype(np.int64))
    profile, driver = torch.meshgrid(torch.arange(profiles), ids, indexing="ij")
    return profile.flatten(), driver.flatten()


def evaluate(
    strategy: Strategy,
    profiles: Profiles,
    population: Population,
    drivers: int | None,
    batch_size: int,
    seed: int,
    sample_episodes: int = 0,
    device: str = "cpu",
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Run every episode of one strategy.

    An episode's noise depends on ``seed`` and its profile and driver only: it is the same for
    every strategy, and the batch size changes a row by no more than rounding.

    Args:
        strategy: the controller and its environment's configuration.
        profiles: held-out windows.
        population: the drivers.
        drivers: how many of the population, spread evenly; None for all.
        batch_size: episodes side by side.
        seed: seed of the noise.
        sample_episodes: how many episodes to keep as time series.
        device: where to compute.

    Returns:
        One row per episode, and one row per step of the sample episodes.

    Raises:
        ConfigError: if the batch size is not positive.
    """
    require(batch_size >= 1, f"evaluation.batch_size must be at least 1, got {batch_size}")
    profile, driver = pairs(len(profiles), len(population.time_gap), drivers)
    cfg = any_leader(strategy.cfg)
    kept = set(np.linspace(0, len(profile) - 1, max(sample_episodes, 1)).round().astype(int))
    episodes, steps = [], []
    for start in range(0, len(profile), batch_size):
        part = slice(start, start + batch_size)
        env = build_env(cfg, profiles, population, len(profile[part]), 0, device)
        given = choices(env, profile[part], driver[part], seed, len(population.time_gap))
        series, alive = roll(env, strategy.policy, given)
        table = measure(series, alive, strategy.cfg.scenario.time_step)
        described = describe(strategy, profiles, population, profile[part], driver[part])
        episodes.append(pd.concat([described, table], axis=1))
        if sample_episodes:
            inside = [index - start for index in sorted(kept) if 0 <= index - start < len(table)]
            steps += list(sample(strategy, series, alive, episodes[-1], inside))
    trace = pd.concat(steps, ignore_index=True) if steps else pd.DataFrame()
    return pd.concat(episodes, ignore_index=True), trace


def choices(
    env: TransformedEnv, profile: Tensor, driver: Tensor, seed: int, drivers: int
) -> TensorDict:
    """Build what ``env.reset`` needs to play given profiles to given drivers."""
    batch = env.batch_size
    # Every episode gets its own stream. A string begins with the driver it is named after, those
    # of the next ids follow: every driver is met equally often in every place.
    number = profile * drivers + driver
    given = TensorDict(batch_size=batch, device=env.device)
    given.set(SEED, (hash_bits(number + seed * 0x9E3779B1) >> 1).unsqueeze(-1))
    given.set(("leader", "profile"), profile.unsqueeze(-1))
    given.set(("leader", "start"), torch.zeros_like(profile).unsqueeze(-1))
    spec = env.full_state_spec
    if ("cav", "gap_factor") in spec.keys(True):
        given.set(("cav", "gap_factor"), torch.ones(*batch, 1))
    shape = spec["hdv", "driver"].shape
    place = torch.arange(shape[-2]).unsqueeze(-1)
    given.set(("hdv", "driver"), (driver.view(-1, 1, 1) + place) % drivers)
    return given


def roll(env: TransformedEnv, policy: Any, given: TensorDictBase) -> tuple[Series, Tensor]:
    """Play all episodes of a batch to the horizon, without resets.

    Returns:
        The recorded entries, ``[time, *batch, …]`` (speeds ``[time + 1, …]``), and whether each
        step belongs to a running episode, ``[time, batch, 1]``.
    """
    with torch.no_grad():
        td = env.reset(given)
        keys = [
            (vehicle, entry)
            for vehicle in VEHICLES
            for entry in RECORDED
            if (vehicle, entry) in td.keys(True)
        ]
        record: dict[tuple[str, str], list[Tensor]] = {
            key: [td.get(key)] if key[1] == "speed" else [] for key in keys
        }
        running = torch.ones_like(td.get("done"))
        alive = []
        for _ in range(env.base_env.horizon):
            td = env.step(policy(td))
            for key in keys:
                record[key].append(td.get(("next", *key)))
            alive.append(running)
            running = running & ~td.get(("next", "terminated"))
            td = step_mdp(td)
    return {key: torch.stack(values) for key, values in record.items()}, torch.stack(alive)


def measure(series: Series, alive: Tensor, time_step: float) -> pd.DataFrame:
    """Turn the record of a batch into one row of measures per episode."""
    steps = alive.sum(0).squeeze(-1)
    columns: dict[str, Tensor] = {}
    for vehicle in ("cav", "hdv"):
        if (vehicle, "power") not in series:
            continue
        power, speed = series[vehicle, "power"], series[vehicle, "speed"]
        # A string of followers counts as one: its energies and distances add up.
        if vehicle == "hdv":
            parts = [
                energy_measures(power[..., i, :], speed[..., i, :], alive, time_step)
                for i in range(power.shape[-2])
            ]
            measures = {key: torch.stack([p[key] for p in parts]).sum(0) for key in parts[0]}
        else:
            measures = energy_measures(power, speed, alive, time_step)
        columns |= {f"{vehicle}_{key}": value for key, value in measures.items()}
    if ("cav", "gap") in series:
        own = {entry: series["cav", entry] for entry in ("gap", "ttc", "time_gap", "jerk")}
        columns |= safety_measures(own, alive, time_step)
        for key in ("energy_kj", "net_energy_kj", "steady_energy_kj", "acceleration_loss_kj"):
            columns[f"total_{key}"] = columns[f"cav_{key}"] + columns[f"hdv_{key}"]
    gap = series["hdv", "gap"].amin(-2)
    columns["hdv_min_gap_m"] = torch.where(alive, gap, torch.inf).amin(0)
    frame = pd.DataFrame({key: value.squeeze(-1).cpu().numpy() for key, value in columns.items()})
    lowest = [frame[key] for key in ("min_gap_m", "hdv_min_gap_m") if key in frame]
    frame["collided"] = np.minimum.reduce(lowest) <= 0.0
    frame["steps"] = steps.cpu().numpy()
    return frame


def describe(
    strategy: Strategy,
    profiles: Profiles,
    population: Population,
    profile: Tensor,
    driver: Tensor,
) -> pd.DataFrame:
    """Say which episodes a batch holds: strategy, profile and driver."""
    return pd.DataFrame(
        {
            "strategy": strategy.name,
            "training_seed": pd.array([strategy.seed] * len(profile), dtype="Int64"),
            "profile": [profiles.names[i] for i in profile.tolist()],
            "profile_id": profile.numpy(),
            "driver_id": driver.numpy(),
            "desired_speed_mps": population.desired_speed[driver].numpy(),
            "time_gap_s": population.time_gap[driver].numpy(),
        }
    )


def sample(
    strategy: Strategy, series: Series, alive: Tensor, episodes: pd.DataFrame, inside: list[int]
) -> Iterator[pd.DataFrame]:
    """Yield the time series of chosen episodes of a batch, one row per step."""
    time_step = strategy.cfg.scenario.time_step
    for index in inside:
        steps = int(alive[:, index].sum())
        frame = pd.DataFrame({"time_s": np.arange(1, steps + 1) * time_step})
        for (vehicle, entry), values in series.items():
            entries = values[-alive.shape[0] :][:steps, index].reshape(steps, -1)
            for place in range(entries.shape[1]):
                label = vehicle if entries.shape[1] == 1 else f"{vehicle}{place + 1}"
                frame[f"{label}_{entry}"] = entries[:, place].cpu().numpy()
        described = episodes[list(SAMPLED)].iloc[[index] * steps].reset_index(drop=True)
        yield pd.concat([described, frame], axis=1)
