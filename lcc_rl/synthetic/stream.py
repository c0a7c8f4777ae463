"""Stream room: synthetic congested traffic with known drivers, the embedded default data.

A lane of IDM drivers drawn from the calibrated I-80 population drives in platoons behind
stochastic stop-and-go leaders (:class:`lcc_rl.synthetic.stop_and_go.StopAndGo`). The stream is
written in the official NGSIM layout and read back, so that it takes the way of the real files
through reader, extraction and calibration; unlike there, the truth about every driver is known.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from lcc_rl.data.car_following import Criteria
from lcc_rl.data.ngsim_writer import write_ngsim
from lcc_rl.data.sources import LoadedEpisodes, NgsimSource
from lcc_rl.data.units import FRAME
from lcc_rl.drivers.population import DriverPopulation, bootstrap
from lcc_rl.errors import ConfigError
from lcc_rl.functional.idm import equilibrium_gap, simulate_follower
from lcc_rl.io.files import write_parquet
from lcc_rl.synthetic.stop_and_go import StopAndGo

Array = NDArray[np.float64]

# A driver slower than this multiple of its platoon's level would drop behind, not follow.
KEEPS_UP = 1.2
WARM_UP_S = 30.0  # driven but not recorded, so that no pair starts in equilibrium
PAUSE_S = 20.0  # between the platoons of a recording
AUTOMOBILE = 2  # NGSIM vehicle class
LENGTHS_M = (4.6, 0.45, 3.5, 6.0)  # mean, standard deviation and range of automobile lengths
FIRST_START = datetime(2005, 1, 1, 12, tzinfo=UTC)


@dataclass(frozen=True)
class Stream:
    """A synthetic stream.

    Args:
        samples: one row per vehicle and frame in SI units, with the columns that
            :func:`lcc_rl.data.ngsim_writer.write_ngsim` needs; time_s as well. Positions are of the
            front bumper; acceleration is the one that took the vehicle to its speed.
        truth: one row per IDM driver: recording, vehicle, preceding, and its parameters
            desired_speed_mps, time_gap_s, acceleration_mps2, deceleration_mps2, min_gap_m.
    """

    samples: pd.DataFrame
    truth: pd.DataFrame


@dataclass(frozen=True)
class Lane:
    """One lane of platoons, seen for a while each.

    Args:
        platoons: number of platoons.
        vehicles: vehicles per platoon, the stochastic leader included.
        duration_s: range from which the time that a platoon is seen is drawn evenly [s].
        leader: the stochastic leader.
        noise: the executed acceleration of a driver is a(1 + ξ), ξ ~ U(0, noise) (A18).

    Raises:
        ConfigError: if an argument is out of range, naming it.
    """

    platoons: int = 30
    vehicles: int = 4
    duration_s: tuple[float, float] = (60.0, 90.0)
    leader: StopAndGo = field(default_factory=StopAndGo)
    noise: float = 0.05

    def __post_init__(self) -> None:
        _at_least("platoons", self.platoons, 1)
        _at_least("vehicles", self.vehicles, 2)
        low, high = _pair("duration_s", self.duration_s)
        if not 1.0 <= low <= high < float("inf"):
            raise ConfigError(
                f"stream: 'duration_s' must be a range from 1 s up, got {low}, {high}"
            )
        if not isinstance(self.noise, (int, float)) or not 0.0 <= self.noise < 1.0:
            raise ConfigError(f"stream: 'noise' must be in [0, 1), got {self.noise!r}")

    def drive(self, drivers: DriverPopulation, name: str, generator: np.random.Generator) -> Stream:
        """Drive one recording.

        Args:
            drivers: population to draw from.
            name: name of the recording.
            generator: source of all randomness.

        Returns:
            The recording; its vehicles count from 1, platoon by platoon, front to back.
        """
        warm_up = round(WARM_UP_S / FRAME)
        low, high = (round(value / FRAME) for value in self.duration_s)
        seen = generator.integers(low, high + 1, self.platoons)
        steps = warm_up + int(seen.max())
        ahead, level = self.leader.drive(self.platoons, steps, FRAME, generator)
        shape = (self.vehicles - 1, self.platoons)
        ranks = [drivers.select(row) for row in draw_drivers(drivers, level, shape, generator)]
        xi = torch.from_numpy(generator.uniform(0.0, self.noise, (steps, *shape)))
        speed, gap = follow(torch.from_numpy(ahead), ranks, xi)
        length = _lengths((self.vehicles, self.platoons), generator)
        samples = _samples(speed, _positions(speed, gap, length), length, warm_up, seen)
        return Stream(samples.assign(recording=name), _truth(ranks).assign(recording=name))


@dataclass(frozen=True)
class StreamSource:
    """The embedded default data: a stream, written in the NGSIM layout and read back.

    The default size gives 270 pairs, about as many as the 264 real I-80 pairs that the leader is
    fitted to, in three recordings like I-80's.

    Args:
        recordings: number of recordings; their leaders, drivers and vehicle ids are independent.
        platoons: platoons per recording, one after another on its lane.
        vehicles: vehicles per platoon, the stochastic leader included.
        duration_s: range of the time that a platoon is seen [s].
        seed: seed of all randomness; the same seed gives the same file, byte for byte.
        noise: relative noise of the drivers' acceleration, see :class:`Lane`.
        leader: the stochastic leader; by default the one fitted to I-80.
        drivers: the population; by default the shipped I-80 drivers.
        criteria: what counts as car following; by default that of the real files.
        keep: where the file is written and kept, ``.gz`` compresses it; by default it is read
            and forgotten.

    Raises:
        ConfigError: if an argument is out of range, naming it.
    """

    recordings: int = 3
    platoons: int = 30
    vehicles: int = 4
    duration_s: tuple[float, float] = (60.0, 90.0)
    seed: int = 0
    noise: float = 0.05
    leader: StopAndGo | None = None
    drivers: DriverPopulation | None = None
    criteria: Criteria | None = None
    keep: str | None = None

    def __post_init__(self) -> None:
        _at_least("recordings", self.recordings, 1)
        _at_least("seed", self.seed, 0)
        self._lane()

    def generate(self) -> Stream:
        """Drive all recordings.

        Raises:
            DataError: if the shipped drivers cannot be read.
        """
        lane, drivers = self._lane(), self.drivers or bootstrap()
        made = [
            lane.drive(drivers, recording_name(index), np.random.default_rng([self.seed, index]))
            for index in range(self.recordings)
        ]
        samples = pd.concat([one.samples for one in made], ignore_index=True)
        return Stream(samples, pd.concat([one.truth for one in made], ignore_index=True))

    def write(self, path: str | Path) -> Stream:
        """Drive all recordings and write them in the official NGSIM layout.

        The truth is written beside the file, ``stream.csv`` getting ``stream_truth.parquet``.

        Returns:
            What was written.

        Raises:
            DataError: if the shipped drivers cannot be read.
            ResultsError: if a file cannot be written.
        """
        stream = self.generate()
        write_ngsim(stream.samples, path)
        write_parquet(stream.truth, truth_path(path))
        return stream

    def load(self) -> LoadedEpisodes:
        """Write the stream, read it back and extract its car-following episodes.

        Raises:
            DataError: if no pair meets the criteria.
            ResultsError: if the file cannot be written.
        """
        with TemporaryDirectory(prefix="lcc_rl_stream_") as folder:
            path = Path(self.keep or Path(folder) / "stream.csv").expanduser()
            self.write(path)
            loaded = NgsimSource(str(path), criteria=self.criteria).load()
        size = f"{self.recordings} recordings of {self.platoons} platoons of {self.vehicles}"
        line = f"synthetic stream: {size} vehicles, seed {self.seed}"
        return replace(loaded, report=[line, *loaded.report])

    def _lane(self) -> Lane:
        leader = self.leader or StopAndGo()
        return Lane(self.platoons, self.vehicles, self.duration_s, leader, self.noise)


def truth_path(path: str | Path) -> Path:
    """Where the ground truth of a stream file lies."""
    path = Path(path)
    return path.with_name(f"{path.name.removesuffix('.gz').removesuffix('.csv')}_truth.parquet")


def draw_drivers(
    drivers: DriverPopulation, level: Array, shape: tuple[int, int], generator: np.random.Generator
) -> Tensor:
    """Draw drivers that can keep up with their platoon.

    Args:
        drivers: the population.
        level: congestion level of every platoon ``[platoons]`` [m/s].
        shape: drivers per platoon and platoons.
        generator: source of all randomness.

    Returns:
        Indices into the population, of the given shape; where no driver is fast enough, the
        fastest.
    """
    order = torch.argsort(drivers.desired_speed, stable=True)
    ascending = drivers.desired_speed[order].numpy()
    slowest = np.searchsorted(ascending, KEEPS_UP * level).clip(max=len(drivers) - 1)
    place = slowest + generator.random(shape) * (len(drivers) - slowest)
    return order[torch.from_numpy(place.astype(np.int64))]


def follow(ahead: Tensor, ranks: list[DriverPopulation], xi: Tensor) -> tuple[Array, Array]:
    """Drive platoons behind their leaders, from the equilibrium at the first speed.

    Args:
        ahead: speeds of the leaders ``[time + 1, platoons]`` [m/s].
        ranks: the drivers, one population of ``platoons`` drivers for each place in the platoon.
        xi: relative error of the executed acceleration ``[time, ranks, platoons]`` (A18).

    Returns:
        Speeds ``[time + 1, vehicles, platoons]``, the leaders' included [m/s], and gaps
        ``[time + 1, ranks, platoons]`` [m].
    """
    speeds, gaps = [ahead], []
    for rank, drivers in enumerate(ranks):
        own, leading = (drivers.desired_speed.double(), drivers.time_gap.double()), speeds[-1]
        start = equilibrium_gap(leading[0], *own, drivers.constants)
        noise = xi[:, rank].__getitem__
        speed, gap, _ = simulate_follower(
            leading, leading[0], start, *own, drivers.constants, FRAME, noise
        )
        speeds.append(speed)
        gaps.append(gap)
    return torch.stack(speeds, 1).numpy(), torch.stack(gaps, 1).numpy()


def _truth(ranks: list[DriverPopulation]) -> pd.DataFrame:
    """Parameters of all drivers, in the order of their ids."""
    vehicle = _identity(len(ranks) + 1, len(ranks[0]))[1:]
    constants = [drivers.constants for drivers in ranks]
    shape = torch.ones(len(ranks[0]), dtype=torch.float64)
    columns = {
        "desired_speed_mps": [drivers.desired_speed for drivers in ranks],
        "time_gap_s": [drivers.time_gap for drivers in ranks],
        "acceleration_mps2": [shape * entry.acceleration for entry in constants],
        "deceleration_mps2": [shape * entry.deceleration for entry in constants],
        "min_gap_m": [shape * entry.min_gap for entry in constants],
    }
    values = {name: torch.stack(rows).double().T.flatten() for name, rows in columns.items()}
    identity = {"vehicle": vehicle.T.ravel(), "preceding": vehicle.T.ravel() - 1}
    return pd.DataFrame(identity | {name: column.numpy() for name, column in values.items()})


def _lengths(shape: tuple[int, int], generator: np.random.Generator) -> Array:
    """Lengths of automobiles [m]."""
    mean, spread, shortest, longest = LENGTHS_M
    return np.clip(generator.normal(mean, spread, shape), shortest, longest)


def _positions(speed: Array, gap: Array, length: Array) -> Array:
    """Front bumpers ``[time, vehicles, platoons]`` [m]; the last vehicle starts at its length."""
    step = 0.5 * FRAME * (speed[1:, 0] + speed[:-1, 0])
    first = np.concatenate([np.zeros_like(step[:1]), np.cumsum(step, axis=0)])
    behind = np.cumsum(gap + length[:-1], axis=1)
    return np.concatenate([first[:, None], first[:, None] - behind], axis=1)


def _identity(vehicles: int, platoons: int) -> NDArray[np.int64]:
    """Vehicle ids ``[vehicles, platoons]``, from 1, platoon by platoon."""
    return np.arange(1, vehicles * platoons + 1).reshape(platoons, vehicles).T


def _samples(
    speed: Array, position: Array, length: Array, warm_up: int, seen: NDArray[np.int64]
) -> pd.DataFrame:
    """Rows of the recorded part; platoon after platoon along the time of the recording."""
    vehicles, platoons = length.shape
    elapsed = np.arange(warm_up, len(speed))
    kept = elapsed[:, None] < warm_up + seen
    time, platoon = np.nonzero(kept)
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


def _at_least(name: str, value: object, least: int) -> None:
    """Check a whole number."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise ConfigError(f"stream: {name!r} must be a whole number from {least} up, got {value!r}")


def _pair(name: str, value: object) -> tuple[float, float]:
    """Check a pair of numbers."""
    try:
        low, high = (float(entry) for entry in value)  # type: ignore[attr-defined]
    except (TypeError, ValueError):
        raise ConfigError(f"stream: {name!r} must be two numbers, got {value!r}") from None
    return low, high


def recording_name(index: int) -> str:
    """Name of a recording as the reader gives it: its start, an hour after the one before."""
    return (FIRST_START + timedelta(hours=index)).strftime("%Y-%m-%dT%H:%M:%SZ")
