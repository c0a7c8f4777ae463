"""Synthetic congested traffic with known drivers, the default data source.

IDM drivers from the calibrated I-80 population drive in platoons behind stochastic stop-and-go
leaders (:class:`StopAndGo`). The stream has the columns and the
rounding of NGSIM files, and the same extraction and calibration apply. Unlike in recorded data,
the parameters of every driver are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from typing import Annotated

import numpy as np
import pandas as pd
import scipy  # loads special where it is used
import torch
from numpy.typing import NDArray
from pydantic import Field, InstanceOf
from torch import Tensor

from lcc_rl.arrays import Floats
from lcc_rl.data.car_following import Criteria
from lcc_rl.data.sources import LoadedEpisodes, TrajectorySource
from lcc_rl.data.trajectories import (
    FOOT,
    FRAME,
    SAMPLE_KEYS,
    ReadReport,
    Trajectories,
    assembled,
    find_leaders,
)
from lcc_rl.drivers.parameters import fitted
from lcc_rl.drivers.population import DriverPopulation, bootstrap
from lcc_rl.errors import ConfigError
from lcc_rl.functional.driver_models import PARAMETERS, simulate_follower
from lcc_rl.settings import Increasing, NonNegative, Positive, Seed, Settings, Share


class StopAndGo(Settings):
    """Leaders that follow a target speed with jumps, as in stop-and-go waves.

    Every leader has a congestion level, Gaussian over leaders. Its target speed is the sum of
    level, wave and ripple, at least zero. A free speed may bound level plus wave, and traffic may
    stand in the lowest waves. Wave and ripple each get a new Gaussian value after exponentially
    distributed times; waves are rare and large, ripples frequent and small. The speed follows the
    target as a critically damped second-order system within acceleration limits, so acceleration
    is continuous. Jumps reproduce the heavy-tailed accelerations of recorded traffic better than a
    Gaussian process.

    The default values are fitted to NGSIM I-80 by differential evolution and a Nelder–Mead search
    (``tools/fit_stream.py`` at commit bb30b35). They minimise the distance between the leaders of
    synthetic pairs and those of 264 real pairs in mean and quantiles of speed, acceleration and
    30 s energy and in the autocorrelation of acceleration, for platoons of four vehicles.
    """

    mean_speed_mps: Positive = 5.21  # mean of the levels [m/s]
    level_spread_mps: NonNegative = 2.78  # standard deviation of the levels over leaders [m/s]
    wave_spread_mps: NonNegative = 2.59  # standard deviation of the waves [m/s]
    wave_s: Positive = 4.92  # mean duration of a wave [s]
    ripple_spread_mps: NonNegative = 1.32  # standard deviation of the ripples [m/s]
    ripple_s: Positive = 2.13  # mean duration of a ripple [s]
    response_s: Positive = 0.99  # time constant of the response to a jump [s]
    acceleration_limit: Positive = 2.5  # [m/s²]
    braking_limit: Positive = 3.5  # [m/s²]
    # Upper bound of level plus wave, the speed of free traffic [m/s]; None: no bound.
    free_speed_mps: Positive | None = None
    stop_share: Share = 0.0  # share of the waves, the lowest ones, in which traffic stands

    def drive(
        self, count: int, steps: int, time_step: float, generator: np.random.Generator
    ) -> tuple[Floats, Floats]:
        """Drive leaders in parallel.

        Levels and jumps are stratified samples of their distributions, which reduces the variance
        of a stream's statistics between seeds.

        Args:
            count: number of leaders.
            steps: number of steps.
            time_step: duration of a step [s].
            generator: generator of all random numbers.

        Returns:
            Speeds ``[steps + 1, count]`` [m/s] and levels ``[count]`` [m/s].
        """
        level = self.mean_speed_mps + self.level_spread_mps * stratified_normal(count, generator)
        shape = (steps + 1, count)
        wave = jumps(shape, time_step / self.wave_s, generator)
        ripple = self.ripple_spread_mps * jumps(shape, time_step / self.ripple_s, generator)
        traffic = level + self.wave_spread_mps * wave
        if self.free_speed_mps is not None:
            traffic = np.minimum(traffic, self.free_speed_mps)
        target = np.where(wave < scipy.special.ndtri(self.stop_share), 0.0, traffic + ripple)
        return self._track(np.maximum(target, 0.0), time_step), level

    def _track(self, target: Floats, time_step: float) -> Floats:
        """Return speeds of leaders for target speeds, both ``[steps + 1, count]``."""
        speed = target[0]
        acceleration = np.zeros_like(speed)
        speeds = [speed]
        for wish in target[1:]:
            pull = (wish - speed) / self.response_s**2 - 2.0 * acceleration / self.response_s
            wanted = acceleration + time_step * pull
            wanted = np.clip(wanted, -self.braking_limit, self.acceleration_limit)
            reached = np.maximum(speed + wanted * time_step, 0.0)
            # At a stop the executed acceleration counts; else the leader would start late.
            acceleration = (reached - speed) / time_step
            speed = reached
            speeds.append(speed)
        return np.stack(speeds)


def jumps(shape: tuple[int, int], rate: float, generator: np.random.Generator) -> Floats:
    """Return standard normal values that are constant until the next jump.

    Args:
        shape: steps and number of processes.
        rate: probability of a jump in a step.
        generator: generator of all random numbers.

    Returns:
        Values of the given shape, together a stratified sample.
    """
    jump = generator.random(shape) < rate
    jump[0] = True
    values = np.zeros(shape)
    values[jump] = stratified_normal(int(jump.sum()), generator)
    last = np.maximum.accumulate(np.where(jump, np.arange(shape[0])[:, None], 0), axis=0)
    return np.take_along_axis(values, last, axis=0)


def stratified_normal(count: int, generator: np.random.Generator) -> Floats:
    """Return shuffled standard normal numbers, one from each of ``count`` equiprobable ranges."""
    place = generator.permutation(count) + generator.random(count)
    # The first range begins at probability 0, with the quantile −∞.
    return scipy.special.ndtri(np.clip(place / count, 0.01 / count, 1.0 - 0.01 / count))


# -- platoons of IDM drivers behind stochastic leaders on one lane ---------------------------------

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


Duration = Annotated[float, Field(ge=1.0, le=36_000.0)]
Range = Annotated[tuple[Duration, Duration], Increasing]
# -- the source ------------------------------------------------------------------------------------

FIRST_START = datetime(2005, 1, 1, 12, tzinfo=UTC)


class StreamSource(Settings):
    """Source of synthetic car-following episodes, in the columns and the rounding of NGSIM.

    The default size gives 270 pairs in three recordings; the I-80 data have 264 in three.
    """

    # Recordings with independent leaders, drivers and vehicle ids.
    recordings: Annotated[int, Field(ge=1, le=1000)] = 3
    platoons: Annotated[int, Field(ge=1, le=10_000)] = 30  # successive platoons per recording
    # Vehicles per platoon, including the stochastic leader.
    vehicles: Annotated[int, Field(ge=2, le=1000)] = 4
    duration_s: Range = (60.0, 90.0)  # range of the recorded time of a platoon [s]
    seed: Seed = 0  # seed of the data, independent of the run's seed
    noise: Share = 0.05  # drivers execute a(1 + ξ), ξ ~ U(0, noise) (A18)
    leader: StopAndGo = field(default_factory=StopAndGo)
    drivers: InstanceOf[DriverPopulation] | None = None  # None: the shipped I-80 drivers
    # Criteria of car following; the default is that of real files.
    criteria: Criteria = field(default_factory=Criteria)
    keep: None = None  # no file is written; stored runs name the setting

    def generate(self) -> Stream:
        """Simulate all recordings."""
        low, high = (round(value / FRAME) for value in self.duration_s)
        drawn = []
        for index in range(self.recordings):
            generator = np.random.default_rng([self.seed, index])
            drawn.append((generator.integers(low, high + 1, self.platoons), generator))
        drivers = self.drivers or bootstrap()
        made = drive_platoons(self.leader, drivers, self.vehicles, self.noise, drawn)
        starts = (FIRST_START + timedelta(hours=index) for index in range(self.recordings))
        made = [
            Stream(one.samples.assign(recording=name), one.truth.assign(recording=name))
            for name, one in zip((f"{x:%Y-%m-%dT%H:%M:%SZ}" for x in starts), made, strict=True)
        ]
        samples = pd.concat([one.samples for one in made], ignore_index=True)
        return Stream(samples, pd.concat([one.truth for one in made], ignore_index=True))

    def load(self) -> LoadedEpisodes:
        """Generate the stream and extract its car-following episodes.

        Raises:
            DataError: if no pair meets the criteria.
        """
        recorded = as_recorded(self.generate().samples)
        loaded = TrajectorySource(criteria=self.criteria).extracted(recorded)
        size = f"{self.recordings} recordings of {self.platoons} platoons of {self.vehicles}"
        line = f"synthetic stream: {size} vehicles, seed {self.seed}"
        return replace(loaded, report=[line, *loaded.report])


def as_recorded(samples: pd.DataFrame) -> Trajectories:
    """Return samples with the rounding of NGSIM files: three decimals of a foot, in float32.

    Args:
        samples: see :class:`Stream`; recordings are sorted by name.
    """
    columns = {str(name): samples[name].to_numpy() for name in samples if name != "time_s"}
    columns["recording"], names = pd.factorize(columns["recording"])
    ahead = find_leaders(*(columns[key] for key in SAMPLE_KEYS))
    position = columns["position_m"]
    columns["space_headway_m"] = np.where(ahead >= 0, position[ahead] - position, np.nan)
    for name in columns:
        if name.endswith(("_m", "_mps", "_mps2")):
            columns[name] = (np.round(columns[name] / FOOT, 3) + 0.0) * FOOT
    return assembled(columns, list(names), ReadReport(["the stream"], rows_read=len(samples)))
