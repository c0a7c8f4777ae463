"""Stochastic leaders in congested traffic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from lcc_rl.errors import require_in

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StopAndGo:
    """Leaders that track a target speed which jumps, as in stop-and-go waves.

    Every leader has a congestion level, Gaussian over leaders. Its target speed is the sum of its
    level, a wave and a ripple, at least zero; a free speed may bound level and wave together, and
    in the lowest waves traffic may stand. Wave and ripple each take a new Gaussian value after
    exponentially distributed times; waves are rare and large, ripples frequent and small. The
    speed follows the target as a critically damped second-order system within acceleration
    limits, so that acceleration is continuous. Jumps reproduce the heavy-tailed accelerations of
    recorded traffic better than a Gaussian process does.

    The default values are fitted to NGSIM I-80 by a differential evolution and a Nelder–Mead
    search (``tools/fit_stream.py`` at commit bb30b35): they minimise the distance between the
    leaders of the synthetic pairs and those of 264 real pairs in the mean and quantiles of
    speed, acceleration and 30 s energy and in the
    autocorrelation of acceleration, for platoons of four vehicles.

    Args:
        mean_speed_mps: mean of the levels [m/s].
        level_spread_mps: standard deviation of the levels over leaders [m/s].
        wave_spread_mps: standard deviation of the waves [m/s].
        wave_s: mean time that a wave holds [s].
        ripple_spread_mps: standard deviation of the ripples [m/s].
        ripple_s: mean time that a ripple holds [s].
        response_s: time constant of the response to a jump [s].
        acceleration_limit: largest acceleration [m/s²].
        braking_limit: largest deceleration, positive [m/s²].
        free_speed_mps: bound of level and wave together: the speed of free traffic, from which
            waves only slow down [m/s]; None for no bound.
        stop_share: share of the waves in which traffic stands, 0…1: the lowest ones.

    Raises:
        ConfigError: if a parameter is not positive (the spreads may be zero), naming it.
    """

    mean_speed_mps: float = 5.21
    level_spread_mps: float = 2.78
    wave_spread_mps: float = 2.59
    wave_s: float = 4.92
    ripple_spread_mps: float = 1.32
    ripple_s: float = 2.13
    response_s: float = 0.99
    acceleration_limit: float = 2.5
    braking_limit: float = 3.5
    free_speed_mps: float | None = None
    stop_share: float = 0.0

    def __post_init__(self) -> None:
        require_in("data.leader", "[0, 1)", stop_share=self.stop_share)
        for name, value in vars(self).items():
            if name == "stop_share" or (name == "free_speed_mps" and value is None):
                continue
            spread = name.endswith("spread_mps")
            require_in("data.leader", "[0, inf)" if spread else "(0, inf)", **{name: value})

    def drive(
        self, count: int, steps: int, time_step: float, generator: np.random.Generator
    ) -> tuple[Array, Array]:
        """Drive leaders side by side.

        Levels and jumps are stratified samples of their distributions, which reduces the variance
        of a stream's statistics between seeds.

        Args:
            count: number of leaders.
            steps: number of steps.
            time_step: duration of a step [s].
            generator: source of all randomness.

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
        target = np.where(wave < ndtri(self.stop_share), 0.0, traffic + ripple)
        return self._track(np.maximum(target, 0.0), time_step), level

    def _track(self, target: Array, time_step: float) -> Array:
        """Speeds of leaders that track target speeds, both ``[steps + 1, count]``."""
        speed = target[0]
        acceleration = np.zeros_like(speed)
        speeds = [speed]
        for wish in target[1:]:
            pull = (wish - speed) / self.response_s**2 - 2.0 * acceleration / self.response_s
            wanted = acceleration + time_step * pull
            wanted = np.clip(wanted, -self.braking_limit, self.acceleration_limit)
            reached = np.maximum(speed + wanted * time_step, 0.0)
            # At a stop the executed acceleration counts, or the leader would start off late.
            acceleration = (reached - speed) / time_step
            speed = reached
            speeds.append(speed)
        return np.stack(speeds)


def jumps(shape: tuple[int, int], rate: float, generator: np.random.Generator) -> Array:
    """Standard normal values that hold until the next jump.

    Args:
        shape: steps and number of processes.
        rate: probability of a jump in a step.
        generator: source of all randomness.

    Returns:
        Values of the given shape; all of them together are a stratified sample.
    """
    jump = generator.random(shape) < rate
    jump[0] = True
    values = np.zeros(shape)
    values[jump] = stratified_normal(int(jump.sum()), generator)
    last = np.maximum.accumulate(np.where(jump, np.arange(shape[0])[:, None], 0), axis=0)
    return np.take_along_axis(values, last, axis=0)


def stratified_normal(count: int, generator: np.random.Generator) -> Array:
    """Standard normal numbers, one from each of ``count`` equally likely ranges, shuffled."""
    place = generator.permutation(count) + generator.random(count)
    # The first range reaches down to probability 0, whose quantile is −∞.
    return ndtri(np.clip(place / count, 0.01 / count, 1.0 - 0.01 / count))
