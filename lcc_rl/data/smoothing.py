"""Smoothing of trajectories: positions are smoothed, then differentiated.

Raw NGSIM speeds and accelerations are noisy and disagree with the positions. Per stretch without a
missing frame the positions are smoothed, speed and acceleration are their derivatives, and space
headways are derived again. Smoothing is off unless a configuration names one of these classes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from lcc_rl.data.places import find_leaders
from lcc_rl.data.trajectories import Trajectories
from lcc_rl.data.units import FRAME
from lcc_rl.errors import ConfigError

Array = NDArray[np.float64]


class Smoothing(ABC):
    """Smoothing of the positions of trajectories, called with them."""

    def __call__(self, trajectories: Trajectories) -> Trajectories:
        """Return smoothed trajectories; the given ones are not changed.

        Negative smoothed speeds, as at standstill, become zero. Stretches too short to smooth keep
        their published values. Both are counted in the report's notes.
        """
        samples = trajectories.samples.copy(deep=False)
        starts, lengths = stretches(samples["segment"].to_numpy())
        long = np.repeat(lengths >= self.shortest, lengths)
        kinematics = self.smooth(samples["position_m"].to_numpy(dtype=float), starts, lengths)
        backward = long & (kinematics[1] < 0.0)
        kinematics[1][backward] = 0.0
        names = ("position_m", "speed_mps", "acceleration_mps2")
        for name, smoothed in zip(names, kinematics, strict=True):
            samples[name] = np.where(long, smoothed, samples[name]).astype(np.float32)
        leader = find_leaders(
            samples["recording"].cat.codes.to_numpy(),
            samples["vehicle"].to_numpy(),
            samples["frame"].to_numpy(),
            samples["preceding"].to_numpy(),
        )
        position = samples["position_m"].to_numpy()
        headway = np.where(leader >= 0, position[leader] - position, samples["space_headway_m"])
        samples["space_headway_m"] = headway.astype(np.float32)
        note = (
            f"smoothed with {self}: {int(backward.sum()):,} speeds below zero became zero; "
            f"{int((lengths < self.shortest).sum()):,} stretches were too short and stay as is"
        )
        report = replace(trajectories.report, notes=[*trajectories.report.notes, note])
        return Trajectories(samples, report)

    @property
    @abstractmethod
    def shortest(self) -> int:
        """Fewest samples of a stretch that can be smoothed."""

    @abstractmethod
    def smooth(
        self, position: Array, starts: NDArray[np.intp], lengths: NDArray[np.intp]
    ) -> tuple[Array, Array, Array]:
        """Smooth stretches that lie one after another.

        Args:
            position: positions ``[rows]`` [m].
            starts, lengths: first row and number of rows of each stretch.

        Returns:
            Position [m], speed [m/s] and acceleration [m/s²], each ``[rows]``; values in
            stretches shorter than ``shortest`` are not used.
        """


@dataclass(frozen=True)
class SavitzkyGolay(Smoothing):
    """Local polynomial fits; speed and acceleration are the derivatives of the polynomial.

    Args:
        window_s: length of the window [s]; an odd number of frames is taken, at least this long.
            A shorter stretch is fitted within its own length.
        order: order of the polynomial, at least 2 for an acceleration.

    Raises:
        ConfigError: if the window holds no more samples than the polynomial has coefficients.
    """

    window_s: float = 1.5
    order: int = 3

    def __post_init__(self) -> None:
        if self.order < 2:
            raise ConfigError(f"smoothing: 'order' must be at least 2, got {self.order}")
        if not FRAME * (self.order + 1) <= self.window_s < 600.0:
            raise ConfigError(
                f"smoothing: 'window_s' must be {FRAME * (self.order + 1):g} to 600 s for order "
                f"{self.order}, got {self.window_s}"
            )

    @property
    def shortest(self) -> int:
        return odd(self.order + 1)

    def smooth(
        self, position: Array, starts: NDArray[np.intp], lengths: NDArray[np.intp]
    ) -> tuple[Array, Array, Array]:
        window = odd(round(self.window_s / FRAME))
        result = (position.copy(), np.zeros_like(position), np.zeros_like(position))
        for start, length in zip(starts, lengths, strict=True):
            if length < self.shortest:
                continue
            part = slice(start, start + length)
            inside = min(window, odd(length - 1))  # of a short stretch, its largest odd part
            for order, values in enumerate(result):
                values[part] = savgol_filter(
                    position[part], inside, self.order, deriv=order, delta=FRAME
                )
        return result


@dataclass(frozen=True)
class ExponentialAverage(Smoothing):
    """Symmetric exponential moving average of Thiemann, Treiber and Kesting (2008).

    A sample k frames away weighs exp(−k·0.1 s/width), up to three widths away; towards the ends of
    a stretch the window shrinks on both sides alike, so that it stays symmetric. Speed and
    acceleration are central differences of the smoothed positions and of these speeds.

    Args:
        width_s: width of the kernel [s]; the authors take 0.5 s for positions.

    Raises:
        ConfigError: if the width is not positive.
    """

    width_s: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 < self.width_s < 100.0:
            raise ConfigError(f"smoothing: 'width_s' must be 0 to 100 s, got {self.width_s}")

    @property
    def shortest(self) -> int:
        return 3

    def smooth(
        self, position: Array, starts: NDArray[np.intp], lengths: NDArray[np.intp]
    ) -> tuple[Array, Array, Array]:
        place = np.arange(len(position)) - np.repeat(starts, lengths)
        reach = np.minimum(place, np.repeat(lengths, lengths) - 1 - place)
        total, weights = position.copy(), np.ones_like(position)
        for away in range(1, round(3.0 * self.width_s / FRAME) + 1):
            rows = np.flatnonzero(reach >= away)  # never leaves the stretch
            weight = np.exp(-away * FRAME / self.width_s)
            total[rows] += weight * (position[rows - away] + position[rows + away])
            weights[rows] += 2.0 * weight
        smoothed = total / weights
        speed = derivative(smoothed, starts, lengths)
        return smoothed, speed, derivative(speed, starts, lengths)


def derivative(values: Array, starts: NDArray[np.intp], lengths: NDArray[np.intp]) -> Array:
    """Central differences within stretches, one-sided at their ends; 0 in one of a single row."""
    row = np.arange(len(values))
    before = np.maximum(row - 1, np.repeat(starts, lengths))
    after = np.minimum(row + 1, np.repeat(starts + lengths - 1, lengths))
    return (values[after] - values[before]) / (FRAME * np.maximum(after - before, 1))


def stretches(segment: NDArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First row and number of rows of each stretch of equal values."""
    starts = np.flatnonzero(np.concatenate([[True], segment[1:] != segment[:-1]]))
    return starts, np.diff(np.append(starts, len(segment)))


def odd(count: int) -> int:
    """The smallest odd number that is not below ``count``."""
    return int(count) | 1
