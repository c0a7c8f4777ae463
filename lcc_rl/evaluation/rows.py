"""Rows of episodes.parquet from the record of a batch of episodes.

Columns ``cav_…`` belong to the automated vehicles of the string, ``hdv_…`` to all others; energies
and distances are summed over them.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterator, Mapping

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from lcc_rl.arrays import times
from lcc_rl.config.words import RECORDED
from lcc_rl.data.profiles import Profiles
from lcc_rl.energy import AVERAGED, BURNT, SECOND, Fleet
from lcc_rl.evaluation import metrics
from lcc_rl.evaluation.rollout import Record
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.functional.pattern import AUTOMATED, VehicleString
from lcc_rl.functional.string import gather
from lcc_rl.pieces.controllers import Population
from lcc_rl.pieces.features import CLASS, GRADE
from lcc_rl.pieces.slope import Slope
from lcc_rl.pieces.string import COMMAND, WANTED
from lcc_rl.results.windows import DRIVE, LEADER_COLUMNS, REPEAT, SOURCE, START

SUMMED = (
    "energy_kj",
    "net_energy_kj",
    "steady_energy_kj",
    "acceleration_loss_kj",
    "path_energy_kj",
    *AVERAGED,
    *BURNT,
    SECOND,
)
# Columns of an episode that are repeated in the steps of a sample episode.
SAMPLED = (
    "strategy",
    "training_seed",
    "profile",
    "driver_id",
    REPEAT,
    "desired_speed_mps",
    "time_gap_s",
)
VALUE_BYTES = 4  # of a value in a time series
ROW_KEYS = [("leader", name) for name in ("speed", "acceleration")]
ROW_KEYS += [("vehicles", name) for name in (*metrics.SERIES, GRADE)]
INDEX = (AUTOMATED, "index")
# Safety filter: steps covered by the guarantee, steps that begin safe, desired and commanded
# acceleration.
FILTER_ENTRIES = tuple((AUTOMATED, name) for name in ("promised", "safe", WANTED, COMMAND))
# The record of each group of vehicles, ``[time, batch, n, 1]`` by entry.
Groups = dict[str, dict[str, Tensor]]


def grouped(record: Record, string: VehicleString) -> Groups:
    """Divide a record into those of the leader, the automated vehicles and all others.

    The record of automated vehicles includes their places in the string, 0 at the front.
    """
    groups: Groups = {"leader": {}, "cav": {}, "hdv": {}}
    cav = list(string.places(AUTOMATED))
    hdv = [place for place in range(len(string)) if place not in cav]
    for (space, name), entry in record.items():
        if (space, name) in FILTER_ENTRIES:
            groups["cav"][name] = entry
        elif space == "leader":
            groups["leader"][name] = entry.unsqueeze(-2)
        elif space == "vehicles" and not string.drawn:
            for group, places in (("cav", cav), ("hdv", hdv)):
                if places:
                    groups[group][name] = entry[..., _slice(places), :]
            if cav:
                groups["cav"]["place"] = torch.tensor(cav).expand(*entry.shape[:2], len(cav))
        elif space == "vehicles":
            index = record[INDEX][0]
            place = torch.arange(len(string), device=index.device)
            automated = (place == index.unsqueeze(-1)).any(-2)
            order = automated.int().argsort(stable=True, dim=-1)
            rest = order[..., : len(hdv)].sort(-1).values
            groups["cav"]["place"] = record[INDEX]
            for group, chosen in (("cav", index), ("hdv", rest)):
                at = chosen.expand(entry.shape[0], *chosen.shape)
                groups[group][name] = gather(entry, at)
    return groups


def _slice(places: list[int]) -> slice | list[int]:
    """Return consecutive places as a slice, which needs no copy."""
    first, end = places[0], places[-1] + 1
    return slice(first, end) if len(places) == end - first else places


def highest(record: Record) -> dict[str, Tensor]:
    """Return the leader's highest speed until each time [m/s], by name; none on a ring."""
    speed = record.get(("leader", "speed"))
    return {} if speed is None else {"leader_highest": speed.cummax(0).values.unsqueeze(-2)}


def measures(
    groups: Groups,
    alive: Tensor,
    time_step: float,
    energy: Fleet,
    averaged: bool,
    second: Fleet | None,
    ahead: Mapping[str, Tensor],
) -> dict[str, Tensor]:
    """Return the measures of a batch, each ``[batch, 1]``; energies are sums over vehicles (A20).

    Args:
        groups: the record of each group of vehicles.
        alive: whether each step belongs to a running episode, ``[time, batch, 1]``.
        time_step: duration of a step [s].
        energy: the energy models.
        averaged: include energies of averaged speeds.
        second: a further energy model, for :data:`lcc_rl.energy.SECOND`.
        ahead: see :func:`highest`, may begin before the counted time.
    """
    columns: dict[str, Tensor] = {}
    for group in ("cav", "hdv"):
        series = groups[group]
        if "power" not in series:
            continue
        kinds = series.get(CLASS[1])
        kind, grade = None if kinds is None else kinds[0], series.get(GRADE)
        args = alive.unsqueeze(-2), time_step, energy, kind, grade
        energies = metrics.energy_measures(series["power"], series["speed"], *args)
        if second is not None:
            speed = series["speed"]
            power = second.at(grade).power(speed[:-1], speed.diff(dim=0) / time_step)
            drawn = metrics.energy_measures(power, speed, *args[:2], second, grade=grade)
            energies[SECOND] = drawn["path_energy_kj"]
        energies |= metrics.averaged_energies(series["speed"], *args) if averaged else {}
        for name, value in energies.items():
            added = value.mean(-2) if name.startswith("share_") else value.sum(-2)
            columns[f"{group}_{name}"] = added
    cav = groups["cav"]
    if "gap" in cav:
        counted = {name: x[-len(alive) - 1 :] for name, x in ahead.items()}
        columns |= metrics.safety_measures({**cav, **counted}, alive.unsqueeze(-2), time_step)
        for name in SUMMED:
            keys = [f"{group}_{name}" for group in ("cav", "hdv")]
            terms = [columns[key] for key in keys if key in columns]
            if terms:
                columns[f"total_{name}"] = torch.stack(terms).sum(0)
    if "gap" in groups["hdv"]:
        gap = groups["hdv"]["gap"].amin(-2)
        columns["hdv_min_gap_m"] = torch.where(alive, gap, torch.inf).amin(0)
    return {**columns, "steps": alive.sum(0)}


def nullable(frame: pd.DataFrame, names: Collection[Hashable] | None = None) -> pd.DataFrame:
    """Return a table whose integers, all or those of some columns, may be null, without floats."""
    kept = [x for x in frame.select_dtypes("integer") if names is None or x in names]
    return frame.astype(dict.fromkeys(kept, "Int64"))


def as_frame(columns: dict[str, Tensor], collided: Tensor) -> pd.DataFrame:
    """Return the measures of a batch as one row per episode.

    The measures of an episode that ended in a collision before the counted time are NaN.
    """
    frame = pd.DataFrame({key: value.squeeze(-1).cpu().numpy() for key, value in columns.items()})
    if (frame["steps"] == 0).any():
        frame = nullable(frame).where(frame["steps"] > 0).assign(steps=frame["steps"])
    frame.insert(len(frame.columns) - 1, "collided", collided.squeeze(-1).cpu().numpy())
    return frame


def brakings(record: Record, alive: Tensor, string: VehicleString) -> pd.DataFrame:
    """Return the hardest braking of the leader and of the automated vehicles by episode [m/s²].

    The uncounted time is included, since collisions count there, too.
    """
    groups, columns = grouped(record, string), {}
    for name, group in (("max_leader_braking_mps2", "leader"), ("max_braking_mps2", "cav")):
        if (motion := groups[group].get("acceleration")) is not None:
            hardest = torch.where(alive.unsqueeze(-2), -motion[-len(alive) :], -torch.inf)
            columns[name] = hardest.amax((0, -2)).squeeze(-1).clamp(min=0.0).cpu().numpy()
    return pd.DataFrame(columns)


def traffic(
    record: Record, alive: Tensor, length: float, time_step: float, free: Tensor, fleet: Fleet
) -> dict[str, Tensor]:
    """Return measures of the whole string, each ``[batch, 1]``.

    These are :func:`string_measures` and :data:`ROAD_METRICS`. ``free`` is v0 by episode
    ``[batch]``, ``length`` that of vehicles without a class [m].
    """
    steps, leader = len(alive), record.get(("leader", "speed"))
    series = {name: entry for (space, name), entry in record.items() if space == "vehicles"}
    series["free"] = free.to(alive.device).view(-1, 1, 1)
    mean: float | Tensor = length
    if CLASS in record:
        kinds = record[CLASS][0]
        series["free"] = torch.minimum(series["free"], fleet.speed_limits(kinds))
        mean = length + (fleet.lengths(kinds) - length).mean(-2)
    columns = metrics.safety_measures(series, alive.unsqueeze(-2), time_step, metrics.ROAD_METRICS)
    return columns | metrics.string_measures(
        record["vehicles", "speed"][-steps:],
        record["vehicles", "gap"],
        alive,
        mean,
        None if leader is None else leader[-steps:],
    )


def describe(
    strategy: Strategy,
    profiles: Profiles,
    population: Population,
    profile: Tensor,
    driver: Tensor,
    repeat: Tensor | None,
) -> pd.DataFrame:
    """Return strategy, profile, driver and repeat of every episode of a batch."""
    columns = {
        **strategy.labels(len(profile)),
        "profile": [profiles.names[i] for i in profile.tolist()],
        "profile_id": profile.numpy(),
        DRIVE: [profiles.recordings[i] for i in profile.tolist()],
        "driver_id": driver.numpy(),
        **({} if repeat is None else {REPEAT: repeat.numpy()}),
        "desired_speed_mps": population.desired_speed[driver].numpy(),
        "time_gap_s": population.time_gap[driver].numpy(),
    }
    for name, values in ((SOURCE, profiles.sources), (START, profiles.starts)):
        columns |= {name: [values[i] for i in profile.tolist()]} if values else {}
    return pd.DataFrame(columns)


def desired_speeds(strategy: Strategy, episodes: pd.DataFrame) -> np.ndarray:
    """Return v0 [m/s] by episode: the strategy's or the driver's; NaN for recorded drivers."""
    controllers = strategy.cfg.scenario.controllers
    controller = controllers.get(AUTOMATED) if strategy.cfg.automated else None
    speed = None if controller is None else controller.settings.get("desired_speed")
    if strategy.name == RECORDED:
        speed = np.nan
    drivers = episodes["desired_speed_mps"].to_numpy()
    return drivers if speed is None else np.full_like(drivers, speed)


def leader_faster(
    profiles: Profiles, profile: Tensor, desired: np.ndarray, first: int = 0
) -> np.ndarray:
    """Return the share of time in which the leader of each episode drives faster than v0 [m/s].

    The first step that counts is ``first``.
    """
    shares = np.zeros(len(desired))
    for index in profile.unique().tolist():
        speeds, rows = profiles.record(index)[first:].numpy(), (profile == index).numpy()
        shares[rows] = (speeds[:, None] > desired[rows]).mean(0)
    return np.where(np.isnan(desired), np.nan, shares)


def leader_measures(
    profiles: Profiles, profile: Tensor, fleet: Fleet, first: int, slope: Slope | None
) -> pd.DataFrame:
    """Return the path energy [kJ] and the mean speed [m/s] of the leader of each episode.

    The leader has the first energy model. The first step that counts is ``first``.
    """
    values = {}
    for index in profile.unique().tolist():
        speed = profiles.record(index)
        grade = None if slope is None else slope.along(speed)[first:]
        speed = speed[first:]
        power = fleet.at(grade).path_power(speed[:-1], speed.diff() / profiles.time_step)
        drawn = power.sum() * profiles.time_step * metrics.KILO
        values[index] = (float(drawn), float(speed.mean()))
    return pd.DataFrame([values[index] for index in profile.tolist()], columns=list(LEADER_COLUMNS))


def sample(
    groups: Groups, alive: Tensor, episodes: pd.DataFrame, inside: list[int], time_step: float
) -> Iterator[pd.DataFrame]:
    """Yield the time series of chosen episodes of a batch, one row per step."""
    for index in inside:
        steps = int(alive[:, index].sum())
        columns: dict[str, np.ndarray] = {"time_s": times(np.arange(1, steps + 1), time_step)}
        for group, series in groups.items():
            for name, values in series.items():
                rows = values[-alive.shape[0] :][:steps, index].flatten(1)
                rows = metrics.measured_ttc(rows) if name == "ttc" else rows
                for place in range(rows.shape[1]):
                    label = group if rows.shape[1] == 1 else f"{group}{place + 1}"
                    columns[f"{label}_{name}"] = rows[:, place].cpu().numpy()
        names = [name for name in SAMPLED if name in episodes]
        described = episodes[names].iloc[[index] * steps].reset_index(drop=True)
        yield pd.concat([described, pd.DataFrame(columns)], axis=1)
