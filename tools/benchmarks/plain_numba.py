"""The ALCC study of a string of many human drivers as loops that numba compiles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from tensordict import TensorDictBase

from benchmarks.plain import PlainLoop
from lcc_rl.functional.estimation import REFERENCE_SPEED
from lcc_rl.functional.power import POWER_COEFFICIENTS
from lcc_rl.functional.random import LOW_BITS, STEP_INCREMENT, STREAM_INCREMENT

compiled: Callable[[Any], Any] = numba.njit(fastmath=True, error_model="numpy")


@compiled
def draw_bits(counter: int) -> int:
    """Mix the low 32 bits of a number, see :func:`lcc_rl.functional.random.hash_bits`."""
    x = counter & LOW_BITS
    x = (x ^ (x >> 16)) * 0x7FEB352D & LOW_BITS
    x = (x ^ (x >> 15)) * 0x2C1B3C6D & LOW_BITS
    return x ^ (x >> 16)


@compiled
def motor_power(v: float, a: float) -> float:
    """Return the motor's power (A2) [W]."""
    (p00, p01, p02), (p10, p11, p12), (p20, p21, _), (p30, _, _) = POWER_COEFFICIENTS
    constant = p00 + v * (p10 + v * (p20 + v * p30))
    return constant + a * (p01 + v * (p11 + v * p21) + a * (p02 + v * p12))


# The order in which the loops read the parameters of IDMConstants.
KNOWN = (
    *("acceleration", "deceleration", "min_gap", "exponent", "gap_floor"),
    *("braking_limit", "acceleration_limit"),
)


class Constants(NamedTuple):
    """What all drivers share, and how their accelerations are measured."""

    known: tuple[float, ...]  # the values of KNOWN
    root: float
    dt: float
    noise: float
    stream: int
    error: float
    learning: float
    inverse_power: float
    price: float


@compiled
def limited(load: float, known: Any) -> float:
    """Return the acceleration that is left by a load, within the physical limits."""
    return min(max(known[0] * (1.0 - load), -known[5]), known[6])


@compiled
def mean(speed: float, rate: float, inverse: float, thresholds: Any, sums: Any, k: Any) -> float:
    """Return the mean acceleration of the calibrated drivers."""
    shift, s0 = rate / k.root, k.known[2]
    share, first, second = sums[np.searchsorted(thresholds, -shift)]
    linear, squared = first + shift * share, second + shift * (2.0 * first + shift * share)
    wished = s0 * s0 + speed * (2.0 * s0 * linear + speed * squared)
    return limited(speed**4 * k.inverse_power + wished * inverse * inverse, k.known)


@compiled
def learn(
    belief: Any, speed: float, rate: float, inverse: float, reached: float, k: Any
) -> tuple[float, float, float, float, float, float]:
    """Return the predicted acceleration of a driver, and the belief after the step."""
    q, t, qq, qt, tt = belief[0], belief[1], belief[2], belief[3], belief[4]
    a, free = k.known[0], (speed / REFERENCE_SPEED) ** 4
    dynamic = max(speed * (t + rate / k.root), 0.0)
    ratio = (k.known[2] + dynamic) * inverse
    predicted = limited(free * q + ratio * ratio, k.known)
    measured = (reached - speed) / k.dt
    if reached > 0.0 and abs(measured) < k.known[6]:
        by_q, by_t = -a * free, -2.0 * a * ratio * speed * inverse * (dynamic > 0.0)
        to_q, to_t = qq * by_q + qt * by_t, qt * by_q + tt * by_t
        bend = a * (speed * inverse) ** 2 * tt
        weight = 1.0 / (by_q * to_q + by_t * to_t + 2.0 * bend * bend + k.error)
        surprise = (measured - predicted + bend) * weight
        qq, qt, tt = (
            qq - to_q * to_q * weight,
            qt - to_q * to_t * weight,
            tt - to_t * to_t * weight,
        )
        q, t = q + to_q * surprise, t + to_t * surprise
        bounded = max(q, 0.0)
        q, t = bounded, min(max(t + qt / qq * (bounded - q), 0.05), 10.0)
    return predicted, q, t, qq, qt, tt


@compiled
def advance(
    seeds: Any, step: int, cav: Any, motion: Any, drivers: Any, beliefs: Any, table: Any, k: Any
) -> Any:
    """Advance the drivers of all episodes; return the price of their energies.

    Args:
        seeds: of the episodes, ``[batch]``.
        step: the step of all of them.
        cav: speed of the automated vehicle before and after the step, ``[batch, 2]``.
        motion: speed and gap of every driver, ``[batch, n, 2]``; written in place.
        drivers: v0 and T, ``[batch, n, 2]``.
        beliefs: (q, T) and their covariance, ``[batch, n, 5]``; written in place.
        table: thresholds and sums of the mean over all drivers.
        k: the constants.
    """
    prices = np.zeros(len(seeds), np.float32)
    for row in range(len(seeds)):
        ahead, ahead_reached = cav[row, 0], cav[row, 1]
        for n in range(motion.shape[1]):
            speed, gap = motion[row, n, 0], motion[row, n, 1]
            rate, inverse = speed - ahead, 1.0 / max(gap, k.known[4])
            wish = k.known[2] + max(speed * (drivers[row, n, 1] + rate / k.root), 0.0)
            load = (speed / drivers[row, n, 0]) ** 4 + (wish * inverse) ** 2
            counter = step * STEP_INCREMENT + (k.stream + n) * STREAM_INCREMENT
            draw = (draw_bits(seeds[row] + counter) >> 8) * 2.0**-24
            command = limited(load, k.known) * (1.0 + k.noise * draw)
            reached = max(speed + command * k.dt, 0.0)
            found = learn(beliefs[row, n], speed, rate, inverse, reached, k)
            for i in range(5):
                beliefs[row, n, i] = found[i + 1]
            predicted = found[0]
            if step < k.learning:
                predicted = mean(speed, rate, inverse, table[0], table[1], k)
            prices[row] += k.price * motor_power(speed, predicted)
            motion[row, n, 0] = reached
            motion[row, n, 1] = gap + 0.5 * k.dt * ((ahead - speed) + (ahead_reached - reached))
            ahead, ahead_reached = speed, reached
    return prices


class NumbaString:
    """The drivers of a string behind an automated vehicle at constant speed, without TorchRL.

    Args:
        plain: the same in torch, whose settings it shares.
        start: where the episodes begin.
    """

    def __init__(self, plain: PlainLoop, start: TensorDictBase) -> None:
        human, estimator, state = plain.human, plain.estimator, plain.start(start)
        known = tuple(getattr(human.drivers, name) for name in KNOWN)
        root = 2.0 * (known[0] * known[1]) ** 0.5
        average, error = estimator.mean, estimator.measurement_error**2
        self.constants = Constants(
            known,
            root,
            plain.motion.time_step,
            human.noise,
            human.noise_stream,
            error,
            estimator.learning_steps,
            average.inverse_power,
            plain.hdv_price,
        )
        self.table = (average.thresholds.numpy(), average.sums.numpy())
        pairs = [("speed", "gap"), ("desired_speed", "desired_time_gap")]
        pairs += [("estimate", "covariance")]
        self.parts = [torch.cat([state[key] for key in pair], -1).numpy() for pair in pairs]
        self.seeds = state["seed"].flatten().numpy()
        self.cav = state["cav"].expand(-1, 2).contiguous().numpy()

    def play(self, steps: int) -> Any:
        """Play from the start; return the motion of the drivers and the last price."""
        motion, drivers, beliefs = (part.copy() for part in self.parts)
        for step in range(steps):
            price = advance(
                self.seeds, step, self.cav, motion, drivers, beliefs, self.table, self.constants
            )
        return motion, price
