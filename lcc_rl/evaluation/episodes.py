"""Evaluation with one row per episode: every driver behind every profile, the same noise for all.

Columns named ``cav_…`` belong to the automated vehicles of the string, ``hdv_…`` to all others;
energies and distances add up over them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig
from torch import Tensor
from torchrl.envs import TransformedEnv

from lcc_rl.config import require
from lcc_rl.data.profiles import Profiles
from lcc_rl.energy import Fleet, as_fleet, build_energy
from lcc_rl.envs import build_env
from lcc_rl.envs.inputs import Inputs, string_of
from lcc_rl.evaluation.metrics import KILO, energy_measures, measured_ttc, safety_measures
from lcc_rl.evaluation.rollout import Record, play, reset_options
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.functional.pattern import AUTOMATED, VehicleString
from lcc_rl.functional.string import gather
from lcc_rl.pieces.base import as_key
from lcc_rl.pieces.controllers import Population
from lcc_rl.pieces.features import CLASS
from lcc_rl.results.savings import LEADER, SOURCE
from lcc_rl.results.tables import FASTER

RECORDED = ("speed", "gap", "acceleration", "power", "ttc", "time_gap", "jerk")
SUMMED = (
    "energy_kj",
    "net_energy_kj",
    "steady_energy_kj",
    "acceleration_loss_kj",
    "path_energy_kj",
)
# What a step of a sample episode says of its episode.
SAMPLED = (
    "strategy",
    "training_seed",
    "profile",
    "driver_id",
    "desired_speed_mps",
    "time_gap_s",
)
KEYS = [("leader", name) for name in ("speed", "acceleration")]
KEYS += [("vehicles", name) for name in RECORDED]
INDEX, PROMISED = (AUTOMATED, "index"), (AUTOMATED, "promised")
# The record of each group of vehicles, ``[time, batch, n, 1]`` by entry.
Groups = dict[str, dict[str, Tensor]]


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
    inputs: Inputs,
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
        strategy: who drives, and its environment's configuration.
        inputs: held-out windows and drivers.
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
    profiles, count = inputs.evaluation, len(inputs.population.time_gap)
    profile, driver = pairs(len(profiles), count, drivers)
    samples = min(max(sample_episodes, 1), len(profile))
    kept = set(np.linspace(0, len(profile) - 1, samples).round().astype(int))
    cfg, time_step = any_leader(strategy.cfg), strategy.cfg.scenario.time_step
    energy = build_energy(cfg)
    episodes, steps = [], []
    for start in range(0, len(profile), batch_size):
        who = profile[start : start + batch_size], driver[start : start + batch_size]
        env = build_env(cfg, profiles, inputs.population, len(who[0]), 0, device, True)
        given = reset_options(env, *who, seed, count)
        keys = [*KEYS, INDEX, PROMISED, CLASS]
        record, alive = play(env, strategy.policy, given, keys, strategy.title)
        groups = grouped(record, string_of(cfg))
        described = describe(strategy, profiles, inputs.population, *who)
        described[FASTER] = leader_faster(profiles, who[0], desired_speeds(strategy, described))
        parts = [described, leader_measures(profiles, who[0], energy)]
        parts.append(measure(groups, alive, time_step, energy))
        table = pd.concat(parts, axis=1)
        episodes.append(table)
        if sample_episodes:
            inside = [index - start for index in sorted(kept) if 0 <= index - start < len(table)]
            steps += list(sample(groups, alive, table, inside, time_step))
    trace = pd.concat(steps, ignore_index=True) if steps else pd.DataFrame()
    return pd.concat(episodes, ignore_index=True), trace


def needed(
    env: TransformedEnv, cfg: DictConfig, inputs: Inputs, copies: int = 4
) -> dict[str, float]:
    """Return the bytes that the largest batch of an evaluation needs, by option.

    Args:
        env: an environment of the configuration with one episode.
        cfg: the configuration.
        inputs: what it is evaluated on.
        copies: of an entry: the steps, the record, the record of each group, its measures.
    """
    moment = env.reset()
    known = set(map(as_key, moment.keys(True, True)))
    size = sum(moment.get(key).nbytes for key in KEYS if key in known)
    settings, people = cfg.evaluation, len(inputs.population.time_gap)
    count = len(inputs.evaluation)
    if settings.rows == "episodes":
        count = min(count * min(settings.drivers or people, people), settings.batch_size)
    steps = cfg.scenario.horizon
    if settings.full_length and inputs.full_length and inputs.full_length.horizon > count * steps:
        count, steps = 1, inputs.full_length.horizon
    what = f"an evaluation of {count} episodes of {steps} steps side by side"
    return {what: count * copies * size * steps}


def any_leader(cfg: DictConfig) -> DictConfig:
    """Return a configuration without the one record that its leader may be told to play.

    That record is one to train on: with other profiles at hand its number means nothing.
    """
    cfg = cfg.copy()
    leader = cfg.scenario.pieces.get("leader")
    if leader is not None and "profile" in leader:
        leader.profile = None
    return cfg


def grouped(record: Record, string: VehicleString) -> Groups:
    """Divide the record of a string into that of its automated vehicles and of all others."""
    groups: Groups = {"leader": {}, "cav": {}, "hdv": {}}
    own = list(string.places(AUTOMATED))
    others = [place for place in range(len(string)) if place not in own]
    for (space, name), entry in record.items():
        if (space, name) == PROMISED:
            groups["cav"][name] = entry
        elif space == "leader":
            groups["leader"][name] = entry.unsqueeze(-2)
        elif space == "vehicles" and not string.drawn:
            for group, places in (("cav", own), ("hdv", others)):
                if places:
                    groups[group][name] = entry[..., places, :]
        elif space == "vehicles":
            index = record[INDEX][0]
            place = torch.arange(len(string), device=index.device)
            taken = (place == index.unsqueeze(-1)).any(-2)
            order = taken.int().argsort(stable=True, dim=-1)
            rest = order[..., : len(others)].sort(-1).values
            for group, chosen in (("cav", index), ("hdv", rest)):
                at = chosen.expand(entry.shape[0], *chosen.shape)
                groups[group][name] = gather(entry, at)
    return groups


def measure(
    groups: Groups, alive: Tensor, time_step: float, energy: Fleet | None = None
) -> pd.DataFrame:
    """Turn the record of a batch into one row per episode; energies add up over vehicles (A20)."""
    columns: dict[str, Tensor] = {}
    for group in ("cav", "hdv"):
        series = groups[group]
        if "power" not in series:
            continue
        kinds = series.get(CLASS[1])
        measures = energy_measures(
            series["power"],
            series["speed"],
            alive.unsqueeze(-2),
            time_step,
            energy,
            None if kinds is None else kinds[0],
        )
        for name, value in measures.items():
            added = value.mean(-2) if name.startswith("share_") else value.sum(-2)
            columns[f"{group}_{name}"] = added
    own = groups["cav"]
    if "gap" in own:
        columns |= safety_measures(own, alive.unsqueeze(-2), time_step)
        for name in SUMMED:
            keys = [f"{group}_{name}" for group in ("cav", "hdv")]
            parts = [columns[key] for key in keys if key in columns]
            if parts:
                columns[f"total_{name}"] = torch.stack(parts).sum(0)
    if "gap" in groups["hdv"]:
        gap = groups["hdv"]["gap"].amin(-2)
        columns["hdv_min_gap_m"] = torch.where(alive, gap, torch.inf).amin(0)
    frame = pd.DataFrame({key: value.squeeze(-1).cpu().numpy() for key, value in columns.items()})
    lowest = [frame[key] for key in ("min_gap_m", "hdv_min_gap_m") if key in frame]
    frame["collided"] = np.minimum.reduce(lowest) <= 0.0
    frame["steps"] = alive.sum(0).squeeze(-1).cpu().numpy()
    return frame


def describe(
    strategy: Strategy,
    profiles: Profiles,
    population: Population,
    profile: Tensor,
    driver: Tensor,
) -> pd.DataFrame:
    """Say which episodes a batch holds: strategy, profile, its source, and driver."""
    columns = {
        "strategy": strategy.name,
        "training_seed": pd.array([strategy.seed] * len(profile), dtype="Int64"),
        "profile": [profiles.names[i] for i in profile.tolist()],
        "profile_id": profile.numpy(),
        "driver_id": driver.numpy(),
        "desired_speed_mps": population.desired_speed[driver].numpy(),
        "time_gap_s": population.time_gap[driver].numpy(),
    }
    if profiles.sources:
        columns[SOURCE] = [profiles.sources[i] for i in profile.tolist()]
    return pd.DataFrame(columns)


def desired_speeds(strategy: Strategy, episodes: pd.DataFrame) -> np.ndarray:
    """Return v0 [m/s] by episode: that of the one driver of a strategy, or of the episode's."""
    controllers = strategy.cfg.scenario.controllers
    own = controllers.get(AUTOMATED) if string_of(strategy.cfg).count(AUTOMATED) else None
    given = None if own is None else own.get("desired_speed")
    drivers = episodes["desired_speed_mps"].to_numpy()
    return drivers if given is None else np.full_like(drivers, given)


def leader_faster(profiles: Profiles, profile: Tensor, desired: np.ndarray) -> np.ndarray:
    """Return the share of time in which the leader of each episode drives faster than v0."""
    ids, place = np.unique(profile.numpy(), return_inverse=True)
    shares = np.zeros(len(desired))
    for number, index in enumerate(ids):
        speeds = np.sort(profiles.record(int(index)).numpy())
        rows = place == number
        slower = np.searchsorted(speeds, desired[rows], side="right")
        shares[rows] = 1.0 - slower / len(speeds)
    return shares


def leader_measures(
    profiles: Profiles, profile: Tensor, energy: Fleet | None = None
) -> pd.DataFrame:
    """Return the path energy [kJ] and the mean speed [m/s] of the leader of each episode.

    The leader has the first energy model.
    """
    energy = as_fleet(energy)
    ids, place = np.unique(profile.numpy(), return_inverse=True)
    rows = []
    for index in ids:
        speed = profiles.record(int(index))
        power = energy.path_power(speed[:-1], speed.diff() / profiles.time_step)
        drawn = power.sum() * profiles.time_step * KILO
        rows.append((float(drawn), float(speed.mean())))
    return pd.DataFrame(np.array(rows)[place], columns=list(LEADER))


def sample(
    groups: Groups, alive: Tensor, episodes: pd.DataFrame, inside: list[int], time_step: float
) -> Iterator[pd.DataFrame]:
    """Yield the time series of chosen episodes of a batch, one row per step."""
    for index in inside:
        steps = int(alive[:, index].sum())
        columns: dict[str, np.ndarray] = {"time_s": np.arange(1, steps + 1) * time_step}
        for group, series in groups.items():
            for name, values in series.items():
                values = measured_ttc(values) if name == "ttc" else values
                rows = values[-alive.shape[0] :][:steps, index].reshape(steps, -1)
                for place in range(rows.shape[1]):
                    label = group if rows.shape[1] == 1 else f"{group}{place + 1}"
                    columns[f"{label}_{name}"] = rows[:, place].cpu().numpy()
        described = episodes[list(SAMPLED)].iloc[[index] * steps].reset_index(drop=True)
        yield pd.concat([described, pd.DataFrame(columns)], axis=1)
