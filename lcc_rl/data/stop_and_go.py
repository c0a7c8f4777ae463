"""Stop-and-go room: a stochastic leader in congested traffic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from lcc_rl.errors import ConfigError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StopAndGo:
    """Leaders that chase a speed which jumps, as drivers do in stop-and-go waves.

    Every leader has a congestion level, Gaussian over leaders. After exponentially distributed
    times it aims at a new speed, Gaussian about its level and cut off at zero, where it stands.
    It approaches that speed as a critically damped second-order system, so that acceleration is
    continuous, within the limits of ordinary driving. The jumps, rather than a Gaussian process,
    make the many calm and few strong accelerations of recorded traffic.

    The default values are fitted to NGSIM I-80 by ``tools/fit_stream.py``: they minimise the
    distance between the leaders of the synthetic pairs and those of 264 real pairs in the
    mean and quantiles of speed, acceleration and 30 s energy (see
    :mod:`lcc_rl.data.statistics`), for platoons of four vehicles.

    Args:
        mean_speed_mps: mean of the levels [m/s].
        level_spread_mps: standard deviation of the levels over leaders [m/s].
        wave_spread_mps: standard deviation of the speeds aimed at about a level [m/s].
        dwell_s: mean time between two jumps [s].
        response_s: time constant of the response to a jump [s].
        acceleration_limit: largest acceleration [m/s²].
        braking_limit: largest deceleration, positive [m/s²].

    Raises:
        ConfigError: if a parameter is not positive (the spreads may be zero), naming it.
    """

    mean_speed_mps: float = 5.12
    level_spread_mps: float = 2.22
    wave_spread_mps: float = 3.49
    dwell_s: float = 4.12
    response_s: float = 1.40
    acceleration_limit: float = 2.0
    braking_limit: float = 3.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            spread = name.endswith("spread_mps")
            if not (value >= 0 if spread else value > 0) or not np.isfinite(value):
                kind = "zero or more" if spread else "positive"
                raise ConfigError(f"stop-and-go leader: {name!r} must be {kind}, got {value}")

    def drive(
        self, count: int, steps: int, time_step: float, generator: np.random.Generator
    ) -> tuple[Array, Array]:
        """Drive leaders side by side.

        Levels and jumps are stratified samples of their distributions: a stream has few leaders,
        and its statistics should not hang on the luck of a seed.

        Args:
            count: number of leaders.
            steps: number of steps.
            time_step: duration of a step [s].
            generator: source of all randomness.

        Returns:
            Speeds ``[steps + 1, count]`` [m/s] and levels ``[count]`` [m/s].
        """
        level = self.mean_speed_mps + self.level_spread_mps * stratified_normal(count, generator)
        jump = generator.random((steps + 1, count)) < time_step / self.dwell_s
        jump[0] = True
        aim = np.zeros_like(jump, dtype=np.float64)
        aim[jump] = self.wave_spread_mps * stratified_normal(int(jump.sum()), generator)
        aim = np.where(jump, np.maximum(aim + level, 0.0), aim)
        return self._chase(aim, jump, time_step), level

    def _chase(self, aim: Array, jump: NDArray[np.bool_], time_step: float) -> Array:
        """Speeds of leaders that respond to the speeds aimed at, both ``[steps + 1, count]``."""
        target = speed = aim[0]
        acceleration = np.zeros_like(speed)
        speeds = [speed]
        for step in range(1, len(aim)):
            target = np.where(jump[step], aim[step], target)
            pull = (target - speed) / self.response_s**2 - 2.0 * acceleration / self.response_s
            wanted = acceleration + time_step * pull
            wanted = np.clip(wanted, -self.braking_limit, self.acceleration_limit)
            reached = np.maximum(speed + wanted * time_step, 0.0)
            # At a stop the executed acceleration counts, or the leader would start off late.
            acceleration = (reached - speed) / time_step
            speed = reached
            speeds.append(speed)
        return np.stack(speeds)


def stratified_normal(count: int, generator: np.random.Generator) -> Array:
    """Standard normal numbers, one from each of ``count`` equally likely ranges, shuffled."""
    place = generator.permutation(count) + generator.random(count)
    # The first range reaches down to probability 0, whose quantile is −∞.
    return ndtri(np.clip(place / count, 0.01 / count, 1.0 - 0.01 / count))
