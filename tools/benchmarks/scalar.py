"""Benchmarks, the same physics for one car in plain Python numbers, and as a Gymnasium env."""

from __future__ import annotations

import math
import random
from bisect import bisect_left
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp

from benchmarks.harness import TOLERANCE
from benchmarks.plain import PlainLoop
from lcc_rl.envs.rollout import ACTION
from lcc_rl.functional.power import POWER_COEFFICIENTS
from lcc_rl.functional.random import STEP as COUNT
from lcc_rl.functional.random import STREAM, hash_bits
from lcc_rl.pieces.base import SEED
from lcc_rl.pieces.rewards import TOUCH

Draw = Callable[[int], float]


def power(speed: float, acceleration: float) -> float:
    """Motor power [W] (A2)."""
    (p00, p01, p02), (p10, p11, p12), (p20, p21, _), (p30, _, _) = POWER_COEFFICIENTS
    constant = p00 + speed * (p10 + speed * (p20 + speed * p30))
    linear = p01 + speed * (p11 + speed * p21)
    return constant + acceleration * (linear + acceleration * (p02 + speed * p12))


class ScalarLoop:
    """One episode of the ALCC environment, with the settings and data of a :class:`PlainLoop`."""

    def __init__(self, plain: PlainLoop) -> None:
        motion, human, estimator = plain.motion, plain.human, plain.estimator
        self.dt, self.max_acceleration = motion.time_step, plain.max_acceleration
        first, second = motion.starts["automated"], motion.starts["human"]
        self.standstill_gap, self.initial_time_gap = first.standstill_gap, first.time_gap
        self.speeds: list[float] = plain.leader.speeds.tolist()
        self.offsets: list[int] = plain.leader.offsets.tolist()
        self.lengths: list[int] = plain.leader.starts.tolist()
        drivers = (human.desired_speeds.tolist(), human.time_gaps.tolist())
        self.drivers: list[tuple[float, float]] = list(zip(*drivers, strict=True))
        self.noise, self.stream = human.noise, human.noise_stream + int(human.index[0])
        self.cap, self.known = second.cap_time_gap, human.drivers
        self.root = 2.0 * (self.known.acceleration * self.known.deceleration) ** 0.5
        self.learning, self.variance = estimator.learning_steps, estimator.measurement_error**2
        self.prior = (estimator.prior_estimate.tolist(), estimator.prior_covariance.tolist())
        self.mean_power = estimator.mean.inverse_power
        self.thresholds: list[float] = estimator.mean.thresholds.tolist()
        self.sums: list[list[float]] = estimator.mean.sums.tolist()
        self.safety, self.late = plain.safety, plain.efficiency
        self.prices, self.penalty = (plain.cav_price, plain.hdv_price), plain.penalty
        self.scales: list[float] = plain.scales.tolist()

    def begin(self, profile: int, start: int, driver: int) -> list[float]:
        """Start an episode; return the observation."""
        self.place, self.step_count = self.offsets[profile] + start, 0
        self.leader = self.cav = self.hdv = self.speeds[self.place]
        self.cav_gap = self.standstill_gap + self.initial_time_gap * self.cav
        self.v0, self.headway = self.drivers[driver]
        known, free = self.known, (self.hdv / self.v0) ** 4
        gap = (known.min_gap + self.hdv * self.headway) / math.sqrt(max(1.0 - free, 1e-6))
        self.gap = min(gap, 2.0 * known.min_gap + self.cap * self.hdv)
        (self.q, self.believed), (self.c_qq, self.c_qt, self.c_tt) = self.prior
        return self.observe()

    def observe(self) -> list[float]:
        """Return the scaled observation."""
        leader, cav, hdv = self.leader, self.cav, self.hdv
        seen = (leader, cav, leader - cav, self.cav_gap, hdv, cav - hdv, self.gap)
        return [value * scale for value, scale in zip(seen, self.scales, strict=True)]

    def step(self, action: float, draw: Draw) -> tuple[list[float], float, bool]:
        """Advance by one step; return observation, reward and whether there was a collision."""
        dt, half = self.dt, 0.5 * self.dt
        leader = self.speeds[self.place + self.step_count + 1]
        cav = max(self.cav + action * self.max_acceleration * dt, 0.0)
        executed = (cav - self.cav) / dt
        cav_gap = self.cav_gap + half * (self.leader - self.cav + leader - cav)
        approach = self.hdv - self.cav
        wish = self.human(approach) * (1.0 + self.noise * draw(self.step_count))
        hdv = max(self.hdv + wish * dt, 0.0)
        gap = self.gap + half * (self.cav - self.hdv + cav - hdv)
        predicted = self.learn(approach, hdv)
        if self.step_count < self.learning:
            predicted = self.population_mean(approach)
        crashed = cav_gap <= 0.0 or gap <= 0.0
        reward = self.reward(cav_gap, cav, cav - leader, executed, predicted, crashed)
        self.power = power(self.hdv, (hdv - self.hdv) / dt)
        self.leader, self.cav, self.hdv = leader, cav, hdv
        self.cav_gap, self.gap = cav_gap, gap
        self.step_count += 1
        return self.observe(), reward, crashed

    def reward(
        self,
        gap: float,
        speed: float,
        approach: float,
        executed: float,
        predicted: float,
        crashed: bool,
    ) -> float:
        """Return the reward of the step (A17); the car's and the human's speeds are its start's."""
        safety, ttc = self.safety, math.inf
        if gap <= 0.0:
            ttc = safety.floor
        elif approach > 0.0:
            ttc = max(max(gap - safety.margin, TOUCH) / approach, safety.floor)
        total = safety.weight * math.log(min(ttc, safety.threshold) / safety.threshold)
        if gap / max(speed, 1.0) >= self.late.threshold:
            total -= self.late.weight
        total -= self.prices[0] * power(self.cav, executed)
        total -= self.prices[1] * power(self.hdv, predicted)
        return total - self.penalty if crashed else total

    def human(self, approach: float) -> float:
        """IDM acceleration of the follower (A3)."""
        known, speed = self.known, self.hdv
        wish = known.min_gap + max(0.0, speed * (self.headway + approach / self.root))
        load = (speed / self.v0) ** 4 + (wish / max(self.gap, known.gap_floor)) ** 2
        return self.limited(known.acceleration * (1.0 - load))

    def limited(self, acceleration: float) -> float:
        """Hold an acceleration within what a car can do."""
        known = self.known
        return min(max(acceleration, -known.braking_limit), known.acceleration_limit)

    def population_mean(self, approach: float) -> float:
        """Mean acceleration over the population (A15)."""
        known, speed, s0 = self.known, self.hdv, self.known.min_gap
        shift = approach / self.root
        share, first, second = self.sums[bisect_left(self.thresholds, -shift)]
        linear = first + shift * share
        squared = second + shift * (2.0 * first + shift * share)
        wish = s0 * s0 + speed * (2.0 * s0 * linear + speed * squared)
        inverse = 1.0 / max(self.gap, known.gap_floor)
        load = speed**4 * self.mean_power + wish * inverse * inverse
        return self.limited(known.acceleration * (1.0 - load))

    def learn(self, approach: float, reached: float) -> float:
        """Predict the follower's acceleration, then learn from the one measured (A15)."""
        known, speed = self.known, self.hdv
        inverse = 1.0 / max(self.gap, known.gap_floor)
        dynamic = max(speed * (self.believed + approach / self.root), 0.0)
        ratio, free = (known.min_gap + dynamic) * inverse, (speed / 15.0) ** 4
        predicted = self.limited(known.acceleration * (1.0 - free * self.q - ratio * ratio))
        measured = (reached - speed) / self.dt
        if not (reached > 0.0 and abs(measured) < known.acceleration_limit):
            return predicted
        slope_q, pull = -known.acceleration * free, speed * inverse
        slope_t = -2.0 * known.acceleration * ratio * pull if dynamic > 0.0 else 0.0
        spread_q = self.c_qq * slope_q + self.c_qt * slope_t
        spread_t = self.c_qt * slope_q + self.c_tt * slope_t
        bend = known.acceleration * pull * pull * self.c_tt
        total = slope_q * spread_q + slope_t * spread_t + 2.0 * bend * bend
        weight = 1.0 / (total + self.variance)
        surprise = (measured - predicted + bend) * weight
        self.c_qq -= spread_q * spread_q * weight
        self.c_qt -= spread_q * spread_t * weight
        self.c_tt -= spread_t * spread_t * weight
        q, believed = self.q + spread_q * surprise, self.believed + spread_t * surprise
        self.q = max(q, 0.0)
        believed += self.c_qt / self.c_qq * (self.q - q)
        self.believed = min(max(believed, 0.05), 10.0)
        return predicted


def check_scalar(env: TransformedEnv, plain: PlainLoop, steps: int) -> None:
    """Hold the plain Python numbers against the environment, over one episode."""
    loop, td = ScalarLoop(plain), env.reset()
    seed = int(td[SEED][0])
    profile, start = int(td["leader", "profile"][0]), int(td["leader", "start"][0])
    loop.begin(profile, start, int(td["human", "driver"][0]))
    generator = torch.Generator().manual_seed(0)

    def draw(step: int) -> float:
        bits: Any = hash_bits(seed + step * COUNT + loop.stream * STREAM)
        return (bits >> 8) * 2.0**-24

    for step in range(steps):
        action = float(torch.rand((), generator=generator) - 0.5)
        td = env.step(td.set(ACTION, torch.full((1, 1, 1), action, device=env.device)))
        seen, reward, _ = loop.step(action, draw)
        check_step(td, seen, reward, step)
        td = step_mdp(td)


def check_step(td: TensorDictBase, seen: list[float], reward: float, step: int) -> None:
    """Compare one step; single precision against double, hence ten times the tolerance."""
    own = td["next", "automated"]
    theirs = [*own["observation"][0, 0].tolist(), float(own["reward"][0, 0])]
    off = max(abs(a - b) for a, b in zip([*seen, reward], theirs, strict=True))
    if not off <= 10 * TOLERANCE:
        raise RuntimeError(f"step {step}: the plain Python loop is off by {off:g}")


def gymnasium_env(plain: PlainLoop, horizon: int, seed: int = 0) -> Any:
    """Build the ALCC environment as a plain Gymnasium env, as one would write it for SB3.

    Its physics are :class:`ScalarLoop`'s, its noise is Python's ``random``.
    """
    import gymnasium

    class Env(gymnasium.Env):  # type: ignore[misc,unused-ignore]
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (7,), np.float32)
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

        def __init__(self) -> None:
            self.loop, self.random = ScalarLoop(plain), random.Random(seed)

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            if seed is not None:
                self.random.seed(seed)
            loop, pick = self.loop, self.random.randrange
            profile = pick(len(loop.offsets))
            start = pick(loop.lengths[profile]) if loop.lengths[profile] else 0
            seen = loop.begin(profile, start, pick(len(loop.drivers)))
            return np.array(seen, dtype=np.float32), {}

        def step(self, action: Any) -> Any:
            seen, reward, crashed = self.loop.step(float(action[0]), self.draw)
            over = self.loop.step_count >= horizon
            return np.array(seen, dtype=np.float32), reward, crashed, over, {}

        def draw(self, step: int) -> float:
            return self.random.random()

    return Env()
