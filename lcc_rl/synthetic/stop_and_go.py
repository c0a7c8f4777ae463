"""Stochastic leaders in congested traffic."""

from __future__ import annotations

import numpy as np
import scipy  # loads special where it is used

from lcc_rl.arrays import Floats
from lcc_rl.settings import NonNegative, Positive, Settings, Share


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
