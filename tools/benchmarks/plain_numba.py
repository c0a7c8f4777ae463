"""The ALCC study as loops of numbers that numba compiles: the limit of what is fast."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from benchmarks.harness import agree
from benchmarks.plain import PlainLoop
from lcc_rl.functional.estimation import REFERENCE_SPEED
from lcc_rl.functional.power import POWER_COEFFICIENTS
from lcc_rl.functional.random import LOW_BITS, STEP_INCREMENT, STREAM_INCREMENT
from lcc_rl.functional.safety import NEVER
from lcc_rl.pieces.rewards import TOUCH

NUMBA = "loops in numba"  # its name in tables
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
    """What all episodes share."""

    known: tuple[float, ...]  # the values of KNOWN
    root: float
    dt: float
    noise: float
    error: float
    learning: float
    inverse_power: float
    horizon: int
    largest: float  # acceleration of action 1
    safety: tuple[float, ...]  # weight, floor, threshold, margin
    efficiency: tuple[float, ...]  # weight, threshold
    prices: tuple[float, ...]  # of the energies of both vehicles, and of a collision
    start: tuple[float, ...]  # standstill gap, time gap, lowest and highest factor, cap of others
    # Of the leader's profile and its start, the own gap, the first driver and its noise.
    streams: tuple[int, ...]


class Tables(NamedTuple):
    """Arrays that all episodes read."""

    speeds: Any  # of all leaders, one after the other
    offsets: Any
    starts: Any
    desired_speeds: Any
    time_gaps: Any
    prior: Any
    thresholds: Any  # of the mean over all drivers, with its sums
    sums: Any
    scales: Any


@compiled
def choose(seed: int, count: int, stream: int) -> int:
    """Draw an index, see :func:`lcc_rl.functional.random.choose`."""
    return draw_bits(seed + (stream * STREAM_INCREMENT & LOW_BITS)) * count >> 32


@compiled
def uniform(seed: int, step: int, stream: int) -> float:
    """Draw from U[0, 1), see :func:`lcc_rl.functional.random.uniform`."""
    counter = step * STEP_INCREMENT + (stream * STREAM_INCREMENT & LOW_BITS)
    return (draw_bits(seed + counter) >> 8) * 2.0**-24


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
def begin(clock: Any, motion: Any, drivers: Any, beliefs: Any, t: Any, k: Any) -> None:
    """Write the first moment of an episode with the seed in its clock."""
    seed = clock[0]
    profile = choose(seed, len(t.offsets), k.streams[0])
    clock[1], clock[2] = 0, t.offsets[profile] + choose(seed, t.starts[profile], k.streams[1])
    speed = t.speeds[clock[2]]
    motion[:, 0] = speed
    factor = k.start[2] + (k.start[3] - k.start[2]) * uniform(seed, 0, k.streams[2])
    motion[1, 1] = factor * (k.start[0] + k.start[1] * speed)
    for n in range(len(drivers)):
        driver = choose(seed, len(t.time_gaps), k.streams[3] + n)
        v0, headway = t.desired_speeds[driver], t.time_gaps[driver]
        drivers[n, 0], drivers[n, 1], beliefs[n] = v0, headway, t.prior
        free = max(1.0 - (speed / v0) ** 4, 1e-6)
        steady = (k.known[2] + headway * speed) / free**0.5
        motion[n + 2, 1] = min(steady, 2.0 * k.known[2] + k.start[4] * speed)


@compiled
def rewarded(lead: float, cav: float, before: float, gap: float, k: Any) -> float:
    """Return the reward of the automated vehicle's own motion."""
    weight, floor, threshold, margin = k.safety
    room = max(gap - margin, TOUCH) if gap > 0.0 else gap
    ttc = 0.01 if room <= 0.0 else room / (cav - lead) if cav > lead else NEVER
    late = gap / max(cav, 1.0) >= k.efficiency[1]
    power = motor_power(before, (cav - before) / k.dt)
    safe = weight * np.log(min(max(ttc, floor), threshold) / threshold)
    return safe - k.efficiency[0] * late - k.prices[0] * power


@compiled
def drive(
    clock: Any,
    motion: Any,
    drivers: Any,
    beliefs: Any,
    ahead: float,
    reached: float,
    t: Any,
    k: Any,
) -> tuple[float, bool]:
    """Advance the drivers of an episode; return the price of their energies, and any collision.

    Args:
        clock: seed, step and place in the leader's record.
        motion: speed and gap of every vehicle, the leader first, ``[n + 2, 2]``; written in place.
        drivers: v0 and T, ``[n, 2]``.
        beliefs: (q, T) and their covariance, ``[n, 5]``; written in place.
        ahead, reached: speed of the automated vehicle before and after the step.
        t, k: tables and constants.
    """
    price, crashed = 0.0, False
    for n in range(len(drivers)):
        speed, gap = motion[n + 2, 0], motion[n + 2, 1]
        rate, inverse = speed - ahead, 1.0 / max(gap, k.known[4])
        wish = k.known[2] + max(speed * (drivers[n, 1] + rate / k.root), 0.0)
        load = (speed / drivers[n, 0]) ** 4 + (wish * inverse) ** 2
        draw = uniform(clock[0], clock[1], k.streams[4] + n)
        own = max(speed + limited(load, k.known) * (1.0 + k.noise * draw) * k.dt, 0.0)
        found = learn(beliefs[n], speed, rate, inverse, own, k)
        for i in range(5):
            beliefs[n, i] = found[i + 1]
        predicted = found[0]
        if clock[1] < k.learning:
            predicted = mean(speed, rate, inverse, t.thresholds, t.sums, k)
        price += k.prices[1] * motor_power(speed, predicted)
        gap += 0.5 * k.dt * ((ahead - speed) + (reached - own))
        motion[n + 2, 0], motion[n + 2, 1] = own, gap
        crashed |= gap <= 0.0
        ahead, reached = speed, own
    return price, crashed


@compiled
def advance(
    clock: Any, motion: Any, drivers: Any, beliefs: Any, t: Any, k: Any, action: Any, seen: Any
) -> Any:
    """Take a step of all episodes and replace those that end.

    Args:
        clock, motion, drivers, beliefs: as for :func:`drive`, with a row per episode.
        t, k: tables and constants.
        action: in [−1, 1], ``[batch]``.
        seen: where the next observation goes, ``[batch, 7]``.

    Returns:
        Rewards, and where an episode ends by a collision, and at all.
    """
    rewards, ends = np.empty(len(clock), np.float32), np.zeros((2, len(clock)), np.bool_)
    for row in range(len(clock)):
        now, cars = clock[row], motion[row]
        lead, before, gap = cars[0, 0], cars[1, 0], cars[1, 1]
        ahead = t.speeds[now[2] + now[1] + 1]
        cav = max(before + action[row] * k.largest * k.dt, 0.0)
        gap += 0.5 * k.dt * ((lead - before) + (ahead - cav))
        price, crashed = drive(now, cars, drivers[row], beliefs[row], before, cav, t, k)
        cars[0, 0], cars[1, 0], cars[1, 1] = ahead, cav, gap
        crashed |= gap <= 0.0
        rewards[row] = rewarded(ahead, cav, before, gap, k) - price - k.prices[2] * crashed
        now[1] += 1
        ends[0, row], ends[1, row] = crashed, crashed or now[1] >= k.horizon
        if ends[1, row]:
            now[0] = draw_bits(now[0] + 1)
            begin(now, cars, drivers[row], beliefs[row], t, k)
        v, w, x = cars[0, 0], cars[1, 0], cars[2, 0]
        values = (v, w, v - w, cars[1, 1], x, w - x, cars[2, 1])
        for i in range(7):
            seen[row, i] = values[i] * t.scales[i]
    return rewards, ends


class NumbaLoop:
    """An automated vehicle and drivers behind it, without TorchRL and torch.

    Args:
        plain: the same in torch, whose settings it shares.
        first: where the episodes begin.
    """

    def __init__(self, plain: PlainLoop, first: TensorDictBase) -> None:
        human, mean, own = plain.human, plain.estimator.mean, plain.motion.starts["automated"]
        known = tuple(getattr(human.drivers, name) for name in KNOWN)
        safety, efficiency, leader = plain.safety, plain.efficiency, plain.leader
        index = int(human.index.flatten()[0])
        self.constants = Constants(
            known,
            2.0 * (known[0] * known[1]) ** 0.5,
            plain.motion.time_step,
            human.noise,
            plain.estimator.measurement_error**2,
            plain.estimator.learning_steps,
            mean.inverse_power,
            plain.horizon,
            plain.max_acceleration,
            (safety.weight, safety.floor, safety.threshold, safety.margin),
            (efficiency.weight, efficiency.threshold),
            (plain.cav_price, plain.hdv_price, plain.penalty),
            (
                *(own.standstill_gap, own.time_gap, own.lowest, own.highest),
                plain.motion.starts["human"].cap_time_gap,
            ),
            (
                *(leader.profile_stream, leader.start_stream, own.stream),
                *(human.driver_stream + index, human.noise_stream + index),
            ),
        )
        prior = (plain.estimator.prior_estimate, plain.estimator.prior_covariance)
        arrays = [leader.speeds.flatten(), leader.offsets, leader.starts]
        arrays += [human.desired_speeds.flatten(), human.time_gaps.flatten()]
        arrays += [torch.cat([x.flatten() for x in prior])]
        arrays += [mean.thresholds, mean.sums, plain.scales]
        self.tables = Tables(*(array.numpy() for array in arrays))
        now = plain.start(first)
        self.clock = torch.cat([now[key] for key in ("seed", "step", "place")], -1).numpy()
        cars = [torch.stack([now["leader"], torch.zeros_like(now["leader"])], -1)]
        cars += [torch.stack([now["cav"], now["cav_gap"]], -1)]
        self.motion = torch.cat([*cars, torch.cat([now["speed"], now["gap"]], -1)], 1).numpy()
        pairs = [("desired_speed", "desired_time_gap"), ("estimate", "covariance")]
        self.drivers, self.beliefs = (
            torch.cat([now[key] for key in pair], -1).numpy() for pair in pairs
        )
        self.seen = plain.observe(now).numpy()

    def step(self, action: Any) -> Any:
        """Take a step by actions ``[batch]``; return the rewards and the ends of episodes."""
        now = (self.clock, self.motion, self.drivers, self.beliefs)
        return advance(*now, self.tables, self.constants, action, self.seen)

    def play(self, steps: int) -> Any:
        """Take so many steps by zero actions from now on; return the motion of all vehicles."""
        zero = np.zeros(len(self.clock), np.float32)
        for _ in range(steps):
            self.step(zero)
        return self.motion


def check_loops(env: TransformedEnv, steps: int) -> None:
    """Hold the loops against the same physics in torch, whose new episodes get their seeds."""
    plain, first = PlainLoop(env), env.reset()
    loops, state, rows = NumbaLoop(plain, first.copy()), plain.start(first), len(first)
    generator = torch.Generator().manual_seed(0)
    for step in range(steps):
        action = torch.rand(rows, 1, generator=generator) * 2.0 - 1.0
        rewards, ends = loops.step(action.flatten().numpy())
        seeds = torch.from_numpy(loops.clock[:, :1])
        state, written, seen = plain.play(state, action, seeds)
        pairs = {"reward": rewards, "terminated": ends[0], "done": ends[1]}
        for name, value in pairs.items():
            agree(f"step {step}: {name} of the loops", value, written[name].flatten(), 2e-3)
        agree(f"step {step}: observation of the loops", loops.seen, seen, 2e-3)
