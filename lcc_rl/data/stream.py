"""Stream room: synthetic congested traffic with known drivers, the embedded default data.

A lane of IDM drivers drawn from the calibrated I-80 population drives in platoons behind
stochastic stop-and-go leaders (:class:`lcc_rl.data.stop_and_go.StopAndGo`). The stream is written
in the official NGSIM layout and read back, so that it takes the way of the real files through
reader, extraction and calibration; unlike there, the truth about every driver is known.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from lcc_rl.data.stop_and_go import StopAndGo
from lcc_rl.data.units import FRAME
from lcc_rl.errors import ConfigError
from lcc_rl.functional.idm import IDMConstants, equilibrium_gap, simulate_follower

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
            :func:`lcc_rl.data.ngsim.write_ngsim` needs; time_s as well. Positions are of the
            front bumper; acceleration is the one that took the vehicle to its speed.
        truth: one row per IDM driver: recording, vehicle, preceding, desired_speed_mps,
            time_gap_s.
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
        constants: IDM parameters that all drivers share.
        noise: the executed acceleration of a driver is a(1 + ξ), ξ ~ U(0, noise) (A18).

    Raises:
        ConfigError: if an argument is out of range, naming it.
    """

    platoons: int = 28
    vehicles: int = 4
    duration_s: tuple[float, float] = (35.0, 85.0)
    leader: StopAndGo = field(default_factory=StopAndGo)
    constants: IDMConstants = field(default_factory=IDMConstants)
    noise: float = 0.05

    def __post_init__(self) -> None:
        _at_least("platoons", self.platoons, 1)
        _at_least("vehicles", self.vehicles, 2)
        low, high = _pair("duration_s", self.duration_s)
        if not 1.0 <= low <= high < float("inf"):
            raise ConfigError(
                f"stream: 'duration_s' must be a range from 1 s up, got {low}, {high}"
            )
        if not 0.0 <= self.noise < 1.0:
            raise ConfigError(f"stream: 'noise' must be in [0, 1), got {self.noise}")

    def drive(self, drivers: pd.DataFrame, name: str, generator: np.random.Generator) -> Stream:
        """Drive one recording.

        Args:
            drivers: population to draw from, columns desired_speed_mps and time_gap_s.
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
        chosen = draw_drivers(drivers, level, shape, generator)
        xi = generator.uniform(0.0, self.noise, (steps, *shape))
        speed, gap = self._follow(torch.from_numpy(ahead), chosen, torch.from_numpy(xi))
        mean, spread, shortest, longest = LENGTHS_M
        length = generator.normal(mean, spread, (self.vehicles, self.platoons))
        length = np.clip(length, shortest, longest)
        position = _positions(speed, gap, length)
        samples = _table(speed, position, length, warm_up, seen).assign(recording=name)
        return Stream(samples, self._truth(chosen).assign(recording=name))

    def _follow(self, ahead: Tensor, chosen: Tensor, xi: Tensor) -> tuple[Array, Array]:
        """Speeds ``[time, vehicles, platoons]`` and gaps ``[time, vehicles − 1, platoons]``."""
        speeds, gaps = [ahead], []
        for rank, (desired_speed, time_gap) in enumerate(chosen):
            ahead = speeds[-1]
            start = equilibrium_gap(ahead[0], desired_speed, time_gap, self.constants)
            speed, gap, _ = simulate_follower(
                ahead,
                ahead[0],
                start,
                desired_speed,
                time_gap,
                self.constants,
                FRAME,
                xi[:, rank].__getitem__,
            )
            speeds.append(speed)
            gaps.append(gap)
        return torch.stack(speeds, 1).numpy(), torch.stack(gaps, 1).numpy()

    def _truth(self, chosen: Tensor) -> pd.DataFrame:
        """Ground truth of the drivers ``[vehicles − 1, (v0, T), platoons]``."""
        vehicle = _identity(self.vehicles, self.platoons)[1:].T.reshape(-1)
        values = chosen.permute(2, 0, 1).reshape(-1, 2).numpy()
        return pd.DataFrame(
            {
                "vehicle": vehicle,
                "preceding": vehicle - 1,
                "desired_speed_mps": values[:, 0],
                "time_gap_s": values[:, 1],
            }
        )


def draw_drivers(
    drivers: pd.DataFrame, level: Array, shape: tuple[int, int], generator: np.random.Generator
) -> Tensor:
    """Draw (v0, T) pairs of drivers that can keep up with their platoon.

    Args:
        drivers: population, columns desired_speed_mps and time_gap_s.
        level: congestion level of every platoon ``[platoons]`` [m/s].
        shape: drivers per platoon and platoons.
        generator: source of all randomness.

    Returns:
        Float64 ``[drivers per platoon, 2, platoons]``: v0 [m/s] and T [s].
    """
    pairs = drivers.sort_values("desired_speed_mps", kind="stable")
    values = pairs[["desired_speed_mps", "time_gap_s"]].to_numpy(dtype=np.float64)
    slowest = np.searchsorted(values[:, 0], KEEPS_UP * level).clip(max=len(values) - 1)
    row = slowest + (generator.random(shape) * (len(values) - slowest)).astype(np.int64)
    return torch.from_numpy(values[row].transpose(0, 2, 1).copy())


def _positions(speed: Array, gap: Array, length: Array) -> Array:
    """Front bumpers ``[time, vehicles, platoons]`` [m]; the last vehicle starts at its length."""
    step = 0.5 * FRAME * (speed[1:, 0] + speed[:-1, 0])
    first = np.concatenate([np.zeros_like(step[:1]), np.cumsum(step, axis=0)])
    behind = np.cumsum(gap + length[:-1], axis=1)
    return np.concatenate([first[:, None], first[:, None] - behind], axis=1)


def _identity(vehicles: int, platoons: int) -> NDArray[np.int64]:
    """Vehicle ids ``[vehicles, platoons]``, from 1, platoon by platoon."""
    return np.arange(1, vehicles * platoons + 1).reshape(platoons, vehicles).T


def _table(
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
    """Name of a recording; it tells the start, an hour after the one before."""
    start = FIRST_START + timedelta(hours=index)
    return f"stream@{start.strftime('%Y-%m-%dT%H:%M:%SZ')}"
