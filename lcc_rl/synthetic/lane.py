"""Platoons of IDM drivers behind stochastic leaders on one lane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from lcc_rl.arrays import Floats
from lcc_rl.data.trajectories import FRAME
from lcc_rl.drivers.parameters import fitted
from lcc_rl.drivers.population import DriverPopulation
from lcc_rl.errors import ConfigError
from lcc_rl.functional.driver_models import PARAMETERS, simulate_follower
from lcc_rl.synthetic.stop_and_go import StopAndGo

# Drivers with a desired speed below this multiple of their platoon's level would fall behind.
KEEPS_UP = 1.2
WARM_UP_S = 30.0  # not recorded, so that no pair starts at equilibrium [s]
PAUSE_S = 20.0  # time between the platoons of a recording [s]
AUTOMOBILE = 2  # NGSIM vehicle class
LENGTHS_M = (4.6, 0.45, 3.5, 6.0)  # mean, standard deviation and range of automobile lengths


@dataclass(frozen=True)
class Stream:
    """A synthetic stream.

    Args:
        samples: one row per vehicle and frame in SI units: recording, vehicle, frame, position_m
            (front bumper), lane, length_m, vehicle_class, speed_mps, acceleration_mps2 (backward
            difference of speed), preceding and time_s.
        truth: one row per IDM driver: recording, vehicle, preceding, and its parameters
            desired_speed_mps, time_gap_s, acceleration_mps2, deceleration_mps2, min_gap_m.
    """

    samples: pd.DataFrame
    truth: pd.DataFrame


def drive_platoons(
    leader: StopAndGo,
    drivers: DriverPopulation,
    vehicles: int,
    noise: float,
    recordings: Sequence[tuple[NDArray[np.int64], np.random.Generator]],
) -> list[Stream]:
    """Simulate recordings of successive platoons on one lane.

    Args:
        leader: stochastic leader of every platoon.
        drivers: population from which the followers are drawn.
        vehicles: vehicles per platoon, including the leader.
        noise: relative noise of the drivers' acceleration (A18).
        recordings: the recorded steps of every platoon ``[platoons]`` and the generator of each
            recording.

    Raises:
        ConfigError: if drivers have another model than the IDM.
    """
    if drivers.models is not None:
        known = ", ".join(sorted(set(drivers.models)))
        raise ConfigError(f"data.drivers: expected IDM drivers for a stream, got those of {known}")
    drawn = _drawn(leader, drivers, vehicles, noise, recordings)
    ahead, chosen, xi, _ = (np.concatenate(parts, -1) for parts in zip(*drawn, strict=True))
    ranks = [drivers.select(row) for row in torch.from_numpy(chosen)]
    speed, gap = drive_ranks(torch.from_numpy(ahead), ranks, torch.from_numpy(xi))
    made, first, warm_up = [], 0, round(WARM_UP_S / FRAME)
    for (seen, _), (_, chosen, _, length) in zip(recordings, drawn, strict=True):
        own = slice(first, first := first + len(seen))
        position = _positions(speed[..., own], gap[..., own], length)
        samples = _samples(speed[..., own], position, length, warm_up, seen)
        ranks = [drivers.select(row) for row in torch.from_numpy(chosen)]
        made.append(Stream(samples, _truth(ranks)))
    return made


def _drawn(
    leader: StopAndGo,
    drivers: DriverPopulation,
    vehicles: int,
    noise: float,
    recordings: Sequence[tuple[NDArray[np.int64], np.random.Generator]],
) -> list[tuple[Floats, NDArray[np.int64], Floats, Floats]]:
    """Draw leaders' speeds, drivers, noise and lengths of each recording, platoons last.

    Series of short recordings are extended to the length of the longest.
    """
    warm_up, (mean, spread, shortest, longest) = round(WARM_UP_S / FRAME), LENGTHS_M
    most, drawn = warm_up + max(int(seen.max()) for seen, _ in recordings), []
    for seen, generator in recordings:
        steps, shape = warm_up + int(seen.max()), (vehicles - 1, len(seen))
        ahead, level = leader.drive(len(seen), steps, FRAME, generator)
        chosen = draw_drivers(drivers, level, shape, generator).numpy()
        xi = generator.uniform(0.0, noise, (steps, *shape))
        length = generator.normal(mean, spread, (vehicles, len(seen))).clip(shortest, longest)
        drawn.append((_longer(ahead, most + 1), chosen, _longer(xi, most), length))
    return drawn


def _longer(values: Floats, steps: int) -> Floats:
    """Return a series with its last values repeated to a number of steps."""
    return np.concatenate([values, np.repeat(values[-1:], steps - len(values), axis=0)])


def draw_drivers(
    drivers: DriverPopulation, level: Floats, shape: tuple[int, int], generator: np.random.Generator
) -> Tensor:
    """Draw drivers that can keep up with their platoon.

    Args:
        drivers: the population.
        level: congestion level of every platoon ``[platoons]`` [m/s].
        shape: drivers per platoon and platoons.
        generator: generator of all random numbers.

    Returns:
        Indices into the population, of the given shape; the fastest driver if none is fast enough.
    """
    order = torch.argsort(drivers.desired_speed, stable=True)
    ascending = drivers.desired_speed[order].numpy()
    slowest = np.searchsorted(ascending, KEEPS_UP * level).clip(max=len(drivers) - 1)
    place = slowest + generator.random(shape) * (len(drivers) - slowest)
    return order[torch.from_numpy(place.astype(np.int64))]


def drive_ranks(ahead: Tensor, ranks: list[DriverPopulation], xi: Tensor) -> tuple[Floats, Floats]:
    """Drive platoons behind their leaders from equilibrium at the first speed.

    Args:
        ahead: speeds of the leaders ``[time + 1, platoons]`` [m/s].
        ranks: the drivers, one population of ``platoons`` drivers for each place in the platoon.
        xi: relative error of the executed acceleration ``[time, ranks, platoons]`` (A18).

    Returns:
        Speeds ``[time + 1, vehicles, platoons]``, including the leaders' [m/s], and gaps
        ``[time + 1, ranks, platoons]`` [m].
    """
    speeds, gaps = [ahead], []
    for rank, drivers in enumerate(ranks):
        own, leading = (drivers.desired_speed.double(), drivers.time_gap.double()), speeds[-1]
        start = drivers.constants.equilibrium_gap(leading[0], *own)
        noise = xi[:, rank].__getitem__
        speed, gap, _ = simulate_follower(
            leading, leading[0], start, *own, drivers.constants, FRAME, noise
        )
        speeds.append(speed)
        gaps.append(gap)
    return torch.stack(speeds, 1).numpy(), torch.stack(gaps, 1).numpy()


def _truth(ranks: list[DriverPopulation]) -> pd.DataFrame:
    """Return the parameters of all drivers, in the order of their ids."""
    vehicle = _identity(len(ranks) + 1, len(ranks[0]))[1:].T.ravel()
    parameters = [drivers.parameters() for drivers in ranks]
    columns = {"vehicle": vehicle, "preceding": vehicle - 1}
    for name in fitted("global"):
        columns[PARAMETERS[name].column] = (
            torch.stack([own[name] for own in parameters]).T.flatten().numpy()
        )
    return pd.DataFrame(columns)


def _positions(speed: Floats, gap: Floats, length: Floats) -> Floats:
    """Return front bumpers ``[time, vehicles, platoons]`` [m]; the last starts at its length."""
    step = 0.5 * FRAME * (speed[1:, 0] + speed[:-1, 0])
    first = np.concatenate([np.zeros_like(step[:1]), np.cumsum(step, axis=0)])
    behind = np.cumsum(gap + length[:-1], axis=1)
    return np.concatenate([first[:, None], first[:, None] - behind], axis=1)


def _identity(vehicles: int, platoons: int) -> NDArray[np.int64]:
    """Return vehicle ids ``[vehicles, platoons]``, from 1, platoon by platoon."""
    return np.arange(1, vehicles * platoons + 1).reshape(platoons, vehicles).T


def _samples(
    speed: Floats, position: Floats, length: Floats, warm_up: int, seen: NDArray[np.int64]
) -> pd.DataFrame:
    """Return the rows of the recorded part, with successive platoons in time."""
    vehicles, platoons = length.shape
    time, platoon = np.nonzero(np.arange(len(speed) - warm_up)[:, None] < seen)
    start = np.concatenate([[0], np.cumsum(seen + round(PAUSE_S / FRAME))[:-1]])
    row = time + warm_up
    entry = position[warm_up, -1] - length[-1]
    identity = _identity(vehicles, platoons)
    parts = [
        pd.DataFrame(
            {
                "vehicle": identity[rank, platoon],
                "frame": time + start[platoon] + 1,
                "position_m": position[row, rank, platoon] - entry[platoon],
                "lane": 1,
                "length_m": length[rank, platoon],
                "vehicle_class": AUTOMOBILE,
                "speed_mps": speed[row, rank, platoon],
                "acceleration_mps2": (speed[row, rank, platoon] - speed[row - 1, rank, platoon])
                / FRAME,
                "preceding": identity[rank, platoon] - 1 if rank else 0,
            }
        )
        for rank in range(vehicles)
    ]
    samples = pd.concat(parts).sort_values(["vehicle", "frame"], ignore_index=True)
    return samples.assign(time_s=samples["frame"] * FRAME)
